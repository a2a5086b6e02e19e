"""Vegetation of a given pair: points on it, and the plants that they belong to."""

import numpy as np
import pytest
from wording import check_error

from pcbench.errors import InputError
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.mesh import MeshIndex
from pcbench.studies.stress.cells import load_pair, plan_runs, save_pair
from pcbench.studies.stress.ladders import LADDERS
from pcbench.studies.stress.results import StressSettings
from pcbench.studies.stress.scenes import WOODED, given_pair, scene_pair
from pcbench.studies.stress.study import GivenClouds, run_stress
from pcbench.studies.stress.surfaces import wooded_surface
from pcbench.studies.stress.vegetation import crowns, plants_of

LADDER = LADDERS["missing-vegetation"]
METHODS = {"registration": ("icp",), "metrics": (), "verdicts": ("deform",)}


def cone(x, y, height, radius=2.0):
    """Return points of a cone on a grid of 0.1, with its top at (x, y, height)."""
    u, v = (axis.ravel() for axis in np.meshgrid(*[np.arange(-radius, radius + 0.05, 0.1)] * 2))
    inside = np.hypot(u, v) <= radius
    u, v = u[inside], v[inside]
    return np.column_stack([x + u, y + v, height - np.hypot(u, v)])


def test_crowns_are_told_apart_by_their_tops():
    trees = [cone(0, 0, 8), cone(5, 0, 6), cone(0, 5, 9)]
    points = np.concatenate(trees)
    expected = np.repeat(np.arange(3), [len(tree) for tree in trees])
    order = np.random.default_rng(0).permutation(len(points))
    found = crowns(points[order], 1.0)
    assert len(np.unique(np.column_stack([found, expected[order]]), axis=0)) == len(np.unique(found)) == 3


def classified(codes):
    """Return level ground with a tree, whose reference has class codes for both, and the points of a candidate."""
    tree = cone(5.0, 5.0, 6.0)
    x, y = (axis.ravel() for axis in np.meshgrid(*[np.arange(0, 20, 0.25)] * 2))
    ground = np.column_stack([x, y, 0 * x])
    classes = np.repeat(codes, [len(ground), len(tree)]).astype(np.uint8)
    points = np.concatenate([ground, tree])
    return Cloud(points, attributes={"classification": classes}), points + 0.01, len(tree)


@pytest.mark.parametrize("code", [3, 4, 5])
def test_vegetation_has_the_classes_of_the_reference(code):
    reference, points, count = classified([2, code])
    plants = plants_of(points, reference, 20.0 / 0.02)  # crowns as wide as the scene: one plant
    assert (plants[:-count] == -1).all() and (plants[-count:] == 0).all()


@pytest.mark.parametrize("codes", [[2, 6], [2, 2]])
def test_pairs_without_vegetation(codes):
    reference, points, _ = classified(codes)
    assert plants_of(points, reference, 20.0) is None
    assert plants_of(points, Cloud(reference.points), 20.0) is None


@pytest.fixture(scope="module")
def clouds():
    pair = scene_pair(WOODED, 0, 12_000)
    surface, trees = wooded_surface(0)
    green = trees[MeshIndex(surface).query(pair.reference).faces] >= 0
    classes = np.where(green, 5, 6).astype(np.uint8)
    return Cloud(pair.reference, unit="m", attributes={"classification": classes}), Cloud(pair.points, unit="m"), pair


def test_a_given_pair_keeps_its_plants_in_the_child_processes(clouds, tmp_path):
    reference, candidate, truth = clouds
    pair = given_pair(reference, candidate, "none")
    shown, found = truth.plants >= 0, pair.plants >= 0
    assert (shown & found).sum() > 0.8 * max(shown.sum(), found.sum())
    # Crowns bulge, so that one may have two tops; trees beside each other may share one.
    trees, tops = (np.sum(np.bincount(plants[plants >= 0]) >= 10) for plants in (truth.plants, pair.plants))
    assert 0.5 * trees < tops < 2 * trees
    save_pair(tmp_path / "pair.npz", pair)
    np.testing.assert_array_equal(load_pair(tmp_path / "pair.npz").plants, pair.plants)
    plan = plan_runs((LADDER,), METHODS, quick=False, seeds=range(1), points=1, given=pair)
    assert [run.level for run in plan] == list(LADDER.levels)


def test_the_ladder_does_not_apply_to_a_pair_without_vegetation(clouds, tmp_path):
    reference, candidate, _ = clouds
    bare = GivenClouds(Cloud(reference.points, unit="m"), candidate)
    settings = StressSettings(only="missing-vegetation", methods=("icp",), register="none")
    with check_error(InputError):
        run_stress(tmp_path / "out", settings, bare)


def test_the_ladder_has_its_own_scene():
    plan = plan_runs((LADDER,), METHODS, quick=False, seeds=range(1), points=1, given=None)
    assert {run.scene for run in plan} == {WOODED}
