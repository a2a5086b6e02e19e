"""Reconstructions with GPS in a projected coordinate system, against pyproj and closed forms."""

import numpy as np
import pytest
from optional import import_or_skip
from wording import check_error, check_text

from pcbench.geometry.cameras import Camera, Intrinsics, look_at
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.geodesy import Gps, ecef_from_enu, enu_from_wgs84
from pcbench.plugins import Reconstruction
from pcbench.plugins.projected import check_georeferencing, in_crs
from pcbench.scenes import Scene

# Four degrees east of the central meridian of zone 17, where grid north is 2.6 degrees off true north.
ORIGIN = Gps(40.0, -77.0, 250.0)
FEET_PER_METRE = 3937 / 1200


def positions(count=200):
    """Return geodetic positions (N, 3) around the origin, longitude first, and the same in east-north-up."""
    random = np.random.default_rng(0).uniform(-1, 1, (count, 3)) * [2e-3, 2e-3, 20]
    geodetic = random + [ORIGIN.longitude_deg, ORIGIN.latitude_deg, ORIGIN.altitude]
    return geodetic, enu_from_wgs84(geodetic[:, [1, 0, 2]], ORIGIN)


def survey(points, normals=None):
    """Return a reconstruction of points in east-north-up, seen straight down and obliquely from 120 m above them."""
    intrinsics = Intrinsics(4000, 3000, 3000.0, 3000.0, 2000.0, 1500.0)
    poses = {"nadir.jpg": ([0, 0, 120], [0, 0, 0]), "oblique.jpg": ([-100, 20, 120], [20, 10, 0])}
    cameras = {name: Camera(name, intrinsics, look_at(*pose)) for name, pose in poses.items()}
    return Reconstruction(Cloud(points, normals, unit="m"), "georeferenced", cameras, ["solved"], origin=ORIGIN)


def test_earth_centred_coordinates_are_the_inverse():
    pyproj = import_or_skip("pyproj")
    geodetic, enu = positions()
    expected = np.stack(pyproj.Transformer.from_crs(4979, 4978, always_xy=True).transform(*geodetic.T), axis=1)
    np.testing.assert_allclose(ecef_from_enu(enu, ORIGIN), expected, atol=1e-6)


@pytest.mark.parametrize("crs", ["EPSG:32617", "EPSG:32617+4979"])
def test_points_are_those_of_pyproj(crs):
    pyproj = import_or_skip("pyproj")
    geodetic, enu = positions()
    found = in_crs(survey(enu), crs)
    east, north = pyproj.Transformer.from_crs(4326, 32617, always_xy=True).transform(*geodetic[:, :2].T)
    np.testing.assert_allclose(found.cloud.points, np.stack([east, north, geodetic[:, 2]], axis=1), atol=1e-6)
    assert (found.cloud.crs, found.cloud.unit, found.origin) == (crs, "m", None)
    assert found.notes[0] == "solved"
    check_text("\n".join(found.notes))


def test_cameras_and_normals_turn_by_the_convergence_of_the_meridians():
    """Grid north is off true north by the convergence, arctan(tan(lambda) sin(phi)) on a sphere."""
    pyproj = import_or_skip("pyproj")
    _, enu = positions()
    normals = np.tile([0.0, 2.0, 0.0], (len(enu), 1))  # to the north, with any length
    before, found = survey(enu, normals), in_crs(survey(enu, normals), "EPSG:32617")
    factors = pyproj.Proj("EPSG:32617").get_factors(ORIGIN.longitude_deg, ORIGIN.latitude_deg)
    angle = np.radians(factors.meridian_convergence)
    spherical = np.arctan(np.tan(np.radians(4)) * np.sin(np.radians(40)))
    np.testing.assert_allclose(angle, spherical, rtol=1e-2)  # the ellipsoid and the place differ by less
    # The convergence changes by 3e-5 and the plumb line by 3e-5 radians over the 200 m of the scene.
    north = [np.sin(-angle), np.cos(angle), 0]
    np.testing.assert_allclose(found.cloud.normals, np.tile(north, (len(enu), 1)), atol=1e-4)
    nadir, moved = before.cameras["nadir.jpg"], found.cameras["nadir.jpg"]
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    np.testing.assert_allclose(moved.cam_from_world.rotation, nadir.cam_from_world.rotation @ turn.T, atol=1e-6)
    east, north = pyproj.Transformer.from_crs(4326, 32617, always_xy=True).transform(
        ORIGIN.longitude_deg, ORIGIN.latitude_deg
    )
    np.testing.assert_allclose(moved.position, [east, north, 370], atol=1e-6)  # straight above the origin


