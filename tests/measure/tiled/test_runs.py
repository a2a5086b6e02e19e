"""Runs and tiles: every point is in exactly one tile, in the order of the file, whatever the pieces and tiles."""

import resource
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from tiled_clouds import ORIGIN, clouds_of_all_kinds, stored_runs, stored_tiles

from pcbench.geometry.regions import Box
from pcbench.geometry.transform import Similarity
from pcbench.measure.tiled.lattice import CODE_BITS, Lattice
from pcbench.measure.tiled.runs import CloudRuns, leaf_ranges, tile_ranges
from pcbench.measure.tiled.tiles import TiledCloud, make_tile

WHOLE = (0, 1 << CODE_BITS)


@settings(max_examples=8, deadline=None, phases=[Phase.explicit, Phase.generate])
@given(
    seed=st.integers(0, 2**32),
    count=st.integers(2, 1500),
    kind=st.integers(0, 8),
    most=st.sampled_from([20, 500]),
    piece_points=st.sampled_from([50, 2500]),
    step=st.integers(1, 9),
)
def test_each_point_is_in_one_tile(tmp_path_factory, seed, count, kind, most, piece_points, step):
    points = list(clouds_of_all_kinds(np.random.default_rng(seed), count))[kind][1]
    if not len(points):
        return
    folder = tmp_path_factory.mktemp("runs")
    runs, summaries = stored_runs(folder / "runs", points, piece_points=piece_points, step=step)
    np.testing.assert_array_equal(np.concatenate([summary.even for summary in summaries]), points[::step])
    ranges = tile_ranges(runs, most)
    assert (ranges[0][0], ranges[-1][1]) == WHOLE
    assert all(one[1] == other[0] for one, other in pairwise(ranges))
    rows = []
    for codes in ranges:
        found = runs.overlapping(codes).read([codes])
        assert (np.diff(found.rows) > 0).all()
        np.testing.assert_array_equal(found.points, points[found.rows])
        code = runs.lattice.codes(found.points)
        assert ((code >= codes[0]) & (code < np.uint64(codes[1]))).all()
        rows.append(found.rows)
    np.testing.assert_array_equal(np.sort(np.concatenate(rows)), np.arange(len(points)))


def test_tiles_have_at_most_about_the_wanted_number_of_points(tmp_path):
    rng = np.random.default_rng(0)
    points = rng.random((20_000, 3)) * [100, 80, 1]
    for most in (500, 30_000):
        counts = stored_tiles(tmp_path / str(most), points, most, piece_points=5000).counts
        assert counts.max() <= 1.1 * most + 20
        assert len(counts) <= 1 + 8 * len(points) / most


def test_a_tile_has_its_box_and_the_points_inside_the_region(tmp_path):
    points = np.random.default_rng(0).random((500, 3))
    region = Box(np.zeros(3), np.array([0.5, 1, 1]))
    runs, _ = stored_runs(tmp_path / "runs", points)
    summary = make_tile(runs, 3, WHOLE, ORIGIN, None, region, tmp_path)
    inside = region.contains(points)
    assert (summary.number, summary.count, summary.inside) == (3, 500, np.count_nonzero(inside))
    np.testing.assert_array_equal([summary.low, summary.high], [points.min(axis=0), points.max(axis=0)])
    np.testing.assert_array_equal(summary.lowest_inside, points[inside].min(axis=0))
    outside = make_tile(runs, 4, WHOLE, ORIGIN, None, Box(np.full(3, 5.0), np.full(3, 6.0)), tmp_path)
    assert outside.inside == 0 and np.isinf(outside.lowest_inside).all()


def test_an_empty_tile_has_no_files(tmp_path):
    runs, _ = stored_runs(tmp_path / "runs", np.array([[0.0, 0, 0], [1, 1, 1]]))
    summary = make_tile(runs.overlapping((5, 9)), 0, (5, 9), ORIGIN, None, None, tmp_path)
    assert summary.count == 0 and summary.inside == 0
    tiles = TiledCloud.of(tmp_path, [summary])
    assert len(tiles) == 1 and tiles.occupied == []


