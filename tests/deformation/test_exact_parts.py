"""Parts of a scene without noise do not decide the verdict on the rest: walls of a model, water, copied points."""

import numpy as np
import pytest
from bent_clouds import verdict
from wording import check_text

from pcbench.deformation.blocks import Blocks, noise_sizes

NOISE = 0.02


def ground(seed, depth, count=6_000):
    """Return rolling ground of 60 m with noise, lowered by a dome of this depth."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(-30, 30, (2, count))
    z = 1.5 * np.sin(x / 3) + np.cos(y / 2.5) - depth * (1 - (x**2 + y**2) / 900)
    return np.stack([x, y, z], axis=1) + rng.normal(0, NOISE, (count, 3))


def walls(seed, count=6_000):
    """Return two crossing walls that are exactly planar."""
    rng = np.random.default_rng(100 + seed)
    points = np.stack([rng.uniform(-30, 30, count), np.zeros(count), rng.uniform(0, 4, count)], axis=1)
    points[::2] = points[::2, [1, 0, 2]]
    return points


def with_water(seed, depth):
    points = ground(seed, depth, 9_000)
    points[points[:, 0] < -6, 2] = -1.5
    return points


def with_walls(seed, depth):
    return np.concatenate([ground(seed, depth), walls(seed)])


def quantised(seed, depth):
    points = ground(seed, depth)
    return np.column_stack([points[:, :2], 0.05 * np.round(points[:, 2] / 0.05)])


def partly_copied(seed, depth):
    """Return points of which every second one is that of the first seed, whatever the depth."""
    points = ground(1, 0.0)
    if seed == 1:
        return points
    rng, copied = np.random.default_rng(seed), np.arange(len(points)) % 2 == 0
    lift = depth * (1 - np.square(points[:, :2]).sum(axis=1) / 900)
    changed = points + rng.normal(0, NOISE, points.shape) - lift[:, None] * [0, 0, 1]
    return np.where(copied[:, None], points, changed)


SCENES = [with_walls, with_water, quantised, partly_copied]


@pytest.mark.parametrize("scene", [with_walls, pytest.param(with_water, marks=pytest.mark.long), quantised])
def test_a_dome_beside_an_exact_part_is_found(scene):
    result = verdict(scene(1, 0.0), scene(2, 0.3), "none")
    assert result.verdict == "non-affine", result.warnings
    assert result.noise.sigma > 0.3 * NOISE


def test_a_dome_of_every_second_point_is_a_change():
    """The candidate has two surfaces, one of which did not move, so that no field describes both."""
    result = verdict(partly_copied(1, 0.0), partly_copied(2, 0.3), "none")
    assert result.verdict == "non-affine" or result.changes[0].area > 500


@pytest.mark.parametrize("scene", SCENES)
def test_noise_beside_an_exact_part_is_not_a_deformation(scene):
    result = verdict(scene(1, 0.0), scene(2, 0.0), "none")
    assert result.verdict == "none", result.warnings
    assert result.remaining_rms > 0.2 * NOISE
    assert "equals" not in result.sentence()


def test_a_cloud_of_which_one_point_moved_does_not_equal_the_reference():
    points = ground(1, 0.0, 3_000)
    assert "equals" in verdict(points, points.copy(), "none").sentence()
    moved = points.copy()
    moved[17, 2] += 1.0
    result = verdict(points, moved, "none")
    assert result.verdict == "none"
    assert "equals" not in check_text(result.sentence())


def test_the_sentence_names_the_share_of_the_surface_that_constrains_it():
    shown = verdict(
        *(np.concatenate([p, rough(seed)]) for seed, p in enumerate((ground(1, 0.0), ground(2, 0.0)))), "none"
    )
    assert shown.surface_share < 0.7
    assert "% of the surface, " in check_text(shown.sentence())


def rough(seed):
    """Return a volume without a surface beside the ground, as a forest is."""
    return np.random.default_rng(200 + seed).uniform([-30, 30, -2], [30, 120, 12], (15_000, 3))


def test_noise_is_that_of_the_blocks_that_have_noise():
    rng = np.random.default_rng(4)
    places = np.column_stack([rng.uniform(0, 100, (20_000, 2)), np.zeros(20_000)])
    residuals, weights = rng.normal(0, NOISE, 20_000), np.ones(20_000)
    for is_exact in (places[:, 0] < 70, rng.random(20_000) < 0.7):
        sizes = noise_sizes(places, np.where(is_exact, 1e-9, residuals), weights, exact=1e-3)
        np.testing.assert_allclose(sizes, NOISE, rtol=0.2)
        without_limit = noise_sizes(places, np.where(is_exact, 1e-9, residuals), weights)
        assert np.median(without_limit) < NOISE
    few = places[:, 0] < 85  # one part that moved by itself among exact ones does not set the scale
    assert noise_sizes(places, np.where(few, 0.0, residuals), weights, exact=1e-3).max() == 0


def test_share_counts_blocks_with_weight():
    rng = np.random.default_rng(5)
    places = np.column_stack([rng.uniform(0, 100, (20_000, 2)), np.zeros(20_000)])
    weights = np.where(places[:, 0] < 60, 1.0, 0.01)
    assert Blocks.of(places).share_with_weight(weights, np.ones(20_000)) == pytest.approx(0.6, abs=0.06)
    assert Blocks.of(places).share_with_weight(np.ones(20_000), np.ones(20_000)) == pytest.approx(1.0)
