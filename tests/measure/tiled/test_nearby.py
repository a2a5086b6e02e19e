"""An index of a cloud in tiles against the index of the same points in memory."""

import numpy as np
import pytest
from tiled_clouds import ShuffledRunner, clouds_of_all_kinds, stored_tiles

from pcbench.geometry.neighbors import Index
from pcbench.geometry.normals import Surface
from pcbench.measure.tiled.nearby import TiledIndex, TiledSurface

CLOUDS = dict(clouds_of_all_kinds(np.random.default_rng(0), 700))


def tiled_index(folder, points, normals=None):
    tiles = stored_tiles(folder / "cloud", points, 100, piece_points=300)
    for number in tiles.occupied if normals is not None else ():
        np.save(tiles.file(number, tiles.normals), normals[tiles.load(number, "rows")])
    return TiledIndex(tiles, folder / "cloud.tiles", ShuffledRunner(None, folder), "cloud", "key")


@pytest.mark.parametrize("kind", CLOUDS)
def test_answers_are_those_of_the_complete_cloud(tmp_path, kind):
    """Queries move as a deformation is followed, so that earlier results answer some of them."""
    points = CLOUDS[kind]
    exact, found = Index(points), tiled_index(tmp_path, points)
    rng = np.random.default_rng(1)
    start = points[rng.integers(0, len(points), 60)]
    assert len(found) == len(points)
    for step, k in ((0, 1), (0.01, 1), (0.02, 9), (0.02, 9), (3.0, 1), (0.0, 20), (0.1, len(points))):
        places = start + step * rng.normal(size=start.shape)
        ours, theirs = found.query(places, k), exact.query(places, k)
        np.testing.assert_array_equal(ours.distances, theirs.distances)
        np.testing.assert_array_equal(found.rows[ours.indices], theirs.indices)
        np.testing.assert_array_equal(found.points[ours.indices], points[theirs.indices])
    np.testing.assert_array_equal(found.every(7), points[::7])
    thinned = found.thinned(0.3, 5)
    np.testing.assert_array_equal(thinned.query(start).distances, exact.thinned(0.3, 5).query(start).distances)


@pytest.mark.parametrize("kind", CLOUDS)
def test_planes_and_sampling_are_those_of_the_complete_cloud(tmp_path, kind):
    points = CLOUDS[kind]
    exact, found = Surface(Index(points), is_even=False), TiledSurface(tiled_index(tmp_path, points))
    rows = np.random.default_rng(2).integers(0, len(points), 50)
    numbers = found.index.numbers_of(points[np.unique(rows)], np.unique(rows), None)
    rows = np.unique(rows)
    assert found.sampling == exact.sampling and found.k == exact.k
    np.testing.assert_array_equal(found.normals(numbers), exact.normals(rows))
    np.testing.assert_array_equal(found.variation(numbers), exact.variation(rows))


def test_stored_normals_of_points_without_their_surroundings(tmp_path):
    """At points whose coordinates alone are in memory, the normals are those of the tiles, not of fitted planes."""
    rng = np.random.default_rng(3)
    points, normals = CLOUDS["flat"], rng.normal(size=(len(CLOUDS["flat"]), 3))
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    surface, rows = TiledSurface(tiled_index(tmp_path, points, normals=normals)), np.arange(0, len(points), 30)
    numbers = surface.index.numbers_of(points[rows], rows, None)
    np.testing.assert_array_equal(surface.normals(numbers), normals[rows])


def test_repeated_and_near_queries_search_no_tile(tmp_path):
    points = CLOUDS["flat"]
    found = tiled_index(tmp_path, points)
    places = points[::20]
    found.query(places, 20)
    found._runner.calls.clear()
    found.query(places, 20)
    found.query(places + 0.01)
    found.local_planes(20, found.query(places).indices)
    assert found._runner.calls == []
