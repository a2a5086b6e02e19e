"""Writing LAS and LAZ: comparison with laspy, precision, and clouds that the format cannot store."""

import struct
from dataclasses import replace

import las_bytes
import numpy as np
import pytest
from optional import import_or_skip
from wording import check_error, check_text

from pcbench.geometry.cloud import Cloud
from pcbench.geometry.transform import Similarity
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


@pytest.mark.parametrize(("times", "is_standard"), [((0, 604_800), 0), ((2.5e8, 2.6e8), 1), ((-1.0, 5.0), 1)])
def test_the_header_says_what_gps_times_are(tmp_path, times, is_standard):
    write_cloud(tmp_path / "a.las", Cloud(np.eye(3)[:2], attributes={"gps_time": np.array(times, float)}))
    (encoding,) = struct.unpack_from("<H", (tmp_path / "a.las").read_bytes(), 6)
    assert encoding & 1 == is_standard


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
    [(0.0, 1e-4), (1e-3, 1e-10), (2.0, 1e-7), (99.0, 1e-6), (1e3, 1e-4), (4e5, 1e-4), (8e5, 2e-4), (6e6, 2e-3)],
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


LONGITUDES = [0.001, 0.001, 50], [-81, 40, 150]
STEPS = [  # half extents, centre, crs, largest movement in the unit of each axis
    (*LONGITUDES, "EPSG:4326", [1e-9, 1e-9, 1e-4]),
    (*LONGITUDES, None, [1e-9, 1e-9, 1e-4]),
    ([0.001, 0.001, 5e4], [-81, 40, 1e5], None, [1e-9, 1e-9, 1e-4]),  # larger heights
    ([5, 5, 50], [-81, 40, 150], "EPSG:4326", [5e-9, 5e-9, 1e-4]),  # a country, within a millimetre
    ([0.01] * 3, [5e5, 5.6e6, 100], None, [2e-9] * 3),  # a small part on a map grid: the digits of float64
    ([1e-6] * 3, [0, 0, 0], None, [1e-13] * 3),
    ([1, 0, 0], [-81, 40.123456789012, 123.456789012], None, [1e-7, 0, 0]),  # constant axes
    ([0, 0, 0], [-81.1234567890123, 40.1, 5e6 + 1 / 3], "EPSG:4326", [0, 0, 0]),
    ([2e6, 2e6, 100], [0, 0, 0], None, [1e-3, 1e-3, 1e-4]),  # no single step fits all three axes
]


@pytest.mark.parametrize(("half_extents", "centre", "crs", "largest"), STEPS)
def test_each_axis_has_a_step_that_is_fine_enough(tmp_path, half_extents, centre, crs, largest):
    if crs is not None:
        import_or_skip("pyproj")
    points = np.random.default_rng(0).uniform(-1, 1, (5000, 3)) * half_extents + centre
    write_cloud(tmp_path / "a.las", Cloud(points, crs=crs))
    moved = np.abs(read_cloud(tmp_path / "a.las").points - points).max(axis=0)
    assert (moved <= largest).all(), moved


@pytest.mark.parametrize("height", [-9999, -3.4e38, 1e30])
def test_rounding_to_more_than_the_spacing_is_refused(tmp_path, height):
    points = np.random.default_rng(0).uniform(-1, 1, (500, 3)) * [100, 100, 10]
    points[7, 2] = height
    if height == -9999:  # 32 bits suffice
        write_cloud(tmp_path / "a.las", points)
        assert np.abs(read_cloud(tmp_path / "a.las").points - points).max() <= 6e-5
    else:
        check_refusal(tmp_path / "a.las", Cloud(points))


def test_rounding_beyond_a_tenth_of_the_spacing_gives_a_warning(tmp_path):
    points = np.random.default_rng(0).uniform(-1, 1, (5000, 3)) * [100, 100, 10]
    points[7, 2] = 1e10
    notes = []
    write_cloud(tmp_path / "a.las", Cloud(points, unit="m"), on_warning=notes.append)
    assert len(notes) == 2  # the other one: LAS has no unit without a crs
    check_text(notes[0])
    with pytest.warns(UserWarning, match="LAS stores z in steps of 5"):
        write_cloud(tmp_path / "a.las", Cloud(points))


@pytest.mark.parametrize("scale", [0.01, 0.00025, 0.0078125, 3.048e-4, 1.7e-5])
def test_steps_of_the_source_are_kept(tmp_path, scale):
    """Coordinates keep their bits, also of a selection; a transformed cloud has other steps."""
    (tmp_path / "a.las").write_bytes(las_bytes.las(6, 50, scales=(scale, -scale, scale), offsets=(5e5, 0.25, 1e-3)))
    cloud = read_cloud(tmp_path / "a.las")
    write_cloud(tmp_path / "b.las", cloud.select(np.arange(0, 50, 2)))
    np.testing.assert_array_equal(read_cloud(tmp_path / "b.las").points, cloud.points[::2])
    moved = cloud.transformed(Similarity(np.eye(3), np.array([0.123456, 0, 0])))
    assert moved.stored is None
    write_cloud(tmp_path / "b.las", replace(moved, stored=cloud.stored))  # steps that do not fit are not used
    assert np.abs(read_cloud(tmp_path / "b.las").points - moved.points).max() <= 5e-4


def test_steps_in_which_numbers_exceed_32_bits_are_not_used(tmp_path):
    (tmp_path / "a.las").write_bytes(las_bytes.las(6, 50, scales=(0.001,) * 3, offsets=(0, 0, 0)))
    source = read_cloud(tmp_path / "a.las")
    for largest in (3e6, -3e6):  # 3e9 steps
        points = source.points.copy()
        points[0, 0] = largest
        write_cloud(tmp_path / "b.las", replace(source, points=points))
        assert np.abs(read_cloud(tmp_path / "b.las").points - points).max() <= 1e-3


def test_steps_of_tiles_are_kept(tmp_path):
    for k in range(2):
        data = las_bytes.las(6, 50, scales=(0.00025,) * 3, offsets=(1000 * k, 0, 0))
        (tmp_path / f"tile_{k}.las").write_bytes(data)
    cloud = read_cloud(tmp_path / "tile_*.las")
    write_cloud(tmp_path / "b.las", cloud)
    np.testing.assert_allclose(read_cloud(tmp_path / "b.las").points, cloud.points, rtol=1e-15, atol=1e-9)


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
