"""Tests of GeoTIFF: other readers find the values, places and systems that were written."""

import io
import struct

import numpy as np
import pytest
from optional import import_or_skip

from pcbench.errors import InputError
from pcbench.io.geotiff import Raster, read_geotiff, write_geotiff


def a_raster(height=300, width=500, crs="EPSG:25832"):
    values = np.random.default_rng(0).normal(0, 1, (2, height, width)).astype(np.float32)
    values[:, : height // 4, : width // 3] = np.nan
    return Raster({"mean": values[0], "count & more": values[1]}, 500_000.25, 5_400_000.5, 0.5, crs)


@pytest.mark.parametrize("size", [(300, 500), (1, 1), (1, 70_000), (1000, 3)])
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
        page = file.pages[0]
        values = file.asarray()
    np.testing.assert_array_equal(values, np.stack(list(raster.bands.values())))
    assert page.tags["ModelPixelScaleTag"].value == (0.5, 0.5, 0.0)
    assert page.tags["ModelTiepointTag"].value[3:5] == (500_000.25, 5_400_000.5)
    assert page.tags["GDAL_NODATA"].value == "nan"


@pytest.mark.parametrize(
    ("crs", "model", "key", "code"),
    [
        ("EPSG:25832", 1, 3072, 25832),
        ("EPSG:25832+5783", 1, 3072, 25832),  # distances have no heights: only the plane counts
        ("EPSG:4326", 2, 2048, 4326),
    ],
)
def test_systems_are_written_as_their_codes(tmp_path, crs, model, key, code):
    import_or_skip("pyproj")
    write_geotiff(tmp_path / "a.tif", a_raster(crs=crs))
    keys = struct.pack("<16H", 1, 1, 0, 3, 1024, 0, 1, model, 1025, 0, 1, 1, key, 0, 1, code)
    assert keys in (tmp_path / "a.tif").read_bytes()


@pytest.mark.parametrize("crs", [None, "EPSG:4978", "a local grid"])
def test_systems_without_a_code_in_the_plane_are_left_out(tmp_path, crs):
    write_geotiff(tmp_path / "a.tif", a_raster(crs=crs))
    assert read_geotiff(tmp_path / "a.tif").crs is None
    assert struct.pack("<HH", 34735, 3) not in (tmp_path / "a.tif").read_bytes()


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
        (257, 8, 290),  # fewer rows than the strips have
        (278, 8, 1),  # rows of a strip: strips are missing
        (278, 8, 0),
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
