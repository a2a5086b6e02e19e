"""Cull a mesh to what cameras see, as the evaluations of indoor reconstructions do before they sample it."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcbench.errors import InputError
from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.cameras import Camera
from pcbench.geometry.mesh import Mesh, MeshIndex
from pcbench.geometry.visibility import in_frame
from pcbench.io.colmap_folders import find_model
from pcbench.io.colmap_model import read_colmap_cameras
from pcbench.io.transforms_json import read_transforms


class CulledMesh(NamedTuple):
    """A mesh without the faces that no camera sees, and the share of the area that these had."""

    mesh: Mesh
    culled_share: float


def read_cameras(path: Path) -> tuple[Camera, ...]:
    """Read the cameras of a COLMAP model (its folder, or one above it) or of a transforms.json.

    Raises:
        InputError: there is none, or it is damaged.
    """
    file = camera_file(path)
    return read_colmap_cameras(file, _warn) if file.is_dir() else read_transforms(file, lambda _: None, _warn)


def camera_file(path: Path) -> Path:
    """Return the folder of a COLMAP model, which may be below the given one, or the file that is given.

    Raises:
        InputError: a folder has no model.
    """
    if not path.is_dir():
        return path
    folder = find_model(path, "images", _warn)
    if folder is None:
        raise InputError(f"{path}: expected a folder with a COLMAP model (cameras and images), or a transforms.json")
    return folder


def cull(mesh: Mesh, cameras: Sequence[Camera], tolerance: float | None = None) -> CulledMesh:
    """Remove the faces none of whose vertices is seen by a camera.

    Args:
        mesh: the mesh.
        cameras: cameras in its coordinates.
        tolerance: distance along the line of sight within which a face in front of a vertex does not hide it; None:
            cameras see all vertices in their frames, hidden or not.

    Raises:
        InputError: the cameras see no face with an area.
    """
    seen = _seen_vertices(mesh, cameras, tolerance)
    kept, areas = seen[mesh.faces].any(axis=1), mesh.areas()
    area = float(areas[kept].sum())
    if area <= 0:
        raise InputError(
            f"the {len(cameras):,} cameras see no face of a mesh: cameras and meshes must have the same coordinates"
        )
    return CulledMesh(replace(mesh, faces=mesh.faces[kept]), 1 - area / float(areas.sum()))


def _seen_vertices(mesh: Mesh, cameras: Sequence[Camera], tolerance: float | None) -> NDArray[np.bool_]:
    """Return which vertices (V,) at least one camera sees."""
    seen = np.zeros(len(mesh.vertices), dtype=np.bool_)
    index = None if tolerance is None else MeshIndex(mesh)
    for camera in cameras:
        pending = np.flatnonzero(~seen)
        pending = pending[in_frame(camera, mesh.vertices[pending])]
        if index is not None and tolerance is not None:
            pending = pending[~_are_hidden(index, camera, mesh.vertices[pending], tolerance)]
        seen[pending] = True
    return seen


def _are_hidden(index: MeshIndex, camera: Camera, points: FloatArray, tolerance: float) -> NDArray[np.bool_]:
    """Return which points (N, 3) have a face between themselves and the camera, farther from them than a tolerance."""
    lines = points - camera.position
    lengths = np.linalg.norm(lines, axis=1)
    far = lengths > tolerance
    hidden = np.zeros(len(points), dtype=np.bool_)
    if far.any():
        ends = lines[far] * (1 - tolerance / lengths[far, None])
        hidden[far] = index.is_occluded(camera.position, ends, limit=1.0)
    return hidden


def _warn(text: str) -> None:
    warnings.warn(text, stacklevel=3)
