"""Read Google Earth Studio's JSON camera export (Render -> 3D camera export -> JSON) into local east-north-up.

A frame has `position`, `rotation` (degrees), `coordinate` (latitude, longitude, altitude) and `fovVertical`. The
meaning of the fields was derived from real exports. The earth is a sphere of radius 6,371,010 m. Positions are
earth-centred (x to 0 N 0 E, z to the north pole) or, if a track point is set as the origin, relative to it. The
camera's axes (x right, y down, z forward) in that frame are the columns of Rx(x) Ry(y) Rz(z).
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pcbench.errors import InputError
from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.cameras import Camera, Intrinsics
from pcbench.geometry.geodesy import Gps, enu_axes, enu_from_wgs84, radii_of_curvature
from pcbench.geometry.transform import Similarity, fit_similarity
from pcbench.io.files import errors_named
from pcbench.regular_files import read_json

# Hint for users who have Earth Studio's own project file.
PROJECT_FILE_HINT = (
    "expected cameras, got an Earth Studio project (.esp), which stores only keyframes: render it with the 3D camera"
    " export as JSON (with global coordinates) and put that .json next to the images"
)
EARTH_RADIUS = 6_371_010.0  # metres
_MIN_GLOBAL_RADIUS = 0.5 * EARTH_RADIUS  # metres; positions closer to zero are relative to a track point


class EarthStudio(NamedTuple):
    """Cameras of an export in local east-north-up (metres), one per frame, named by the frame index from 0.

    `origin` is the track point set as the origin, else the first track point, else the ground below frame 0.
    """

    cameras: tuple[Camera, ...]
    origin: Gps


def read_earth_studio(path: Path) -> EarthStudio:
    """Read the cameras of an Earth Studio export.

    Local positions are converted with the latitudes, longitudes and altitudes of the frames.

    Raises:
        InputError: the file is not such an export, a number is missing, or local positions cannot be converted. The
            message starts with the path.
    """
    with errors_named(path):
        document = read_json(path)
        if not isinstance(document, dict) or not document.get("cameraFrames"):
            raise InputError(
                "expected an Earth Studio camera export with cameraFrames, got other JSON: export it again"
            )
        try:
            cameras = _earth_studio(document)
        except InputError:  # also a ValueError, but its message is complete
            raise
        except (ValueError, KeyError, TypeError, AttributeError, OverflowError) as error:
            what = f"{error} is missing" if isinstance(error, KeyError) else str(error)
            raise InputError(f"expected an Earth Studio camera export (JSON), got a damaged one: {what}") from None
    return cameras


def describe_sphere_scale(origin: Gps) -> str:
    """Describe how much lengths on Earth Studio's sphere differ from WGS84 at a position."""
    along_parallel, along_meridian = radii_of_curvature(origin.latitude_deg)
    east, north = (100 * (EARTH_RADIUS / radius - 1) for radius in (along_parallel, along_meridian))
    return (
        f"lengths are metres on Earth Studio's sphere: {east:+.2f} % (east) and {north:+.2f} % (north) relative to"
        f" WGS84 at latitude {origin.latitude_deg:.1f} degrees; for WGS84 metres use --wgs84"
    )


def wgs84_from_sphere(points: FloatArray, origin: Gps) -> FloatArray:
    """Convert points (N, 3) in local east-north-up from Earth Studio's sphere to WGS84, about the same origin.

    Each point keeps its latitude, longitude and altitude. Directions do not change: the east, north and up axes at a
    given latitude and longitude are the same for both.
    """
    centred = _earth_centred(np.array([origin])) + points @ enu_axes(origin)
    radius = np.linalg.norm(centred, axis=1)
    latitude, longitude = np.arcsin(centred[:, 2] / radius), np.arctan2(centred[:, 1], centred[:, 0])
    return enu_from_wgs84(np.column_stack([np.degrees(latitude), np.degrees(longitude), radius - EARTH_RADIUS]), origin)


