"""Conversion of WGS84 positions to local east-north-up coordinates in metres."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from pcbench.geometry.arrays import FloatArray

_SEMI_MAJOR, _FLATTENING = 6_378_137.0, 1 / 298.257223563  # WGS84 (NIMA TR8350.2)


class Gps(NamedTuple):
    """A position from a camera's file: WGS84 latitude and longitude in degrees, altitude in metres.

    The altitude is 0 if the file has none. Depending on the camera it is above sea level or above the ellipsoid.
    """

    latitude_deg: float
    longitude_deg: float
    altitude: float


def radii_of_curvature(latitude_deg: float) -> tuple[float, float]:
    """Return the radii of curvature of WGS84 in metres at a latitude (NIMA TR8350.2).

    The first is that of the prime vertical (N, for distances to the east), the second that of the meridian (M, for
    distances to the north).
    """
    eccentricity2 = _FLATTENING * (2 - _FLATTENING)
    w = float(np.sqrt(1 - eccentricity2 * np.sin(np.radians(latitude_deg)) ** 2))
    return _SEMI_MAJOR / w, _SEMI_MAJOR * (1 - eccentricity2) / w**3


def enu_from_wgs84(positions: Sequence[Gps] | FloatArray, origin: Gps) -> FloatArray:
    """Return east, north and up (N, 3) in metres, relative to the tangent plane of the ellipsoid at `origin`.

    Args:
        positions: WGS84 positions, or an array (N, 3) of latitude, longitude (degrees) and altitude (metres).
        origin: origin of the local frame. Altitudes are taken as ellipsoidal heights; a constant offset from them,
            such as the geoid height, cancels.
    """
    centred = _ecef_from_geodetic(positions) - _ecef_from_geodetic([origin])
    enu: FloatArray = centred @ enu_axes(origin).T
    return enu


def ecef_from_enu(positions: FloatArray, origin: Gps) -> FloatArray:
    """Return earth-centred coordinates (N, 3) in metres of WGS84 (EPSG:4978), the inverse of `enu_from_wgs84`.

    Args:
        positions: (N, 3) east, north and up in metres, relative to the tangent plane of the ellipsoid at `origin`.
        origin: origin of the local frame; its altitude is taken as an ellipsoidal height.
    """
    centred: FloatArray = positions @ enu_axes(origin) + _ecef_from_geodetic([origin])
    return centred


def gps_from_ecef(position: FloatArray) -> Gps:
    """Return the WGS84 position of earth-centred coordinates (3,) in metres; its altitude is the ellipsoidal height."""
    x, y, z = (float(value) for value in position)
    eccentricity2, distance = _FLATTENING * (2 - _FLATTENING), math.hypot(x, y)
    latitude = math.atan2(z, distance * (1 - eccentricity2))
    for _ in range(10):  # each step reduces the error about 300 times
        normal = _SEMI_MAJOR / math.sqrt(1 - eccentricity2 * math.sin(latitude) ** 2)
        latitude = math.atan2(z + eccentricity2 * normal * math.sin(latitude), distance)
    # Of the distances along the axes, this one is well defined at the poles too.
    flat = _SEMI_MAJOR * math.sqrt(1 - eccentricity2 * math.sin(latitude) ** 2)
    height = distance * math.cos(latitude) + z * math.sin(latitude) - flat
    return Gps(math.degrees(latitude), math.degrees(math.atan2(y, x)), height)


def enu_axes(origin: Gps) -> FloatArray:
    """Return east, north and up at a position as rows (3, 3), in earth-centred axes."""
    latitude, longitude = np.radians(origin.latitude_deg), np.radians(origin.longitude_deg)
    sin_lat, cos_lat, sin_lon, cos_lon = np.sin(latitude), np.cos(latitude), np.sin(longitude), np.cos(longitude)
    return np.array(
        [
            [-sin_lon, cos_lon, 0],
            [-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat],
            [cos_lat * cos_lon, cos_lat * sin_lon, sin_lat],
        ]
    )


def _ecef_from_geodetic(positions: Sequence[Gps] | FloatArray) -> FloatArray:
    latitude, longitude, height = np.array(positions, dtype=np.float64).reshape(-1, 3).T
    latitude, longitude = np.radians(latitude), np.radians(longitude)
    eccentricity2 = _FLATTENING * (2 - _FLATTENING)
    normal = _SEMI_MAJOR / np.sqrt(1 - eccentricity2 * np.sin(latitude) ** 2)
    x = (normal + height) * np.cos(latitude) * np.cos(longitude)
    y = (normal + height) * np.cos(latitude) * np.sin(longitude)
    z = (normal * (1 - eccentricity2) + height) * np.sin(latitude)
    return np.stack([x, y, z], axis=1)
