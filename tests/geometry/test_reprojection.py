"""Clouds in other coordinate systems."""

import numpy as np
import pytest
from optional import break_library, import_or_skip
from wording import check_error, check_text

from pcbench.errors import InputError, MissingExtra
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.crs import (
    axis_units,
    crs_name,
    degrees_hint,
    is_geographic_crs,
    suggested_crs,
    unnamed_grid,
    with_units,
)
from pcbench.geometry.reprojection import project

PLACE = np.array([[-81.0, 40.0, 100.0], [-81.001, 40.002, 130.0], [-80.999, 40.001, 90.0]])
# Karney, "Transverse Mercator with an accuracy of a few nanometers", 2011: the central meridian of zone 17 is -81.
CENTRAL_NORTHING = 4_427_757.219
A, B = 6_378_137.0, 6_356_752.314_245  # semi-axes of the WGS 84 ellipsoid in metres


def test_projection_to_utm():
    pyproj = import_or_skip("pyproj")
    attributes, colors = {"a": np.arange(3)}, np.arange(9, dtype=np.uint8).reshape(3, 3)
    notes = []
    cloud = Cloud(PLACE, np.eye(3), colors, attributes, crs="EPSG:4326", unit="deg")
    found, operation, accuracy = project(cloud, "EPSG:32617", notes.append)
    assert (found.crs, found.unit, found.normals, found.stored) == ("EPSG:32617", "m", None, None)
    assert (operation, accuracy) == ("UTM zone 17N", 0)
    np.testing.assert_allclose(found.points[0], [500_000, CENTRAL_NORTHING, 100], atol=1e-3)
    np.testing.assert_array_equal(found.colors, colors)
    np.testing.assert_array_equal(found.attributes["a"], attributes["a"])
    assert len(notes) == 1
    check_text(notes[0])
    # Distances on the ellipsoid differ from those on the grid by its scale, 0.9996 on the central meridian.
    along = pyproj.Geod(ellps="WGS84").inv(*PLACE[0, :2], *PLACE[1, :2])[2]
    assert np.linalg.norm(found.points[1, :2] - found.points[0, :2]) == pytest.approx(0.9996 * along, rel=1e-6)


HEIGHTS = [  # source, target, factor of the heights, unit, units of the axes
    ("EPSG:26917", "EPSG:4269", 1, None, ("deg", None)),
    ("EPSG:26917+6360", "EPSG:26917", 1200 / 3937, "m", ("m", "m")),  # US survey feet
    ("EPSG:26917+6360", "EPSG:26917+5703", 1200 / 3937, "m", ("m", "m")),
    ("EPSG:26917+5703", "EPSG:3734", 3937 / 1200, "US-ft", ("US-ft", "US-ft")),
    ("EPSG:4269", "EPSG:3734", 3937 / 1200, "US-ft", ("US-ft", None)),
    ("EPSG:4979", "EPSG:32617", 1, "m", ("m", "m")),  # ellipsoidal heights stay ellipsoidal
    ("EPSG:6319", "EPSG:6549", 3937 / 1200, "US-ft", ("US-ft", "US-ft")),
]


@pytest.mark.parametrize(("source", "target", "factor", "unit", "units"), HEIGHTS)
def test_heights_get_the_unit_of_the_new_system(source, target, factor, unit, units):
    import_or_skip("pyproj")
    points = PLACE + [500_081, 4_427_700, 0] if source.startswith("EPSG:26917") else PLACE
    found = project(Cloud(points, crs=source), target).cloud
    np.testing.assert_allclose(found.points[:, 2], PLACE[:, 2] * factor, rtol=1e-11)  # a nanometre, by iteration
    assert (found.unit or None, axis_units(found.crs)) == (unit or "deg", units)


def test_geocentric_coordinates_become_ellipsoidal_heights():
    """On the equator and at a pole, heights are distances from the ellipsoid along the axes."""
    import_or_skip("pyproj")
    found = project(Cloud([[A + 100, 0, 0], [A + 3, 0, 0]], crs="EPSG:4978"), "EPSG:32631").cloud
    np.testing.assert_allclose(found.points[:, 2], [100, 3], atol=1e-6)
    assert crs_name(found.crs) == "EPSG:32631+4979"
    found = project(Cloud([[0, 0, B + 7.0], [0, 0, B]], crs="EPSG:4978"), "EPSG:4979").cloud
    np.testing.assert_allclose(found.points[:, 1:], [[90, 7], [90, 0]], atol=1e-6)