def test_a_pose_does_not_change_which_points_are_stored(tmp_path):
    """Points are cut by their place after an approximate motion; a tile has them as the final motion moves them."""
    points = np.random.default_rng(0).random((2000, 3))
    turned = Similarity(np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), np.array([3.0, 0, 0]), 1.0)
    lattice = Lattice((0.0, 0.0, 0.0), 1e-5, turned)
    tiles = stored_tiles(tmp_path, points, 100, pose=turned, lattice=lattice)
    rows = np.concatenate([tiles.load(number, "rows") for number in tiles.occupied])
    moved = np.concatenate([tiles.load(number, "points") for number in tiles.occupied])
    assert sorted(rows) == list(range(2000))
    np.testing.assert_array_equal(moved, turned.apply(points)[rows])


def test_given_normals_have_unit_length_and_zeros_are_unknown(tmp_path):
    points, normals = np.random.default_rng(0).normal(size=(2, 300, 3))
    normals[:20] = 0
    tiles = stored_tiles(tmp_path, points, 100, normals=normals)
    for number in tiles.occupied:
        rows, found = tiles.load(number, "rows"), tiles.load(number, "given_normals")
        assert np.isnan(found[rows < 20]).all()
        np.testing.assert_allclose(np.linalg.norm(found[rows >= 20], axis=1), 1)


@pytest.mark.parametrize("most", [1, 30, 5000])
def test_the_curve_is_halved_until_parts_have_few_points(tmp_path, most):
    points = np.random.default_rng(0).random((3000, 3)) * [50, 20, 3]
    runs, _ = stored_runs(tmp_path / "runs", points)  # of 1,000 points: their index has each code
    codes = np.sort(runs.lattice.codes(points))

    def count(low, high):
        return np.searchsorted(codes, np.uint64(high)) - np.searchsorted(codes, np.uint64(low))

    leaves = leaf_ranges(runs, most).tolist()
    assert leaves == sorted(leaves)
    assert sum(count(low, high) for low, high in leaves) == len(points)
    for low, high in leaves:
        size = high - low
        assert size.bit_count() == 1 and low % size == 0
        assert 0 < count(low, high) <= most or size == 1
        if high - low < 1 << 63:
            parent = low - low % (2 * size)
            assert count(parent, parent + 2 * size) > most


def test_a_box_of_the_lattice_contains_its_points(tmp_path):
    points = np.random.default_rng(0).random((3000, 3)) * [50, 20, 3]
    runs, _ = stored_runs(tmp_path / "runs", points)
    leaves = leaf_ranges(runs, 100)
    assert len(leaves) > 20
    for codes in leaves:
        low, high = runs.lattice.box(codes)
        found = runs.read([codes]).points
        assert (found >= low - 1e-9).all() and (found <= high + 1e-9).all()


def test_points_outside_the_lattice_share_its_outermost_cells():
    lattice = Lattice((0.0, 0.0, 0.0), 1.0)
    outside = lattice.codes(np.array([[-1e15, 5, 5], [1e15, 5, 5]]))
    assert outside.tolist() == lattice.codes(np.array([[0.0, 5, 5], [2**21 - 1.0, 5, 5]])).tolist()


def test_a_tile_of_many_runs_leaves_no_file_open(tmp_path):
    """A cloud in random order has points of all pieces in each tile: more pieces than a process may open files."""
    points = np.random.default_rng(0).random((800, 3))
    runs, _ = stored_runs(tmp_path / "runs", points, piece_points=4)
    assert len(runs.runs) == 200
    limits = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (100, limits[1]))
    try:
        found = runs.read([WHOLE])
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, limits)
    np.testing.assert_array_equal(found.points, points)


def test_no_runs_have_no_points(tmp_path):
    assert CloudRuns(tmp_path, Lattice((0, 0, 0), 1.0), ()).read([WHOLE]).points.shape == (0, 3)