def _earth_studio(document: Mapping[str, Any]) -> EarthStudio:
    frames = document["cameraFrames"]
    coordinates = np.array([_finite_triple(f["coordinate"], "latitude", "longitude", "altitude") for f in frames])
    exported = np.array([_finite_triple(f["position"]) for f in frames])
    rotations = np.stack([_rotation(*_finite_triple(f["rotation"])) for f in frames])
    centred = _earth_centred(coordinates)
    if np.linalg.norm(exported, axis=1).max() > _MIN_GLOBAL_RADIUS:
        centred = exported  # equal to `coordinate` to a nanometre, and what the renderer used
    else:
        rotations = _global_from_local(exported, centred) @ rotations

    origin = _origin(document, coordinates)
    enu_from_earth = enu_axes(origin)
    base = _earth_centred(np.array([origin]))[0]
    positions = (centred - base) @ enu_from_earth.T
    width, height = int(document["width"]), int(document["height"])
    cameras = []
    for number, (frame, position, rotation) in enumerate(zip(frames, positions, rotations, strict=True)):
        intrinsics = Intrinsics.from_fov(width, height, float(frame["fovVertical"]))
        cam_from_world = (enu_from_earth @ rotation).T
        cameras.append(Camera(str(number), intrinsics, Similarity(cam_from_world, -cam_from_world @ position)))
    return EarthStudio(tuple(cameras), origin)


def _origin(document: Mapping[str, Any], coordinates: FloatArray) -> Gps:
    points = document.get("trackPoints") or []
    origins = [p for p in points if (p.get("coordinate") or {}).get("isOrigin")]
    for point in [*origins, *points][:1]:
        position = np.array(_finite_triple(point["position"]))
        if np.linalg.norm(position) > _MIN_GLOBAL_RADIUS:
            return _gps_from_earth_centred(position)
        return _gps_from_sliders(point)
    return Gps(float(coordinates[0, 0]), float(coordinates[0, 1]), 0.0)


def _gps_from_sliders(point: Mapping[str, Any]) -> Gps:
    """Return the position of a track point of a local export from its sliders, which are shares of a range (0 to 1).

    Its `position` is relative to the origin; the sliders are global.
    """
    slider_values: dict[str, float] = {}
    for attribute in point["coordinate"]["position"]["attributes"]:
        value = attribute["value"]
        low, high = float(value["minValueRange"]), float(value["maxValueRange"])
        slider_values[attribute["type"]] = low + float(value["relative"]) * (high - low)
    return Gps(slider_values["latitude"], slider_values["longitude"], slider_values["altitude"])


def _global_from_local(local: FloatArray, centred: FloatArray) -> FloatArray:
    """Fit the rotation (3, 3) from a local export's axes to the earth's, from positions known in both."""
    offset = centred - local
    if np.abs(offset - offset[0]).max() < 1e-2:  # only translated
        return np.eye(3)
    try:
        fit = fit_similarity(local, centred, with_scale=False)
    except InputError:
        raise InputError(
            "expected cameras on a curve, got a straight flight in local coordinates, which does not determine the"
            " rotation: export it again with global coordinates"
        ) from None
    if (error := float(np.abs(fit.apply(local) - centred).max())) > 1e-2:
        raise InputError(f"positions and coordinates differ by {error:.3g} m: export it again with global coordinates")
    return fit.rotation


def _earth_centred(coordinates: FloatArray) -> FloatArray:
    """Convert latitude and longitude (degrees) and altitude (metres), (N, 3), to earth-centred positions (N, 3)."""
    latitude, longitude = np.radians(coordinates[:, 0]), np.radians(coordinates[:, 1])
    direction = [np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude)]
    positions: FloatArray = (EARTH_RADIUS + coordinates[:, 2:]) * np.stack(direction, axis=1)
    return positions


def _gps_from_earth_centred(position: FloatArray) -> Gps:
    x, y, z = position
    radius = float(np.linalg.norm(position))
    return Gps(float(np.degrees(np.arcsin(z / radius))), float(np.degrees(np.arctan2(y, x))), radius - EARTH_RADIUS)


def _rotation(x_deg: float, y_deg: float, z_deg: float) -> FloatArray:
    """Return Rx(x) Ry(y) Rz(z), (3, 3)."""
    (cx, cy, cz), (sx, sy, sz) = (f(np.radians([x_deg, y_deg, z_deg])) for f in (np.cos, np.sin))
    rotation: FloatArray = (
        np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
        @ np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
        @ np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]])
    )
    return rotation


def _finite_triple(values: Mapping[str, Any], a: str = "x", b: str = "y", c: str = "z") -> tuple[float, float, float]:
    x, y, z = float(values[a]), float(values[b]), float(values[c])
    if not np.isfinite([x, y, z]).all():
        raise ValueError(f"{a}, {b}, {c} are not finite")
    return x, y, z