def test_ellipsoidal_heights_change_with_the_datum():
    """The shift of GDA94 to GDA2020 in space, which the operation applies, against geodetic coordinates by hand."""
    pyproj = import_or_skip("pyproj")
    here = [[149.1, -35.3, 600.0], [149.11, -35.31, 610.0]]
    found, _, accuracy = project(Cloud(here, crs="EPSG:7843"), "EPSG:28355")
    helmert = "+proj=helmert +x=0.06155 +y=-0.01087 +z=-0.04019 +rx=-0.0394924 +ry=-0.0327221 +rz=-0.0328979"
    by_hand = pyproj.Transformer.from_pipeline(
        "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step +proj=cart +ellps=GRS80"
        f" +step +inv {helmert} +s=-0.009994 +convention=coordinate_frame"
        " +step +inv +proj=cart +ellps=GRS80 +step +proj=utm +zone=55 +south +ellps=GRS80"
    )
    expected = np.stack(by_hand.transform(*np.transpose(here)), axis=1)
    np.testing.assert_allclose(found.points, expected, atol=1e-5)  # both are computed to micrometres
    assert accuracy == 0.01
    assert np.abs(found.points[:, 2] - np.transpose(here)[2]).min() > 0.05


def missing_grids(source, target):
    """Return the names of the missing grids of the best operation at a place of this module, by pyproj alone."""
    pyproj = import_or_skip("pyproj")
    group = pyproj.transformer.TransformerGroup(
        source,
        target,
        always_xy=True,
        allow_ballpark=False,
        area_of_interest=pyproj.aoi.AreaOfInterest(-81.001, 40.0, -80.999, 40.002),
    )
    if group.best_available:
        pytest.skip("the grids are installed")
    return [grid.short_name for grid in group.unavailable_operations[0].grids if not grid.available]


@pytest.mark.filterwarnings("ignore:Best transformation")
@pytest.mark.parametrize(
    ("source", "target"),
    [("EPSG:4979", "EPSG:32617+5773"), ("EPSG:4979", "EPSG:32617+5703"), ("EPSG:4269", "EPSG:32617")],
)
def test_a_missing_grid_is_named(source, target):
    """Nothing is transformed by a less accurate operation, and never by one that neglects the datum of heights."""
    names = missing_grids(source, target)
    with pytest.raises(InputError) as error:
        project(Cloud(PLACE, crs=source), target)
    assert names and all(f"pyproj sync --file {name}" in str(error.value) for name in names)


@pytest.mark.filterwarnings("ignore:Best transformation")
def test_a_less_accurate_transformation_can_be_accepted():
    missing_grids("EPSG:4269", "EPSG:32617")
    cloud = Cloud(PLACE, crs="EPSG:4269")
    with pytest.raises(InputError) as error:
        project(cloud, "EPSG:32617", accuracy=3.9)
    assert "--accuracy 4" in str(error.value)
    found, operation, accuracy = project(cloud, "EPSG:32617", accuracy=4)
    assert (operation, accuracy) == ("NAD83 to WGS 84 (1) + UTM zone 17N", 4)
    np.testing.assert_allclose(found.points[0], [500_000, CENTRAL_NORTHING, 100], atol=1e-3)  # it shifts nothing


def test_dynamic_datums_and_distant_clouds_are_warned_of():
    import_or_skip("pyproj")
    notes = []
    project(Cloud(PLACE, crs="EPSG:9000"), "EPSG:6318", notes.append)
    assert len(notes) == 1
    check_text(notes[0])
    project(Cloud(PLACE, crs="EPSG:4326"), "EPSG:32616", notes.append)  # the next zone, six degrees to the west
    project(Cloud(PLACE, crs="EPSG:4326"), "EPSG:32618", notes.append)
    assert len(notes) == 2 + 1
    check_text(notes[1])


def test_transformations_that_make_no_sense_are_refused():
    import_or_skip("pyproj")
    degrees = Cloud(PLACE, crs="EPSG:4326")
    for cloud, target in (
        (Cloud(PLACE), "EPSG:32617"),
        (degrees, "the village"),
        (degrees, "EPSG:4978"),
        (degrees, "EPSG:5703"),
        (degrees, "EPSG:32617+5703"),  # the heights have no datum
        (Cloud(PLACE, crs="EPSG:26917"), "EPSG:26917+5703"),
        (Cloud(PLACE * [1, 9, 1], crs="EPSG:4326"), "EPSG:32617"),
        (Cloud(PLACE, crs="EPSG:7843"), "EPSG:4283"),  # from Ohio to Australia
        (Cloud(PLACE, crs=unnamed_grid("m", "ft")), "EPSG:32617"),
    ):
        with check_error():
            project(cloud, target)


def test_without_pyproj(tmp_path, monkeypatch):
    break_library(monkeypatch, tmp_path / "packages", "pyproj", None)
    with pytest.raises(MissingExtra):
        project(Cloud(PLACE, crs="EPSG:4326"), "EPSG:32617")
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
