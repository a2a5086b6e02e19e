"""Brings an arbitrary gauge into the world: onto known cameras, GPS positions or control points."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pcbench.cameras import Camera
from pcbench.cloud import FloatArray
from pcbench.errors import InputError
from pcbench.transform import Similarity


class Observation(NamedTuple):
    """A control point in an image: pixels with the first one's centre at (0.5, 0.5)."""

    image: str
    x: float
    y: float


class ControlPoint(NamedTuple):
    """A point that was surveyed and marked in images. Check points are measured, not used."""

    name: str
    position: FloatArray
    observations: tuple[Observation, ...]

    @property
    def is_check(self) -> bool:
        return self.name.endswith("*")


def moved(camera: Camera, transform: Similarity) -> Camera:
    """The same camera in the world that `transform` leads to."""
    rotation = camera.cam_from_world.rotation @ transform.rotation.T
    position = transform.apply(camera.position[None])[0]
    return Camera(camera.name, camera.intrinsics, Similarity(rotation, -rotation @ position))


def camera_errors(cameras: Mapping[str, Camera], truth: Mapping[str, Camera]) -> tuple[FloatArray, FloatArray]:
    """Distances of the centres in the unit of the truth, and angles in degrees between the orientations, for the images
    that are in both, in the order of their names.
    """
    positions, angles = [], []
    for name in sorted(set(cameras) & set(truth)):
        a, b = cameras[name], truth[name]
        positions.append(float(np.linalg.norm(a.position - b.position)))
        turn = a.cam_from_world.rotation @ b.cam_from_world.rotation.T
        # The sine is exact for small angles, where the cosine is flat.
        sine = np.linalg.norm([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]) / 2
        angles.append(float(np.degrees(np.arctan2(sine, (np.trace(turn) - 1) / 2))))
    return np.array(positions), np.array(angles)


def triangulate(rays: FloatArray, centres: FloatArray) -> FloatArray:
    """The point (3,) nearest to lines through centres (N, 3) along unit rays (N, 3), in least squares."""
    planes = np.eye(3) - np.einsum("ni,nj->nij", rays, rays)
    point: FloatArray = np.linalg.solve(planes.sum(axis=0), np.einsum("nij,nj->i", planes, centres))
    return point


def read_control(path: Path) -> tuple[ControlPoint, ...]:
    """Control points: lines of name, x y z, image, and the point's pixel in it; one line an observation. Lines that
    start with # are comments; names that end in * are check points.

    Raises:
        InputError: a line is something else, a point has two positions, or fewer than two observations.
    """
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        what = getattr(error, "strerror", None) or "not a text file"
        raise InputError(f"{path}: cannot read control points: {what}") from error
    positions: dict[str, FloatArray] = {}
    observations: dict[str, list[Observation]] = {}
    for number, line in enumerate(lines, 1):
        words = line.split("#")[0].split()
        if not words:
            continue
        try:
            name, x, y, z, image, u, v = words
            position, pixel = np.array([float(x), float(y), float(z)]), (float(u), float(v))
        except ValueError:
            raise InputError(
                f"{path}: line {number}: expected name, x y z, image, pixel x y; got {line.strip()[:60]!r}"
            ) from None
        if not (np.isfinite(position).all() and np.isfinite(pixel).all()):
            raise InputError(f"{path}: line {number}: expected finite numbers, got {line.strip()[:60]!r}")
        if not np.array_equal(positions.setdefault(name, position), position):
            raise InputError(f"{path}: line {number}: {name} has another position here than above")
        observations.setdefault(name, []).append(Observation(image, *pixel))
    for name, seen in observations.items():
        if len({o.image for o in seen}) < 2:
            raise InputError(f"{path}: {name} is marked in one image only: expected two or more")
    return tuple(ControlPoint(name, positions[name], tuple(seen)) for name, seen in observations.items())
