"""Clouds in other units and coordinate systems."""

import numpy as np
import pytest
from optional import break_library, import_or_skip
from wording import check_error, check_text

from pcbench.errors import MissingExtra
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.crs import axis_units, degrees_hint, is_geographic_crs, suggested_crs, with_units
from pcbench.geometry.reprojection import convert_unit, project

PLACE = np.array([[-81.0, 40.0, 100.0], [-81.001, 40.002, 130.0], [-80.999, 40.001, 90.0]])
# Karney, "Transverse Mercator with an accuracy of a few nanometers", 2011: the central meridian of zone 17 is -81.
CENTRAL_NORTHING = 4_427_757.219


def test_projection_to_utm():
    pyproj = import_or_skip("pyproj")
    attributes, colors = {"a": np.arange(3)}, np.arange(9, dtype=np.uint8).reshape(3, 3)
    notes = []
    cloud = Cloud(PLACE, np.eye(3), colors, attributes, crs="EPSG:4326", unit="deg")
    found = project(cloud, "EPSG:32617", on_warning=notes.append)
    assert (found.crs, found.unit, found.normals, found.stored) == ("EPSG:32617", "m", None, None)
    np.testing.assert_allclose(found.points[0], [500_000, CENTRAL_NORTHING, 100], atol=1e-3)
    np.testing.assert_array_equal(found.colors, colors)
    np.testing.assert_array_equal(found.attributes["a"], attributes["a"])
    assert len(notes) == 1
    check_text(notes[0])
    # Distances on the ellipsoid differ from those on the grid by its scale, 0.9996 on the central meridian.
    along = pyproj.Geod(ellps="WGS84").inv(*PLACE[0, :2], *PLACE[1, :2])[2]
    assert np.linalg.norm(found.points[1, :2] - found.points[0, :2]) == pytest.approx(0.9996 * along, rel=1e-6)


HEIGHTS = [  # source, target, factor of the heights, unit, units of the axes
    ("EPSG:26917", "EPSG:32617", 1, "m", ("m", None)),
    ("EPSG:26917+6360", "EPSG:26917", 1200 / 3937, "m", ("m", "m")),  # US survey feet
    ("EPSG:26917+6360", "EPSG:26917+5703", 1200 / 3937, "m", ("m", "m")),
    ("EPSG:26917+5703", "EPSG:3734", 3937 / 1200, "US-ft", ("US-ft", "US-ft")),
    ("EPSG:4326", "EPSG:3734", 3937 / 1200, "US-ft", ("US-ft", None)),
    ("EPSG:4979", "EPSG:32617", 1, "m", ("m", None)),
]


@pytest.mark.parametrize(("source", "target", "factor", "unit", "units"), HEIGHTS)
def test_heights_get_the_unit_of_the_new_system(source, target, factor, unit, units):
    import_or_skip("pyproj")
    in_degrees = source.startswith("EPSG:4")
    points = PLACE if in_degrees else PLACE + [500_081, 4_427_700, 0]
    found = project(Cloud(points, crs=source), target)
    np.testing.assert_allclose(found.points[:, 2], PLACE[:, 2] * factor, rtol=1e-12)
    assert (found.unit, axis_units(found.crs)) == (unit, units)


def test_geocentric_coordinates_become_heights():
    import_or_skip("pyproj")
    a = 6_378_137.0
    points = np.array([[a + 100, 0, 0], [a + 3, 0, 0]])
    found = project(Cloud(points, crs="EPSG:4978"), "EPSG:32631")
    np.testing.assert_allclose(found.points[:, 2], [100, 3], atol=1e-6)


