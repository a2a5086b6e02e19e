"""Waves that are shorter than a cubic field shows are found; noise, however correlated, shows none."""

import re
from types import SimpleNamespace

import numpy as np
import pytest
from bends import Cell, Scene
from bent_clouds import verdict
from deformation_cases import correlated_noise
from wording import check_text

from pcbench.deformation.waves import find_waves

SIZE = 1000.0  # m


def terrain(seed, count, amplitude=0.0, length=100.0, noise=0.03):
    """Return rolling ground with a vertical wave that runs at 30 degrees from x."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(-SIZE / 2, SIZE / 2, (2, count))
    along = np.cos(np.pi / 6) * x + np.sin(np.pi / 6) * y
    z = 12 * np.sin(x / 90) * np.cos(y / 120) + amplitude * np.sin(2 * np.pi * along / length)
    return np.stack([x, y, z], axis=1) + rng.normal(0, noise, (count, 3))


@pytest.mark.parametrize("length", [pytest.param(60.0, marks=pytest.mark.long), 150.0])
def test_a_wave_is_found_with_its_length_direction_and_size(length):
    result = verdict(terrain(1, 24_000), terrain(2, 14_000, 0.10, length), "none")
    assert result.verdict == "non-affine", result.warnings
    wave = result.wave
    assert wave.axis == "z"
    assert wave.length == pytest.approx(length, rel=0.03)
    assert np.abs(np.dot(wave.direction, [np.cos(np.pi / 6), 0.5, 0])) > 0.99
    # Planes through points 4 m apart smooth the ground's curvature, not the wave; slopes hardly shorten it.
    low, high = wave.ci
    assert low < 0.10 / np.sqrt(2) < high
    assert wave.rms == pytest.approx(0.10 / np.sqrt(2), rel=0.15)
    assert result.amplitude.rms >= wave.rms
    if length == 150.0:
        sentence = check_text(result.sentence("c", "m"))
        assert float(re.search(r"at (\d+) degrees", sentence)[1]) == pytest.approx(30, abs=2)


def test_the_limit_names_the_lengths_that_were_searched():
    result = verdict(terrain(1, 24_000), terrain(2, 14_000), "none")
    assert (result.verdict, result.wave) == ("none", None)
    limit = result.waves_from
    assert limit.shortest < 60 < 190 < limit.longest
    assert limit.rms >= result.stated_rms
    assert "waves of" in check_text(result.sentence("c", "m"))


@pytest.fixture(scope="module")
def scene():
    return Scene(8_000)


@pytest.mark.parametrize("cell", [Cell("gauss", 0), Cell("gauss", 10, 2.0), Cell("exp", 10, 2.0)], ids=str)
def test_noise_shows_no_wave(scene, cell):
    """Noise that is correlated over a tenth of the scene has a steep spectrum."""
    features, ones = scene.waves(cell), np.ones(8_000)
    for seed in range(2):
        residuals = scene.noise(cell, features, seed)
        left = residuals - scene.cubic @ scene.geometry.fit("cubic", scene.cubic.T @ residuals)
        pairs = SimpleNamespace(places=scene.places, normals=scene.normals, remainders=left, weights=ones)
        assert find_waves(pairs).wave is None


def test_a_patch_of_a_wave_is_not_a_wave_of_the_scene():
    """A bump or a corrugated corner belongs to the local changes: it does not continue."""
    rng = np.random.default_rng(3)
    places = np.column_stack([rng.uniform(0, 100, (9_000, 2)), np.zeros(9_000)])
    inside = np.square(places[:, :2] - 30).sum(axis=1) < 10**2
    normals = np.tile([0.0, 0.0, 1.0], (9_000, 1))
    left = rng.normal(0, 0.02, 9_000) + 0.01 * correlated_noise(places, 5.0, rng)[:, 2] + 0.1 * inside
    pairs = SimpleNamespace(places=places, normals=normals, remainders=left, weights=np.ones(9_000))
    assert find_waves(pairs).wave is None
