"""Tests of the files of large maps: tiles of points, their index, and overviews."""

import json

import numpy as np
import pytest
from optional import import_or_skip

from pcbench.geometry.crs import unnamed_grid
from pcbench.io import read_cloud
from pcbench.io.geotiff import read_geotiff
from pcbench.io.map_tiles import (
    MapOverview,
    map_tile_extension,
    read_overview,
    write_map_tile,
    write_overview,
    write_tile_index,
)
from pcbench.io.tiff import read_directory


def a_tile(offset=0.0, count=500):
    rng = np.random.default_rng(1)
    points = rng.uniform(0, 150, (count, 3)) + [500_000 + offset, 5_400_000, 100]
    return points, rng.uniform(0, 1, count), rng.normal(0, 1, count)


def test_a_tile_keeps_points_and_distances(tmp_path):
    import_or_skip("lazrs")
    points, distance, plane_distance = a_tile()
    assert map_tile_extension() == ".laz"
    write_map_tile(tmp_path / "tile_0000.laz", points, distance, plane_distance, crs="no system")
    read = read_cloud(tmp_path / "tile_0000.laz")
    np.testing.assert_allclose(read.points, points, atol=0.00005 + 1e-9)
    np.testing.assert_array_equal(read.attributes["distance"], distance.astype(np.float32))
    np.testing.assert_array_equal(read.attributes["plane_distance"], plane_distance.astype(np.float32))
    assert read.crs is None
    assert [path.name for path in tmp_path.iterdir()] == ["tile_0000.laz"]


def test_tiles_without_lazrs_are_not_compressed(monkeypatch, tmp_path):
    from pcbench.errors import MissingExtra
    from pcbench.io import map_tiles

    def missing(module):
        raise MissingExtra(module, "las")

    monkeypatch.setattr(map_tiles, "require", missing)
    path = tmp_path / f"tile{map_tile_extension()}"
    points, distance, _ = a_tile()
    write_map_tile(path, points, distance)
    assert path.suffix == ".las"
    assert set(read_cloud(path).attributes) >= {"distance"}
    assert "plane_distance" not in read_cloud(path).attributes


def test_the_index_lists_tiles_with_bounds_and_system(tmp_path):
    import_or_skip("lazrs")
    import_or_skip("pyproj")
    folder = tmp_path / "a_deviation"
    folder.mkdir()
    for k in (0, 1):
        points, distance, _ = a_tile(offset=200.0 * k)
        write_map_tile(folder / f"tile_{k:04}.laz", points, distance, crs="EPSG:25832")
    path = write_tile_index(folder, "EPSG:25832")
    assert path == tmp_path / "a_deviation.vpc"
    first, second = json.loads(path.read_text())["features"]
    assert first["assets"]["data"]["href"] == "./a_deviation/tile_0000.laz"
    assert (tmp_path / second["assets"]["data"]["href"]).is_file()
    assert second["properties"]["pc:count"] == 500
    assert 500_200 <= second["properties"]["proj:bbox"][0] < 500_210
    west, south = first["bbox"][:2]
    assert 8.9 < west < 9.1
    assert 48 < south < 49.5
    assert "25832" in first["properties"]["proj:wkt2"]


def test_there_is_no_index_without_tiles_or_system(tmp_path):
    (tmp_path / "maps").mkdir()
    assert write_tile_index(tmp_path / "maps", "EPSG:25832") is None
    write_map_tile(tmp_path / "maps" / "tile.las", *a_tile())
    assert write_tile_index(tmp_path / "maps", None) is None
    assert write_tile_index(tmp_path / "maps", unnamed_grid("m", "m")) is None  # a grid that is not on the Earth


@pytest.mark.parametrize("kind", ["distance", "completeness"])
def test_an_overview_is_read_back(tmp_path, kind):
    mean = np.array([[0.1, np.nan, 0.3], [0.2, 0.4, np.nan]])
    count = np.array([[7, 0, 3], [2, 1_000_000, 0]])
    overview = MapOverview(-mean, mean, 2 * mean, count, 10.0, 20.0, 0.25)
    path = write_overview(tmp_path, "a", overview, kind=kind, crs=None, unit="m")
    assert path == tmp_path / f"a_{kind}.tif"
    read = read_overview(path)
    np.testing.assert_array_equal(read.signed, -mean.astype(np.float32))
    np.testing.assert_array_equal(read.mean, mean.astype(np.float32))
    np.testing.assert_array_equal(read.largest, (2 * mean).astype(np.float32))
    np.testing.assert_array_equal(read.count, count)
    assert (read.west, read.north, read.pixel) == (10.0, 20.0, 0.25)
    texts = read_directory(path.read_bytes())[42112].decode()
    assert "above the reference, or in front of it" in texts
    assert f"the nearest point of the {'reference' if kind == 'distance' else 'candidate'}" in texts
    assert list(read_geotiff(path).bands) == ["signed", "mean", "largest", "count"]


def test_a_halved_overview_has_the_means_of_all_points():
    rng = np.random.default_rng(0)
    count = rng.integers(0, 4, (5, 7))
    mean = np.where(count > 0, rng.uniform(0, 1, count.shape), np.nan)
    signed = np.where(rng.random(count.shape) < 0.7, -mean, np.nan)  # unknown in some pixels
    found = MapOverview(signed, mean, 2 * mean, count, 10.0, 20.0, 0.25).halved()
    assert found.mean.shape == (3, 4)
    assert (found.west, found.north, found.pixel) == (10.0, 20.0, 0.5)
    assert found.count.sum() == count.sum()
    for row in range(3):
        for column in range(4):
            part = np.s_[2 * row : 2 * row + 2, 2 * column : 2 * column + 2]
            points = np.repeat(np.nan_to_num(mean[part]).ravel(), count[part].ravel())
            expected = (points.mean(), 2 * points.max()) if len(points) else (np.nan, np.nan)
            values = found.mean[row, column], found.largest[row, column]
            np.testing.assert_allclose(values, expected, rtol=1e-12)  # rounding of a few sums
            assert found.count[row, column] == len(points)
            values = np.repeat(signed[part].ravel(), count[part].ravel())
            values = values[np.isfinite(values)]
            expected = values.mean() if len(values) else np.nan
            np.testing.assert_allclose(found.signed[row, column], expected, rtol=1e-12)