def test_convert_unit_of_x_y_and_z():
    import_or_skip("pyproj")
    normals = np.array([[0, 0, 1.0], [1, 0, 0], [0.6, 0, 0.8]])
    cloud = Cloud(np.full((3, 3), 3937.0), normals, crs="EPSG:26917+6360")
    found = convert_unit(cloud, "m")
    np.testing.assert_allclose(found.points, [[3937, 3937, 1200]] * 3, rtol=1e-15)
    assert (found.unit, axis_units(found.crs)) == ("m", ("m", "m"))
    steep = np.array([0.6, 0, 0.8 * 3937 / 1200])  # normals of a surface that is flatter now
    np.testing.assert_allclose(found.normals[2], steep / np.linalg.norm(steep), rtol=1e-12)
    back = convert_unit(convert_unit(cloud, "ft"), "m")
    np.testing.assert_allclose(back.points, found.points, rtol=1e-14)
    np.testing.assert_allclose(convert_unit(Cloud(np.ones((1, 3)), unit="mm"), "m").points, 1e-3)


def test_conversions_that_make_no_sense_are_refused():
    import_or_skip("pyproj")
    degrees, unknown = Cloud(PLACE, crs="EPSG:4326"), Cloud(PLACE)
    for convert in (
        lambda: convert_unit(degrees, "m"),
        lambda: convert_unit(unknown, "m"),
        lambda: convert_unit(degrees, "parsec"),
        lambda: project(unknown, "EPSG:32617"),
        lambda: project(degrees, "EPSG:32617", "EPSG:4326"),
        lambda: project(degrees, "the village"),
        lambda: project(degrees, "EPSG:4978"),
        lambda: project(degrees, "EPSG:32617+5703"),
        lambda: project(Cloud(PLACE * [1, 9, 1], crs="EPSG:4326"), "EPSG:32617"),
    ):
        with check_error():
            convert()


def test_without_pyproj(tmp_path, monkeypatch):
    break_library(monkeypatch, tmp_path / "packages", "pyproj", None)
    for convert in (
        lambda: project(Cloud(PLACE, crs="EPSG:4326"), "EPSG:32617"),
        lambda: convert_unit(Cloud(PLACE, crs="EPSG:32617", unit="m"), "ft"),
    ):
        with pytest.raises(MissingExtra):
            convert()
    assert convert_unit(Cloud(PLACE, unit="m"), "ft").unit == "ft"
    assert is_geographic_crs("EPSG:4326")
    assert is_geographic_crs('GEOGCS["WGS 84",DATUM["WGS_1984"]]')
    assert not is_geographic_crs("EPSG:32617")


@pytest.mark.parametrize(
    ("crs", "longitude", "latitude", "code"),
    [
        ("EPSG:4326", -81.0, 40.0, 32617),
        ("EPSG:4326", 10.0, -40.0, 32732),
        ("EPSG:4269", -81.0, 40.0, 26917),  # the datum of the cloud
        (None, 179.99, 10.0, 32660),
        (None, 0.0, 89.0, 5041),
    ],
)
def test_suggested_system(crs, longitude, latitude, code):
    import_or_skip("pyproj")
    assert suggested_crs(crs, longitude, latitude) == f"EPSG:{code}"


def test_units_of_a_system_can_be_changed():
    import_or_skip("pyproj")
    feet = with_units("EPSG:26917+5703", "US-ft", "ft")
    assert axis_units(feet) == ("US-ft", "ft")
    assert axis_units(with_units(feet, "m", "m")) == ("m", "m")


@pytest.mark.parametrize(
    ("low", "high", "hinted"),
    [
        ([-81.001, 39.999, 100], [-80.999, 40.001, 200], True),
        ([10.0, 48.0, 300], [10.1, 48.1, 500], True),
        ([0, 0, 0], [0.3, 0.3, 5], False),  # a pole
        ([4, 3, 0], [4.1, 3.1, 50], False),  # a borehole
        ([-0.001, -0.001, 0], [0.001, 0.001, 9], False),  # a wire at the origin
        ([500_000, 5e6, 0], [500_000.001, 5e6, 9], False),
        ([-81, 40, 0], [-81, 40, 9], False),  # a line
    ],
)
def test_clouds_that_look_like_degrees(low, high, hinted):
    line = degrees_hint(np.array(low, float), np.array(high, float))
    assert (line is not None) == hinted
