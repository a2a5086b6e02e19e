"""Coordinate systems and units that a user states, and conversions of units."""

import numpy as np
import pytest
from optional import break_library, import_or_skip
from wording import check_error, check_text

from pcbench.errors import MissingExtra
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.crs import axis_units, crs_name
from pcbench.geometry.removal import without_duplicates, without_zeros
from pcbench.geometry.stated_system import convert_unit, scale_coordinates, state_crs, state_unit

OHIO = np.array([[500_000.0, 4_427_757.0, 100.0], [500_100.0, 4_427_800.0, 130.0]])  # in UTM zone 17


def silent(line):
    """Fail on a warning."""
    raise AssertionError(line)


STATED = [  # what the file states, the system of the user, its unit, number of warnings
    (None, None, "EPSG:26917", "m", 0),
    (None, "ft", "EPSG:26917", "m", 1),
    ("EPSG:26917", "m", "EPSG:26917+5703", "m", 0),  # heights are added
    ("EPSG:26917", "m", "EPSG:26917+6360", None, 1),  # the unit of z is another one, so distances have none
    ("EPSG:26917+5703", "m", "EPSG:26917", "m", 1),
    ("EPSG:32617", "m", "EPSG:32617+4979", "m", 0),
    ("EPSG:32617", "m", "EPSG:26917", "m", 1),
    (None, None, "EPSG:3734", "US-ft", 1),  # 4,427,757 ft is far to the north
    ("a grid of the site", "m", "EPSG:26917", "m", 1),
]


@pytest.mark.parametrize(("file", "unit", "crs", "expected", "warnings"), STATED)
def test_stated_system(file, unit, crs, expected, warnings):
    import_or_skip("pyproj")
    notes = []
    found = state_crs(Cloud(OHIO, crs=file, unit=unit), crs, notes.append)
    np.testing.assert_array_equal(found.points, OHIO)
    assert (found.crs, found.unit, len(notes)) == (crs, expected, warnings)
    if notes:
        check_text("\n".join(notes))


UNITS = [  # what the file states, units of the user, units of the axes or the unit, number of warnings
    ((None, None), ("ft", None), "ft", 0),
    ((None, "m"), ("feet", None), "ft", 1),
    ((None, None), ("ft", "m"), ("ft", "m"), 0),
    ((None, "ft"), (None, "m"), ("ft", "m"), 1),
    ((None, None), ("US-ft", "ftus"), "US-ft", 0),
    (("EPSG:26917+6360", None), ("m", None), ("m", "m"), 1),
    (("EPSG:26917+6360", None), (None, "m"), ("m", "m"), 1),
    (("EPSG:26917", "m"), (None, "ft"), ("m", "ft"), 1),
    (("EPSG:26917", "m"), ("ft", None), ("ft", None), 1),
    (("EPSG:4326", None), (None, "ft"), ("deg", "ft"), 0),
    (("EPSG:4979", None), (None, "ft"), ("deg", "ft"), 1),
    (("EPSG:4978", "m"), ("ft", None), ("ft", "ft"), 1),
]


@pytest.mark.parametrize(("file", "stated", "expected", "warnings"), UNITS)
def test_stated_units(file, stated, expected, warnings):
    import_or_skip("pyproj")
    notes = []
    found = state_unit(Cloud(OHIO, crs=file[0], unit=file[1]), *stated, notes.append)
    np.testing.assert_array_equal(found.points, OHIO)
    notes = [note for note in notes if "distances have no unit" not in note]
    assert len(notes) == warnings
    if notes:
        check_text("\n".join(notes))
    if isinstance(expected, str):
        assert (found.crs, found.unit) == (None, expected)
    else:
        assert axis_units(found.crs) == expected
        assert found.unit == (None if expected in (("m", "ft"), ("ft", "m")) else expected[0])


def test_feet_stated_and_converted():
    """A file in US survey feet that states nothing, or metres, becomes metres."""
    import_or_skip("pyproj")
    feet = OHIO * 3937 / 1200
    for cloud in (Cloud(feet), Cloud(feet, crs="EPSG:26917"), Cloud(feet, crs="EPSG:26917+5703", unit="m")):
        found = convert_unit(state_unit(cloud, "US-ft", None, lambda line: None), "m")
        np.testing.assert_allclose(found.points, OHIO, rtol=1e-14)
        assert found.unit == "m"


