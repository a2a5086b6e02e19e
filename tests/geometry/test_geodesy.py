"""WGS84 to east-north-up, compared with pyproj and known lengths."""

import numpy as np
import pytest
from optional import import_or_skip

from pcbench.geometry.geodesy import Gps, enu_from_wgs84

POSITIONS = [Gps(46.8426, -91.9946, 198.3), Gps(46.8526, -91.9846, 298.3), Gps(-33.9, 151.2, -20.0), Gps(89.99, 0, 0)]


def test_axes_point_east_north_and_up():
    origin = Gps(48.0, 11.0, 500.0)
    positions = [Gps(48.0, 11.00001, 500.0), Gps(48.00001, 11.0, 500.0), Gps(48.0, 11.0, 501.0)]
    # A hundred-thousandth of a degree of latitude is 1.11 m, of longitude cos(48) of that and a little more.
    np.testing.assert_allclose(enu_from_wgs84(positions, origin), np.diag([0.746, 1.112, 1.0]), atol=1e-3)


@pytest.mark.parametrize("origin", POSITIONS[:3])
def test_agrees_with_pyproj(origin):
    pyproj = import_or_skip("pyproj")
    projection = f"+proj=topocentric +ellps=WGS84 +lat_0={origin[0]} +lon_0={origin[1]} +h_0={origin[2]}"
    transform = pyproj.Transformer.from_pipeline(f"+proj=pipeline +step +proj=cart +ellps=WGS84 +step {projection}")
    longitude, latitude, height = np.array(POSITIONS)[:, [1, 0, 2]].T
    expected = np.stack(transform.transform(longitude, latitude, height), axis=1)
    np.testing.assert_allclose(enu_from_wgs84(POSITIONS, origin), expected, atol=1e-6)
