"""Tests of GeoTIFF: other readers find the values, places and systems that were written."""

import io
import struct
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from optional import import_or_skip

from pcbench.errors import InputError
from pcbench.geometry import crs as crs_texts
from pcbench.geometry.crs import unnamed_grid
from pcbench.io import geotiff
from pcbench.io.geotiff import BandText, Raster, halved, read_geotiff, write_geotiff
from pcbench.io.tiff import read_directory


def a_raster(height=300, width=500, crs="EPSG:25832"):
    values = np.random.default_rng(0).normal(0, 1, (2, height, width)).astype(np.float32)
    values[:, : height // 4, : width // 3] = np.nan
    return Raster({"mean": values[0], "count & more": values[1]}, 500_000.25, 5_400_000.5, 0.5, crs)


@pytest.mark.parametrize("size", [(300, 500), (1, 1), (1, 1000), (1000, 3), (600, 513)])
def test_a_raster_is_read_back(tmp_path, size):
    raster = a_raster(*size)
    write_geotiff(tmp_path / "a.tif", raster)
    read = read_geotiff(tmp_path / "a.tif")
    assert (read.west, read.north, read.pixel, read.shape) == (500_000.25, 5_400_000.5, 0.5, size)
    for name, values in read.bands.items():
        np.testing.assert_array_equal(values, raster.bands[name])


def test_pillow_reads_one_band(tmp_path):
    import_or_skip("PIL")
    from PIL import Image

    raster = a_raster()
    write_geotiff(tmp_path / "a.tif", Raster({"mean": raster.bands["mean"]}, 0.0, 0.0, 1.0))
    with Image.open(io.BytesIO((tmp_path / "a.tif").read_bytes())) as image:
        np.testing.assert_array_equal(np.asarray(image), raster.bands["mean"])


def test_tifffile_reads_all_bands_and_places(tmp_path):
    tifffile = pytest.importorskip("tifffile")
    raster = a_raster()
    write_geotiff(tmp_path / "a.tif", raster)
    with tifffile.TiffFile(tmp_path / "a.tif") as file:
        tags, values = file.pages[0].tags, file.asarray()
        assert tags["ModelPixelScaleTag"].value == (0.5, 0.5, 0.0)
        assert tags["ModelTiepointTag"].value[3:5] == (500_000.25, 5_400_000.5)
        assert tags["GDAL_NODATA"].value == "nan"
    np.testing.assert_array_equal(values, np.stack(list(raster.bands.values())))


def keys_of(path):
    """Return the values of the GeoTIFF keys of a file, and their texts."""
    tags = read_directory(path.read_bytes())
    entries = np.reshape(tags.get(34735, ())[4:], (-1, 4)).tolist()
    texts = tags.get(34737, b"").decode()
    return {key: texts[value : value + count - 1] if tag else value for key, tag, count, value in entries}


@pytest.mark.parametrize(
    ("crs", "keys"),
    [
        ("EPSG:25832", {1024: 1, 3072: 25832}),
        ("EPSG:25832+7837", {1024: 1, 3072: 25832, 4096: 7837}),
        ("EPSG:2229+6360", {1024: 1, 3072: 2229, 4096: 6360}),  # feet
        ("EPSG:4326", {1024: 2, 2048: 4326}),
    ],
)
def test_systems_are_written_as_their_codes(tmp_path, crs, keys):
    import_or_skip("pyproj")
    write_geotiff(tmp_path / "a.tif", a_raster(4, 5, crs=crs))
    assert keys_of(tmp_path / "a.tif") == keys | {1025: 1}


@pytest.mark.parametrize(
    ("crs", "start"),
    [
        ("+proj=lcc +lat_1=40 +lat_2=42 +lat_0=39 +lon_0=-100 +datum=NAD83 +units=us-ft +type=crs", "PROJCS["),
        ("+proj=tmerc +lat_0=10 +lon_0=20 +k=0.9999 +x_0=1000 +ellps=bessel +towgs84=1,2,3 +type=crs", "PROJCS["),
        ("+proj=longlat +a=6378000 +rf=298 +type=crs", "GEOGCS["),
        ("+proj=ob_tran +o_proj=longlat +o_lat_p=30 +lon_0=10 +type=crs", "GEOGCRS["),  # no WKT 1 has a word for it
        (unnamed_grid("ft", "ft"), "LOCAL_CS["),
        (unnamed_grid("ft", "m"), "ENGCRS["),
    ],
)
def test_systems_without_codes_are_written_as_wkt(tmp_path, crs, start):
    pyproj = import_or_skip("pyproj")
    write_geotiff(tmp_path / "a.tif", a_raster(4, 5, crs=crs))
    keys = keys_of(tmp_path / "a.tif")
    mark, equals, wkt = keys[3073].partition(" = ")
    assert (keys[1024], mark, equals) == (32767, "ESRI PE String", " = ")
    assert wkt.startswith(start)
    assert pyproj.CRS.from_wkt(wkt).equals(pyproj.CRS.from_user_input(crs), ignore_axis_order=True)


@pytest.mark.parametrize("crs", [None, "EPSG:4978", "a local grid"])
def test_unknown_and_geocentric_systems_are_left_out(tmp_path, crs):
    write_geotiff(tmp_path / "a.tif", a_raster(4, 5, crs=crs))
    assert keys_of(tmp_path / "a.tif") == {}


def test_without_pyproj_a_raster_has_a_place_and_no_system(tmp_path, monkeypatch):
    monkeypatch.setattr(crs_texts, "parse_crs", lambda text: None)
    write_geotiff(tmp_path / "a.tif", a_raster(4, 5))
    assert keys_of(tmp_path / "a.tif") == {}


def test_rasterio_reads_values_texts_and_overviews(tmp_path):
    rasterio = pytest.importorskip("rasterio", reason="needs rasterio, which reads files as GDAL and QGIS do")
    texts = {"count & more": BandText("Number of points, <&>.", "1/m²", "max")}
    raster = replace(a_raster(700, 1300), texts=texts)
    write_geotiff(tmp_path / "a.tif", raster)
    with rasterio.open(tmp_path / "a.tif") as file:
        np.testing.assert_array_equal(file.read(), list(raster.bands.values()))
        assert (file.descriptions, file.units) == (tuple(raster.bands), (None, "1/m²"))
        assert file.tags(2)["DEFINITION"] == "Number of points, <&>."
        assert (file.crs.to_epsg(), file.bounds[0], file.bounds[3]) == (25832, 500_000.25, 5_400_000.5)
        assert file.overviews(1) == [2, 4]
        assert np.isnan(file.nodata)
    with rasterio.open(tmp_path / "a.tif", overview_level=0) as file:
        np.testing.assert_array_equal(file.read(2), halved(raster.bands["count & more"], "max"))


@pytest.mark.parametrize("is_big", [False, True])
def test_directories_and_overviews_come_before_the_full_raster(tmp_path, monkeypatch, is_big):
    """These are the checks of GDAL's validate_cloud_optimized_geotiff."""
    tifffile = pytest.importorskip("tifffile")
    monkeypatch.setattr(geotiff, "_TILE", 32)
    monkeypatch.setattr(geotiff, "_SMALL_TILE", 16)
    if is_big:
        monkeypatch.setattr(geotiff, "_MAX_CLASSIC_BYTES", 0)
    raster = a_raster(70, 130)
    write_geotiff(tmp_path / "a.tif", raster)
    with tifffile.TiffFile(tmp_path / "a.tif") as file:
        pages = list(file.pages)
        read = [page.asarray() for page in pages]
        assert file.is_bigtiff == is_big
    assert [page.shape[1:] for page in pages] == [(70, 130), (35, 65), (18, 33), (9, 17)]
    assert [page.subfiletype for page in pages] == [0, 1, 1, 1]
    assert all(page.is_tiled and (page.tilewidth, page.tilelength) == (32, 32) for page in pages)
    directories = [page.offset for page in pages]
    first_tiles = [page.dataoffsets[0] for page in pages]
    assert directories == sorted(directories)
    assert first_tiles == sorted(first_tiles, reverse=True)
    assert directories[-1] < first_tiles[-1]
    np.testing.assert_array_equal(read[0], list(raster.bands.values()))
    for finer, coarser in pairwise(read):
        np.testing.assert_array_equal(coarser, [halved(band, "mean") for band in finer])
    for name, values in read_geotiff(tmp_path / "a.tif").bands.items():
        np.testing.assert_array_equal(values, raster.bands[name])


def test_a_halved_raster_has_the_values_that_there_are():
    nan = np.nan
    values = np.array([[1, 2, nan, 5], [3, 6, nan, nan], [nan, nan, -4, -2]])
    np.testing.assert_array_equal(halved(values, "mean"), [[3, 5], [nan, -3]])
    np.testing.assert_array_equal(halved(values, "max"), [[6, 5], [nan, -2]])
    assert np.isnan(halved(np.full((1, 1), nan), "mean")).all()


def test_rasters_without_pixels_are_refused(tmp_path):
    with pytest.raises(InputError, match="bands of one shape and square pixels"):
        write_geotiff(tmp_path / "a.tif", Raster({"mean": np.zeros((0, 3), np.float32)}, 0.0, 0.0, 1.0))
    with pytest.raises(InputError, match="bands of one shape"):
        write_geotiff(tmp_path / "a.tif", Raster({"a": np.zeros((2, 3)), "b": np.zeros((3, 2))}, 0.0, 0.0, 1.0))
    assert not (tmp_path / "a.tif").exists()


@pytest.mark.parametrize("damage", [b"", b"II*\0", b"no tiff at all, but long enough for a header"])
def test_damaged_files_are_refused(tmp_path, damage):
    (tmp_path / "a.tif").write_bytes(damage)
    with pytest.raises(InputError, match=r"a\.tif: expected a GeoTIFF"):
        read_geotiff(tmp_path / "a.tif")


def test_a_truncated_file_is_refused(tmp_path):
    write_geotiff(tmp_path / "a.tif", a_raster())
    data = (tmp_path / "a.tif").read_bytes()
    (tmp_path / "a.tif").write_bytes(data[: len(data) - 700])
    with pytest.raises(InputError, match=r"a\.tif: expected a GeoTIFF"):
        read_geotiff(tmp_path / "a.tif")


@pytest.mark.parametrize(
    ("tag", "place", "value"),
    [
        (257, 8, 2**31),  # rows: more than memory holds
        (257, 8, 700),  # more rows than the tiles have
        (322, 8, 0),  # width of a tile
        (323, 8, 128),  # height of a tile
        (277, 8, 1),  # bands
        (256, 2, 77),  # a kind of values that does not exist
        (42112, 4, 1),  # names of the bands are cut off
    ],
)
def test_damaged_tags_are_refused(tmp_path, tag, place, value):
    path = tmp_path / "a.tif"
    write_geotiff(path, a_raster())
    data = bytearray(path.read_bytes())
    (start,) = struct.unpack_from("<I", data, 4)
    (count,) = struct.unpack_from("<H", data, start)
    entries = (start + 2 + 12 * number for number in range(count))
    entry = next(entry for entry in entries if struct.unpack_from("<H", data, entry) == (tag,))
    struct.pack_into("<H" if place == 2 else "<I", data, entry + place, value)
    path.write_bytes(data)
    with pytest.raises(InputError, match=r"a\.tif: expected a GeoTIFF of pcbench: .+"):
        read_geotiff(path)
