"""Known deformations of a cloud, like those from wrong cameras in photogrammetry.

Each kind is a smooth displacement field over the cloud's extent. None is affine, but each has an affine part, which a
registration may absorb. Amplitudes are therefore defined by the residual after the best affine map.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from pcbench.errors import InputError, did_you_mean
from pcbench.geometry.arrays import MAX_COORDINATE, FloatArray
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.transform import Affine, Similarity
from pcbench.io import write_cloud
from pcbench.scratch import atomic_write

SCHEMA = "pcbench.warp/1"
_BASIN = (0.35, -0.25, 0.30)  # centre x, y and standard deviation of the subsidence, relative to `Warp.lengths`
_DIFFERENCE_STEP = 1e-5  # of the normals' finite differences, relative to `Warp.lengths`: both errors are about 1e-10


def _dome(x: FloatArray, y: FloatArray, z: FloatArray) -> list[FloatArray]:
    return [0 * x, 0 * x, -(x * x + y * y)]


def _bowl(x: FloatArray, y: FloatArray, z: FloatArray) -> list[FloatArray]:
    return [0 * x, 0 * x, x * x + y * y]


def _shear(x: FloatArray, y: FloatArray, z: FloatArray) -> list[FloatArray]:
    return [z * z, 0 * x, 0 * x]


def _twist(x: FloatArray, y: FloatArray, z: FloatArray) -> list[FloatArray]:
    return [-z * y, z * x, 0 * x]


def _subsidence(x: FloatArray, y: FloatArray, z: FloatArray) -> list[FloatArray]:
    a, b, s = _BASIN
    return [0 * x, 0 * x, -np.exp(-((x - a) ** 2 + (y - b) ** 2) / (2 * s * s))]


def _drift(x: FloatArray, y: FloatArray, z: FloatArray) -> list[FloatArray]:
    return [0 * x, 0.5 * x**3, x * x]


_FIELDS: dict[str, Callable[[FloatArray, FloatArray, FloatArray], list[FloatArray]]] = {
    "dome": _dome,
    "bowl": _bowl,
    "shear": _shear,
    "twist": _twist,
    "subsidence": _subsidence,
    "drift": _drift,
}
KINDS = tuple(_FIELDS)


@dataclass(frozen=True, eq=False)
class Warp:
    """Deformation p -> p + amplitude * field(axes (p - center) / lengths) along the axes, followed by a similarity.

    With x, y, z measured from the centre in units of `lengths`, the fields are: dome (0, 0, -x^2 - y^2); bowl, its
    negative; shear (z^2, 0, 0), which increases with height; twist (-z y, z x, 0), a rotation about the vertical that
    increases with height; subsidence, a Gaussian basin; drift (0, x^3 / 2, x^2) along the cloud's longest horizontal
    axis.

    Args:
        kind: one of `KINDS`.
        amplitude: amplitude in the cloud's unit.
        center: (3,) centre of the field.
        axes: (3, 3) rotation from the cloud's frame to that of the field; both have the same z.
        lengths: (3,) half the cloud's extent along each axis; both horizontal entries are the larger horizontal one.
        after: similarity applied after the displacement.
    """

    kind: str
    amplitude: float
    center: FloatArray
    axes: FloatArray
    lengths: FloatArray
    after: Similarity

    def displacement(self, points: FloatArray) -> FloatArray:
        """Return the displacement (N, 3) of points (N, 3) before the similarity."""
        normalized = (points - self.center) @ self.axes.T / self.lengths
        field = self.amplitude * np.stack(_FIELDS[self.kind](*normalized.T), axis=1)
        moved: FloatArray = field @ self.axes
        return moved

    def apply(self, points: FloatArray) -> FloatArray:
        """Return the deformed points (N, 3)."""
        return self.after.apply(points + self.displacement(points))

    def apply_cloud(self, cloud: Cloud) -> Cloud:
        """Return the deformed cloud; normals rotate with the surface and keep their lengths."""
        normals = cloud.normals
        if normals is not None:
            steps = _DIFFERENCE_STEP * self.lengths.max() * np.eye(3)
            jacobian = np.eye(3) + np.stack(
                [
                    (self.displacement(cloud.points + h) - self.displacement(cloud.points - h)) / (2 * h.max())
                    for h in steps
                ],
                axis=2,
            )
            rotated = np.linalg.solve(jacobian.transpose(0, 2, 1), normals[..., None])[..., 0]
            before, now = (np.linalg.norm(n, axis=1, keepdims=True) for n in (normals, rotated))
            normals = self.after.apply_normals(
                np.divide(rotated * before, now, out=np.zeros_like(rotated), where=now > 0)
            )
        moved = cloud.transformed(self.after)  # drops attributes that a change of frame invalidates
        return replace(moved, points=self.apply(cloud.points), normals=normals)

    def record(self, points: FloatArray) -> dict[str, Any]:
        """Return the parameters and amplitudes of the deformation of `points` (N, 3), as JSON values."""
        displacement = self.displacement(points)
        affine, rest = split_affine(points, displacement)
        return {
            "schema": SCHEMA,
            "kind": self.kind,
            "amplitude": self.amplitude,
            "centre": self.center.tolist(),
            "axes": self.axes.tolist(),
            "lengths": self.lengths.tolist(),
            "after": self.after.matrix.tolist(),
            "rms_displacement": _rms(displacement),
            "rms_beyond_affine": _rms(rest),
            "max_beyond_affine": float(np.linalg.norm(rest, axis=1).max()),
            "affine_part": affine.matrix.tolist(),  # the best affine map before the similarity
        }


def record_path(out: Path) -> Path:
    """Return the path of the JSON record that `write_warped` writes beside the cloud `out`."""
    return out.with_name(f"{out.name}.json")


def write_warped(out: Path, cloud: Cloud, warp: Warp) -> dict[str, Any]:
    """Write a deformed cloud, and beside it a JSON record of the deformation.

    Args:
        out: path of the cloud.
        cloud: cloud to deform.
        warp: deformation.

    Returns:
        The record (`Warp.record`).

    Raises:
        InputError: the extension is unknown or read-only.
        OSError: a file cannot be written.
    """
    record = warp.record(cloud.points)
    write_cloud(out, warp.apply_cloud(cloud))
    with atomic_write(record_path(out)) as file:
        file.write((json.dumps(record, indent=1) + "\n").encode())
    return record


def make_warp(kind: str, points: FloatArray, rms: float, after: Similarity | None = None) -> Warp:
    """Create a deformation of points (N, 3) with a given RMS beyond the best affine map.

    Args:
        kind: one of `KINDS`.
        points: (N, 3) points.
        rms: RMS beyond the best affine map, in the points' unit.
        after: similarity applied after the displacement.

    Raises:
        InputError: the kind is unknown, the RMS is not positive, or an affine map explains the deformation of these
            points completely, such as a shear by height of points at the same height.
    """
    if kind not in _FIELDS:
        raise InputError(f"unknown kind of warp {kind!r}: choose one of {', '.join(KINDS)}{did_you_mean(kind, KINDS)}")
    if not 0 < rms <= MAX_COORDINATE:
        raise InputError(f"expected a positive RMS of the deformation up to {MAX_COORDINATE:g}, got {rms:g}")
    low, high = points.min(axis=0), points.max(axis=0)
    half = (high - low) / 2
    # The field's x axis is the longest horizontal direction.
    flat = points[:, :2] - points[:, :2].mean(axis=0)
    along = np.linalg.eigh(flat.T @ flat)[1][:, -1]
    along = along if along[np.abs(along).argmax()] > 0 else -along
    axes = np.array([[along[0], along[1], 0], [-along[1], along[0], 0], [0, 0, 1]])
    lengths = np.array([half[:2].max(), half[:2].max(), half[2]])
    if not (lengths > 0).all():
        lengths[lengths <= 0] = max(lengths.max(), 1.0)
    unit = Warp(kind, 1.0, (low + high) / 2, axes, lengths, after or Similarity.identity())
    displacement = unit.displacement(points)
    rest = _rms(split_affine(points, displacement)[1])
    if not rest > 1e-9 * max(_rms(displacement), 1e-300):
        raise InputError(
            f"an affine map explains a {kind} of this cloud completely: use a cloud with more points and extent"
        )
    return replace(unit, amplitude=rms / rest)


def split_affine(points: FloatArray, displacement: FloatArray) -> tuple[Affine, FloatArray]:
    """Split a displacement of points (each (N, 3)) into the best affine map and the residual (N, 3).

    A singular value decomposition solves it, so that coplanar points have a solution too.

    Args:
        points: (N, 3) points.
        displacement: (N, 3) displacement.
    """
    centroid = points.mean(axis=0)
    design = np.column_stack([points - centroid, np.full(len(points), np.abs(points - centroid).max() or 1.0)])
    weights = np.linalg.lstsq(design, displacement, rcond=1e-10)[0]
    linear = np.eye(3) + weights[:3].T
    shift = weights[3] * design[0, 3]
    return Affine(linear, centroid + shift - linear @ centroid), displacement - design @ weights


def _rms(vectors: FloatArray) -> float:
    return float(np.sqrt(np.mean(np.square(vectors).sum(axis=1))))


def similarity_from_angles(
    angles_deg: tuple[float, float, float],
    shift: tuple[float, float, float],
    scale: float,
    about: ArrayLike = (0.0, 0.0, 0.0),
) -> Similarity:
    """Return rotations about the x, then the y, then the z axis and a scale, all at `about` (3,), then a shift."""
    rotation = np.eye(3)
    for axis, angle in enumerate(np.radians(angles_deg)):
        c, s = np.cos(angle), np.sin(angle)
        i, j = (axis + 1) % 3, (axis + 2) % 3
        step = np.eye(3)
        step[i, i] = step[j, j] = c
        step[i, j], step[j, i] = -s, s
        rotation = step @ rotation
    return Similarity(rotation, np.array(shift), scale).about(np.asarray(about, np.float64))