def test_conversion_of_x_y_and_z():
    import_or_skip("pyproj")
    normals = np.array([[0, 0, 1.0], [1, 0, 0], [0.6, 0, 0.8]])
    cloud = Cloud(np.full((3, 3), 3937.0), normals, crs="EPSG:26917+6360")
    found = convert_unit(cloud, "m")
    np.testing.assert_allclose(found.points, [[3937, 3937, 1200]] * 3, rtol=1e-15)
    assert (found.unit, axis_units(found.crs)) == ("m", ("m", "m"))
    steep = np.array([0.6, 0, 0.8 * 3937 / 1200])  # normals of a surface that is flatter now
    np.testing.assert_allclose(found.normals[2], steep / np.linalg.norm(steep), rtol=1e-12)
    back = convert_unit(convert_unit(cloud, "ft"), "metres")
    np.testing.assert_allclose(back.points, found.points, rtol=1e-14)
    assert back.unit == "m"
    np.testing.assert_allclose(convert_unit(Cloud(np.ones((1, 3)), unit="mm"), "m").points, 1e-3)


def test_scaled_coordinates_have_no_system():
    notes = []
    found = scale_coordinates(Cloud(OHIO, crs="EPSG:26917", unit="m"), 0.001, notes.append)
    np.testing.assert_allclose(found.points, OHIO / 1000, rtol=1e-15)
    assert (found.crs, found.unit, len(notes)) == (None, None, 1)
    assert scale_coordinates(Cloud(OHIO), 1000, silent).unit is None


def test_statements_that_make_no_sense_are_refused():
    import_or_skip("pyproj")
    degrees, plain = Cloud([[-81.0, 40, 100]], crs="EPSG:4326"), Cloud(OHIO)
    for state in (
        lambda: state_crs(plain, "nowhere", silent),
        lambda: state_crs(plain, "EPSG:4326", silent),
        lambda: state_crs(plain, "EPSG:5703", silent),
        lambda: scale_coordinates(plain, 1e305, silent),
        lambda: state_unit(degrees, "m", None, silent),
        lambda: state_unit(Cloud(OHIO, unit="deg"), "m", None, silent),
        lambda: state_unit(plain, None, "m", silent),
        lambda: state_unit(plain, "parsec", None, silent),
        lambda: state_unit(plain, "m", "parsec", silent),
        lambda: state_unit(Cloud(OHIO, crs="EPSG:4978"), "m", "ft", lambda line: None),
        lambda: state_unit(Cloud(OHIO, crs="a grid of the site"), "m", "ft", silent),
        lambda: convert_unit(degrees, "m"),
        lambda: convert_unit(plain, "m"),
        lambda: convert_unit(plain, "parsec"),
        lambda: without_zeros(Cloud(np.zeros((2, 3)))),
    ):
        with check_error():
            state()


def test_without_pyproj(tmp_path, monkeypatch):
    break_library(monkeypatch, tmp_path / "packages", "pyproj", None)
    known = Cloud(OHIO, crs="EPSG:32617", unit="m")
    for state in (
        lambda: convert_unit(known, "ft"),
        lambda: state_crs(known, "EPSG:26917", silent),
        lambda: state_unit(known, "ft", None, silent),
    ):
        with pytest.raises(MissingExtra):
            state()
    assert convert_unit(Cloud(OHIO, unit="m"), "ft").unit == "ft"
    assert state_unit(Cloud(OHIO), "ft", None, silent).unit == "ft"


def test_zeros_and_duplicates_are_removed():
    points = [[0, 0, 0], [1, 2, 3], [0, -0.0, 0], [1, 2, 3], [0, 0, 1], [1, 2, np.nextafter(3, 4)]]
    cloud = Cloud(points, attributes={"row": np.arange(6)})
    assert without_zeros(cloud).attributes["row"].tolist() == [1, 3, 4, 5]
    assert without_duplicates(cloud).attributes["row"].tolist() == [0, 1, 4, 5]  # the first of each, in their order


def test_names_of_systems_are_arguments():
    """The short name of a system with heights names the same system."""
    pyproj = import_or_skip("pyproj")
    for text in ("EPSG:32617", "EPSG:32617+5703", "EPSG:32617+4979", "EPSG:4979"):
        assert crs_name(pyproj.CRS(text).to_wkt()) == text
