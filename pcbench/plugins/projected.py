"""Conversion of a georeferenced reconstruction to a projected coordinate reference system."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from pcbench.errors import InputError
from pcbench.geometry.arrays import FloatArray, even_rows
from pcbench.geometry.cameras import Camera
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.crs import axis_lengths, crs_name, is_projected_crs, known_crs, single_unit
from pcbench.geometry.datums import StatedSystem
from pcbench.geometry.geodesy import Gps, ecef_from_enu
from pcbench.geometry.reprojection import project
from pcbench.geometry.transform import Similarity
from pcbench.plugins.plugin import Reconstruction
from pcbench.scenes import Scene

_EARTH_CENTRED = "EPSG:4978"
_MAX_TRACED_POINTS = 1000  # of a camera, whose shift in its image is measured


def check_georeferencing(scene: Scene, crs: str, accuracy: float | None = None) -> None:
    """Check before a reconstruction that its cloud can be written in a CRS, as `in_crs` does.

    Raises:
        InputError: the CRS is unknown or not projected, the scene has no place on Earth, or a grid is not installed.
        MissingExtra: pyproj is not installed.
    """
    known_crs(crs)
    if not is_projected_crs(crs):
        raise InputError(f"expected --crs as a projected system, such as EPSG:32617, got {crs_name(crs)}")
    origin = scene.origin or scene.gps_origin
    if origin is None:
        raise InputError(
            f"{scene.folder}: --crs needs photographs with GPS in EXIF, or cameras with a known origin, and there are"
            " none: leave out --crs, and state the system of gps.txt or control points with pcbench convert FILE OUT"
            " --crs"
        )
    _to_map(np.zeros((1, 3)), origin, crs, accuracy, lambda _: None)


def in_crs(reconstruction: Reconstruction, crs: str, *, accuracy: float | None = None) -> Reconstruction:
    """Return a reconstruction in east-north-up in a projected CRS: cloud with normals, and cameras.

    Points and the centres of cameras are converted by way of earth-centred coordinates. Normals and the axes of each
    camera are turned as the map turns at their place, by the convergence of its meridians. A map has a scale and no
    curvature, so that points move in the images of the converted cameras; a note says by how much.

    The altitude of the origin is taken as an ellipsoidal height. If the CRS has no heights, they stay what the
    altitudes are, and their datum is not stated.

    Args:
        reconstruction: a reconstruction with an origin.
        crs: the projected CRS, such as "EPSG:32617".
        accuracy: see `pcbench.geometry.reprojection.project`.

    Raises:
        InputError: the reconstruction has no place on Earth, or see `project`.
        MissingExtra: pyproj is not installed.
    """
    origin, cloud = reconstruction.origin, reconstruction.cloud
    if reconstruction.gauge != "georeferenced" or origin is None:
        frame = "without a geographic origin" if reconstruction.gauge == "georeferenced" else reconstruction.gauge
        raise InputError(
            f"expected a cloud that GPS or cameras with an origin place on Earth, for --crs, got a frame that is"
            f" {frame}: run again without --crs, which keeps the finished steps"
        )
    notes: list[str] = []
    name, unit = crs_name(crs), _unit(crs)

    def to_map(positions: FloatArray) -> FloatArray:
        return _to_map(positions, origin, crs, accuracy, notes.append)

    points = to_map(cloud.points)
    normals = None
    if cloud.normals is not None:
        normals = _unit_rows(to_map(cloud.points + _unit_rows(cloud.normals)) - points)
    cameras = {}
    if reconstruction.cameras:
        centres = np.stack([camera.position for camera in reconstruction.cameras.values()])
        tips = to_map(np.concatenate([centres, *(centres + axis for axis in np.eye(3))])).reshape(4, -1, 3)
        for k, (image, camera) in enumerate(reconstruction.cameras.items()):
            cameras[image] = _moved_camera(camera, tips[0, k], (tips[1:, k] - tips[0, k]).T / unit)
    moved = replace(cloud.moved(points, normals), crs=crs, unit=single_unit(crs, notes.append))
    notes = [f"warning: {line}" for line in dict.fromkeys(notes)]
    notes += _heights_notes(crs)
    notes.append(f"the cloud is in {name}")
    if cameras:
        notes.append(_camera_note(reconstruction, replace(reconstruction, cloud=moved, cameras=cameras), name))
    return replace(reconstruction, cloud=moved, cameras=cameras, notes=[*reconstruction.notes, *notes], origin=None)


def _to_map(
    positions: FloatArray, origin: Gps, crs: str, accuracy: float | None, warn: Callable[[str], None]
) -> FloatArray:
    """Return positions (N, 3) in east-north-up about an origin in a projected CRS."""
    earth_centred = Cloud(ecef_from_enu(positions, origin), crs=_EARTH_CENTRED)
    return project(earth_centred, crs, warn, accuracy=accuracy).cloud.points


def _moved_camera(camera: Camera, position: FloatArray, axes: FloatArray) -> Camera:
    """Return a camera in the frame of a map.

    Args:
        camera: the camera in east-north-up.
        position: (3,) its centre on the map.
        axes: (3, 3) changes of map coordinates along east, north and up as columns, nearly a rotation.
    """
    left, _, right = np.linalg.svd(axes)
    rotation = camera.cam_from_world.rotation @ (left @ right).T
    return replace(camera, cam_from_world=Similarity(rotation, -rotation @ position))


def _unit_rows(vectors: FloatArray) -> FloatArray:
    lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
    unit_rows: FloatArray = np.divide(vectors, lengths, out=np.zeros_like(vectors), where=lengths > 0)
    return unit_rows


def _unit(crs: str) -> float:
    """Return the length of the unit of a map in metres."""
    lengths = axis_lengths(crs)
    assert lengths is not None
    return lengths[0]


def _heights_notes(crs: str) -> list[str]:
    """Return what the heights are, because cameras write altitudes above the ellipsoid or above sea level."""
    if StatedSystem.of(crs, None).vertical_datum is None:
        return ["heights are GPS altitudes: above the ellipsoid or above sea level, as the camera wrote them"]
    return [
        "warning: the heights are right only if the GPS altitudes are above the ellipsoid; many cameras write heights"
        " above sea level"
    ]


def _camera_note(before: Reconstruction, after: Reconstruction, name: str) -> str:
    """Return a note on how far points move in the images of converted cameras."""
    shifts = []
    for image, camera in before.cameras.items():
        pixels, depths = camera.project(before.cloud.points)
        intrinsics = camera.intrinsics
        is_seen = (depths > 0) & ((pixels >= 0) & (pixels <= (intrinsics.width, intrinsics.height))).all(axis=1)
        rows = np.flatnonzero(is_seen)
        rows = rows[even_rows(len(rows), _MAX_TRACED_POINTS)]
        moved, _ = after.cameras[image].project(after.cloud.points[rows])
        shifts.append(np.linalg.norm(moved - pixels[rows], axis=1))
    shift = np.concatenate(shifts)
    if not len(shift):
        return f"the cameras are in {name} too"
    return (
        f"the cameras are in {name} too: the scale and flatness of the map move points in their images by"
        f" {np.median(shift):.2g} px (median), {shift.max():.2g} px at most"
    )
