"""Floors and deformation in tiles against those in memory, of clouds that are registered in windows."""

import numpy as np
import pytest
from tiled_clouds import in_this_process
from tiled_pairs import Pair, noisy

from pcbench.changes import details, samples
from pcbench.comparison import in_tiles
from pcbench.geometry.cloud import Cloud
from pcbench.io import write_cloud
from pcbench.measure.directions import MEAN_METRICS
from pcbench.measure.results import CANDIDATE_TO_REFERENCE, REFERENCE_TO_CANDIDATE
from pcbench.measure.tiled import assessment, nearby, windows

SIZE = 20.0


def ground(rng, count, bend=0.0, bump=0.0):
    """Return terrain, with a dome over all of it and a bump of 3 units in a corner."""
    points = rng.random((count, 3)) * SIZE
    points[:, 2] = np.sin(points[:, 0] / 2) + np.cos(points[:, 1] / 3)
    points = noisy(rng, points)
    away, aside = (np.hypot(*(points[:, :2] - center * SIZE).T) for center in (0.5, 0.3))
    points[:, 2] += bend * (1 - np.square(away / SIZE)) + bump * np.exp(-np.square(aside / 3))
    return points


def with_block(rng, points):
    """Return points with a cube of 3 units, in whose shadow there are none."""
    beside = (np.abs(points[:, :2] - 13) > 1.5).any(axis=1)
    top = rng.random((500, 3)) * [3, 3, 0] + [11.5, 11.5, 4]
    return np.concatenate([points[beside], noisy(rng, top)])


def lines(rng, count):
    """Return scan lines, in which points are five times denser than across."""
    points = ground(rng, count)
    step = SIZE / np.sqrt(count / 5)
    points[:, 1] = np.round(points[:, 1] / step) * step
    points[:, 2] = np.sin(points[:, 0] / 2) + np.cos(points[:, 1] / 3)
    return points


def town(rng, count):
    """Return ground with houses: edges, walls and shadows."""
    points = ground(rng, count)
    cell, place = np.divmod(points[:, :2], 5.0)
    points[((place > 1) & (place < 4)).all(axis=1), 2] += 3 + cell.sum(axis=1)[((place > 1) & (place < 4)).all(axis=1)]
    walls = rng.random((count // 3, 3)) * [SIZE, 1, 4]
    walls[:, 1] = 1 + 5 * rng.integers(0, 4, len(walls))
    return noisy(rng, np.concatenate([points, walls]), 0.01)


SCENES = {
    "bend": lambda rng: (ground(rng, 2500), ground(rng, 4000, bend=0.1)),
    "bump": lambda rng: (ground(rng, 4000), ground(rng, 4000, bump=0.4)),
    "changed": lambda rng: (ground(rng, 3000), with_block(rng, ground(rng, 2000, bend=0.1))),
    "sparse": lambda rng: (ground(rng, 5000), ground(rng, 600)),
    "lines": lambda rng: (lines(rng, 3000), ground(rng, 3000)),
    "town": lambda rng: (town(rng, 3000), town(rng, 2500)),
    "rounded": lambda rng: (np.round(ground(rng, 3000), 1), np.round(ground(rng, 3000), 2)),
}


def check_assessment(tiled, memory):
    """Check that floors and deformation are those in memory: the mean of all distances, rounded once, is the latter's
    up to the last bits, and so are the floors that depend on it."""
    ours, theirs = tiled["a"], memory["a"]
    assert tiled.tiling.sampled_points is not None and tiled.tiling.tiles >= 10
    for metric in MEAN_METRICS:
        for way in (CANDIDATE_TO_REFERENCE, REFERENCE_TO_CANDIDATE):
            found, expected = (c.metrics.directed[metric.name][way].floor for c in (ours, theirs))
            assert found is not None
            assert found == pytest.approx(expected, rel=1e-12, abs=0)
    assert ours.changes.found == theirs.changes.found
    for way in (CANDIDATE_TO_REFERENCE, REFERENCE_TO_CANDIDATE):
        found, expected = ours.budget[way], theirs.budget[way]
        for name, part in expected.parts.items():
            assert found.parts[name].point_share == part.point_share
            assert found.parts[name].mean_square == pytest.approx(part.mean_square, abs=1e-9 * expected.mean_square)
    assert ours.deformation == theirs.deformation


@pytest.fixture
def small_windows(monkeypatch):
    in_this_process(monkeypatch)
    monkeypatch.setattr(windows, "MAX_SAMPLE", 1900)
    monkeypatch.setattr(windows, "_WINDOW_POINTS", 150)
    monkeypatch.setattr(nearby, "_PLACES_AT_ONCE", 1000)


# The others have the longest times, and the same kinds of terms.
FAST_SCENES = ("changed", "rounded")


@pytest.mark.parametrize(
    "scene", [scene if scene in FAST_SCENES else pytest.param(scene, marks=pytest.mark.long) for scene in SCENES]
)
def test_floors_and_deformation_are_those_in_memory(tmp_path, small_windows, scene, monkeypatch):
    pair, kept = Pair(tmp_path / "pair", *SCENES[scene](np.random.default_rng(0)), presets=()), []

    def find_changes(*sides):
        changes = assessment.find_changes(*sides)
        kept.extend(len(side.surface.index.points) for side in sides)
        return changes

    monkeypatch.setattr(in_tiles, "find_changes", find_changes)
    check_assessment(pair.tiled(), pair.memory())
    if scene == "rounded":  # no deformation is followed, and what the search for changes needed does not stay in memory
        assert kept == [0, 0]


@pytest.mark.long
def test_small_changes_are_those_in_memory(tmp_path, small_windows, monkeypatch):
    for module in (samples, details):
        monkeypatch.setattr(module, "MAX_SAMPLE", 600)
    rng = np.random.default_rng(3)
    beside = (np.abs((candidate := ground(rng, 6000))[:, :2] - 13) > 0.5).any(axis=1)
    block = noisy(rng, rng.random((60, 3)) * [1, 1, 0] + [12.5, 12.5, 4])
    pair = Pair(tmp_path / "pair", ground(rng, 6000), np.concatenate([candidate[beside], block]), presets=())
    tiled, memory = pair.tiled(tile_points=1500), pair.memory()
    assert tiled["a"].changes.found == memory["a"].changes.found
    assert len(memory["a"].changes.found) == 1


@pytest.mark.long
def test_in_a_region(tmp_path, small_windows):
    scene = SCENES["bend"](np.random.default_rng(1))
    pair = Pair(tmp_path / "pair", *scene, presets=(), crop="sphere:10,10,0,8")
    check_assessment(pair.tiled(tile_points=500), pair.memory())


def test_classes_weight_the_pairs(tmp_path, small_windows):
    """Vegetation, which moved, counts less in tiles as in memory."""
    rng = np.random.default_rng(2)
    pair = Pair(tmp_path / "pair", ground(rng, 2), ground(rng, 2), presets=())
    for name, count, lift in (("ref", 2500, 0.0), ("a", 3000, 0.3)):
        points = ground(rng, count)
        is_plant = points[:, 0] < SIZE / 4
        points[is_plant, 2] += lift
        pair.paths[name] = pair.paths[name].with_suffix(".las")
        classes = np.where(is_plant, 5, 2).astype(np.uint8)
        write_cloud(pair.paths[name], Cloud(points, attributes={"classification": classes}))
    check_assessment(pair.tiled(tile_points=500), pair.memory())
