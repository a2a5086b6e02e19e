"""Exact search over tiles: the neighbours are those of one index over all points, in all bits, for any tiles."""

import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from tiled_clouds import clouds_of_all_kinds, stored_tiles

from pcbench.geometry.neighbors import Index
from pcbench.measure.tiled.search import nearest_in_tiles


def check(queries, points, tiles, k=1, max_distance=np.inf):
    found = nearest_in_tiles(queries, tiles, k, max_distance)
    expected = Index(points).query(queries, k)
    distances, rows = (part.reshape(len(queries), k) for part in expected)
    near = distances <= max_distance
    np.testing.assert_array_equal(found.distances, np.minimum(distances, max_distance))
    np.testing.assert_array_equal(found.rows[near], rows[near])
    assert (found.tiles[~near] == -1).all()
    at = found.column(tiles, "points")
    np.testing.assert_array_equal(at[near], points[rows[near]])
    assert np.isnan(at[~near]).all()


@settings(max_examples=8, deadline=None, phases=[Phase.explicit, Phase.generate])
@given(
    seed=st.integers(0, 2**32),
    count=st.integers(1, 400),
    kind=st.integers(0, 8),
    most=st.sampled_from([20, 100, 1000]),
    piece_points=st.sampled_from([50, 300, 1000]),
    k=st.sampled_from([1, 2, 20]),
    reach=st.sampled_from([np.inf, 0.3, 0.0]),
)
def test_neighbors_are_those_of_one_index(tmp_path_factory, seed, count, kind, most, piece_points, k, reach):
    rng = np.random.default_rng(seed)
    _, points = list(clouds_of_all_kinds(rng, count))[kind]
    if not len(points):
        return
    _, queries = list(clouds_of_all_kinds(rng, 100))[rng.integers(9)]
    queries = np.concatenate([queries, points[:50]])
    tiles = stored_tiles(tmp_path_factory.mktemp("tiles"), points, most, piece_points=piece_points)
    assert tiles.counts.sum() == len(points)
    check(queries, points, tiles, min(k, len(points)), reach)


def test_of_equal_distances_the_first_row_is_found(tmp_path):
    # Four points at the same distance from each query, in different tiles; their order in the file is random.
    grid = np.stack(np.meshgrid(np.arange(9.0), np.arange(9.0), [0.0]), axis=-1).reshape(-1, 3)
    points = np.random.default_rng(0).permutation(grid)
    queries = grid[(grid < 8)[:, :2].all(axis=1)] + [0.5, 0.5, 0]
    for most in (3, 1000):
        check(queries, points, stored_tiles(tmp_path / str(most), points, most, piece_points=50), k=2)


def test_a_maximum_distance_is_inclusive(tmp_path):
    points = np.array([[0.0, 0, 0], [5.0, 0, 0]])
    tiles = stored_tiles(tmp_path, points, 1)
    found = nearest_in_tiles(np.array([[2.0, 0, 0], [7.5, 0, 0]]), tiles, 1, 2.0)
    assert found.distances.tolist() == [[2.0], [2.0]]
    assert found.tiles.tolist() == [[0], [-1]]


def test_a_cloud_beyond_the_maximum_distance_has_no_neighbors(tmp_path):
    points = np.random.default_rng(0).random((50, 3))
    check(points + 9, points, stored_tiles(tmp_path, points, 20), k=2, max_distance=1.0)


def test_no_queries_give_no_neighbors(tmp_path):
    tiles = stored_tiles(tmp_path, np.random.default_rng(0).random((30, 3)), 10)
    found = nearest_in_tiles(np.zeros((0, 3)), tiles, 2)
    assert found.distances.shape == found.rows.shape == (0, 2)
    assert found.column(tiles, "points").shape == (0, 2, 3)


@pytest.mark.parametrize("ratio", [1000, 1 / 1000])
def test_a_search_reads_few_tiles(tmp_path, monkeypatch, ratio):
    """A dense cloud beside a sparse one: a query reads its own tile and few others, whatever the density."""
    rng = np.random.default_rng(0)
    sparse, dense = rng.random((30, 3)) * [100, 100, 0], rng.random((30_000, 3)) * [100, 100, 0]
    points, queries = (dense, sparse) if ratio > 1 else (sparse, dense)
    tiles = stored_tiles(tmp_path, points, max(1, len(points) // 30))
    read = []
    load = type(tiles).load
    monkeypatch.setattr(
        type(tiles), "load", lambda self, number, column: read.append(number) or load(self, number, column)
    )
    check(queries[:1], points, tiles)
    assert len(read) <= 4 < len(tiles) / 5