def test_points_stay_where_they_are_in_the_images():
    """The scale of the map is that of pyproj; it moves points in the images by its difference from 1, as noted."""
    pyproj = import_or_skip("pyproj")
    _, enu = positions()
    before, found = survey(enu), in_crs(survey(enu), "EPSG:32617")
    scale = pyproj.Proj("EPSG:32617").get_factors(ORIGIN.longitude_deg, ORIGIN.latitude_deg).meridional_scale
    pixels, _ = before.cameras["nadir.jpg"].project(enu)
    is_seen = (np.abs(pixels - [2000, 1500]) <= [2000, 1500]).all(axis=1)
    moved, _ = found.cameras["nadir.jpg"].project(found.cloud.points)
    by_scale = (pixels - [2000, 1500]) * scale + [2000, 1500]
    # The depth changes by the curvature, 200 m squared over twice the radius of the Earth: 3 mm in 100 m.
    np.testing.assert_allclose(moved[is_seen], by_scale[is_seen], atol=0.15)
    assert np.abs(moved - pixels)[is_seen].max() < 2000 * abs(scale - 1) + 0.15
    assert np.abs(moved - pixels)[is_seen].max() > 0.2  # the scale matters


def test_feet_of_a_map():
    """A map in US survey feet has points, heights and cameras in feet; WGS 84 and NAD83 agree as far as is known."""
    import_or_skip("pyproj")
    _, enu = positions()
    metric = in_crs(survey(enu), "EPSG:32618", accuracy=4)
    feet = in_crs(survey(enu), "EPSG:2271", accuracy=4)  # Pennsylvania North
    assert (metric.cloud.unit, feet.cloud.unit) == ("m", "US-ft")
    lengths = [np.linalg.norm(np.diff(found.cloud.points, axis=0), axis=1) for found in (metric, feet)]
    np.testing.assert_allclose(lengths[1], lengths[0] * FEET_PER_METRE, rtol=1e-3)  # by the scales of both maps
    np.testing.assert_allclose(feet.cameras["nadir.jpg"].position[2], 370 * FEET_PER_METRE, rtol=1e-6)


def test_what_has_no_place_on_earth_is_refused(tmp_path):
    import_or_skip("pyproj")
    scene = Scene(tmp_path / "photos", ("a.jpg",), {"a.jpg": (4, 3)}, gps={"a.jpg": ORIGIN})
    check_georeferencing(scene, "EPSG:32617")
    points = Cloud(np.eye(3))
    for convert in (
        lambda: in_crs(Reconstruction(points, "arbitrary"), "EPSG:32617"),
        lambda: in_crs(Reconstruction(points, "georeferenced"), "EPSG:32617"),
        lambda: check_georeferencing(scene, "EPSG:4326"),
        lambda: check_georeferencing(scene, "nowhere"),
        lambda: check_georeferencing(Scene(tmp_path / "photos", ("a.jpg",), {"a.jpg": (4, 3)}), "EPSG:32617"),
        lambda: Reconstruction(points, "georeferenced", origin=(95.0, 0, 0)),
        lambda: Reconstruction(points, "georeferenced", origin="here"),
    ):
        with check_error():
            convert()
