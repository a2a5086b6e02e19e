"""Writing LAS and LAZ: comparison with laspy, precision, and clouds that the format cannot store."""

import struct

import numpy as np
import pytest
from optional import import_or_skip
from wording import check_error, check_text

from pcbench.geometry.cloud import Cloud
from pcbench.io import read_cloud, write_cloud


def full_cloud(count=500, seed=1):
    rng = np.random.default_rng(seed)
    return Cloud(
        rng.normal(size=(count, 3)) * [300, 300, 20] + [5e5, 4e6, 100],
        normals=rng.normal(size=(count, 3)),
        colors=rng.integers(0, 256, (count, 3), dtype=np.uint8),
        attributes={
            "intensity": rng.integers(0, 65536, count),
            "classification": rng.integers(0, 256, count, dtype=np.uint8),
            "return_number": rng.integers(1, 4, count),
            "number_of_returns": np.full(count, 3),
            "gps_time": rng.random(count) * 1e9,
            "point_source_id": rng.integers(0, 9, count).astype(np.float32),
            "confidence": rng.random(count).astype(np.float32),
            "Größe": rng.random(count),
            "id": rng.integers(-(2**62), 2**62, count),
            "flag": rng.random(count) < 0.5,
            "half": rng.random(count).astype(np.float16),
            "big": np.arange(count, dtype=">u2"),
        },
        crs="EPSG:32617",
        unit="m",
    )


@pytest.mark.parametrize("extension", [".las", ".laz", ".LAZ"])
def test_round_trip(tmp_path, extension):
    laspy = import_or_skip("laspy")
    import_or_skip("pyproj")
    import_or_skip("lazrs")
    cloud, path = full_cloud(), tmp_path / f"a{extension}"
    write_cloud(path, cloud)
    assert [p.name for p in tmp_path.iterdir()] == [path.name]
    result = read_cloud(path)
    assert np.abs(result.points - cloud.points).max() <= 5.1e-5  # half the scale, and rounding at 4e6
    np.testing.assert_array_equal(result.normals, cloud.normals.astype(np.float32))
    np.testing.assert_array_equal(result.colors, cloud.colors)
    assert result.attributes.keys() == cloud.attributes.keys()
    for name, values in cloud.attributes.items():
        np.testing.assert_array_equal(result.attributes[name], values)
    assert (result.crs, result.unit) == ("EPSG:32617", "m")

    laspy_file = laspy.read(path)
    np.testing.assert_array_equal(np.stack([laspy_file.x, laspy_file.y, laspy_file.z], axis=1), result.points)
    assert laspy_file.header.parse_crs().to_epsg() == 32617
    np.testing.assert_array_equal(laspy_file.header.mins, result.points.min(axis=0))
    np.testing.assert_array_equal(laspy_file.header.maxs, result.points.max(axis=0))
    counts = np.bincount(cloud.attributes["return_number"], minlength=16)[1:]
    np.testing.assert_array_equal(laspy_file.header.number_of_points_by_return, counts)
    for name in ("id", "confidence", "intensity", "gps_time", "return_number"):
        np.testing.assert_array_equal(laspy_file[name], cloud.attributes[name])
    np.testing.assert_array_equal(laspy_file.red, cloud.colors[:, 0] * np.uint16(257))


def test_equal_clouds_give_equal_bytes(tmp_path):
    cloud = Cloud(np.random.default_rng(3).normal(size=(100, 3)))
    for name in ("a.las", "b.las"):
        write_cloud(tmp_path / name, cloud)
    assert (tmp_path / "a.las").read_bytes() == (tmp_path / "b.las").read_bytes()


@pytest.mark.parametrize(
    ("extent", "scale"),
    [(0.0, 1e-4), (1e-3, 1e-9), (2.0, 1e-6), (99.0, 1e-5), (1e3, 1e-4), (4e5, 1e-4), (8e5, 2e-4)],
)
@pytest.mark.parametrize("centre", [0.0, 0.499, -5e6 + 0.5])
def test_precision_follows_the_extent(tmp_path, extent, scale, centre):
    points = np.random.default_rng(1).uniform(-0.5, 0.5, (50, 3)) * extent + centre
    points[:2] = [[centre - extent / 2] * 3, [centre + extent / 2] * 3]
    write_cloud(tmp_path / "a.las", Cloud(points))
    assert struct.unpack_from("<d", (tmp_path / "a.las").read_bytes(), 131) == (scale,)
    rounding = 4 * np.spacing(np.abs(points).max())
    assert np.abs(read_cloud(tmp_path / "a.las").points - points).max() <= scale / 2 + rounding


def test_tiny_extent(tmp_path):
    write_cloud(tmp_path / "a.las", Cloud(np.array([[0.0] * 3, [1e-320] * 3])))
    assert read_cloud(tmp_path / "a.las").points.tolist() == [[0.0] * 3] * 2


def test_decimal_coordinates_are_exact(tmp_path):
    """Coordinates in hundredths are multiples of the finer step, so they are written exactly."""
    points = np.round(np.random.default_rng(2).uniform(0, 1000, (200, 3)), 2) + [636_000, 849_000, 0]
    write_cloud(tmp_path / "a.las", Cloud(points))
    np.testing.assert_allclose(read_cloud(tmp_path / "a.las").points, points, rtol=0, atol=1e-9)


def check_refusal(path, cloud):
    with check_error():
        write_cloud(path, cloud)
    assert not path.exists()


def test_extent_beyond_32_bits(tmp_path):
    for half_extent in (1e6, 1e90):
        cloud = Cloud(np.array([[-half_extent] * 3, [half_extent] * 3]))
        check_refusal(tmp_path / "a.las", cloud)


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("a", ["word"]),
        ("a", [1j]),
    ],
)
def test_attributes_that_las_cannot_store(tmp_path, name, values):
    cloud = Cloud(np.zeros((1, 3)), attributes={name: np.array(values)})
    check_refusal(tmp_path / "a.las", cloud)


@pytest.mark.parametrize(
    ("name", "value"), [("intensity", 0.5), ("intensity", 70000), ("return_number", 16), ("classification", np.nan)]
)
def test_values_that_a_standard_dimension_cannot_hold_are_extra_bytes(tmp_path, name, value):
    notes = []
    write_cloud(tmp_path / "a.las", Cloud(np.zeros((1, 3)), attributes={name: [value]}), on_warning=notes.append)
    check_text(*notes)
    assert read_cloud(tmp_path / "a.las").attributes[f"{name}_"].tolist() == pytest.approx([value], nan_ok=True)


def test_clouds_that_las_cannot_store(tmp_path):
    cloud = Cloud(np.zeros((1, 3)), attributes={f"a{k}": np.zeros(1) for k in range(400)})
    check_refusal(tmp_path / "a.las", cloud)
    check_refusal(tmp_path / "a.copc.laz", Cloud(np.zeros((1, 3))))
