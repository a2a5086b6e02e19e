"""Names of coordinate systems, units and datums in reports."""

import pytest
from optional import break_library, import_or_skip
from wording import check_text

from pcbench.geometry.crs import unnamed_grid, with_units
from pcbench.geometry.datums import StatedSystem

NAVD88, WGS84 = "North American Vertical Datum 1988", "World Geodetic System 1984 ensemble"


@pytest.mark.parametrize(
    ("crs", "unit", "expected"),
    [
        ("EPSG:32617", "m", ("m", "m", WGS84, None)),
        ("EPSG:32617+5703", "m", ("m", "m", WGS84, NAVD88)),
        ("EPSG:26917+6360", None, ("m", "US-ft", "North American Datum 1983", NAVD88)),
        ("EPSG:32617+4979", "m", ("m", "m", WGS84, "ellipsoidal heights")),
        ("EPSG:4326", "deg", ("deg", None, WGS84, None)),
        ("EPSG:4978", "m", ("m", "m", WGS84, "geocentric coordinates")),
        ("site", "m", ("m", "m", None, None)),
        (None, "m", ("m", "m", None, None)),
        (None, None, (None, None, None, None)),
    ],
)
def test_systems(crs, unit, expected):
    import_or_skip("pyproj")
    found = StatedSystem.of(crs, unit)
    assert (found.unit, found.z_unit, found.horizontal_datum, found.vertical_datum) == expected
    check_text(found.describe())


def test_heights_of_which_only_the_unit_is_known_have_no_datum():
    import_or_skip("pyproj")
    assert StatedSystem.of(with_units("EPSG:26917", "m", "ft"), None).vertical_datum is None
    assert StatedSystem.of(unnamed_grid("m", "ft"), None).describe_datums() == "datums unknown"


def test_without_pyproj(tmp_path, monkeypatch):
    break_library(monkeypatch, tmp_path / "packages", "pyproj", None)
    found = StatedSystem.of("EPSG:32617+5703", "m")
    assert (found.crs, found.unit, found.horizontal_datum, found.vertical_datum) == ("EPSG:32617+5703", "m", None, None)
    assert found.describe_datums() == "datums unknown"  # not "not stated"
