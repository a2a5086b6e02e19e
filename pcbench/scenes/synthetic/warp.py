"""Known deformations: what photogrammetry does to a scene when its cameras are wrong, by a known amount.

Each kind is a smooth displacement field over the cloud's own extent. None of them is affine, but each has an affine
part, which a registration may take up: amplitudes are therefore given by what is left after the best affine map.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from pcbench.errors import InputError
from pcbench.geometry.arrays import MAX_COORDINATE, FloatArray
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.transform import Affine, Similarity
from pcbench.io import write_cloud
from pcbench.io.files import atomic_write

SCHEMA = "pcbench.warp/1"
_BASIN = (0.35, -0.25, 0.30)  # of the subsidence: centre x, y and standard deviation, in lengths
_STEP = 1e-5  # lengths, of the differences that turn normals: truncation and rounding are both about 1e-10


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
    """p -> p + amplitude * field(axes (p - center) / lengths) along the axes, then a similarity.

    With x, y, z in lengths from the centre, the fields are: dome (0, 0, -x^2 - y^2); bowl its negative; shear
    (z^2, 0, 0): the higher, the more; twist (-z y, z x, 0): a turn about the vertical that grows with height;
    subsidence a Gaussian basin; drift (0, x^3 / 2, x^2) along the longest horizontal axis of the cloud.

    Args:
        kind: of `KINDS`.
        amplitude: in the cloud's unit.
        center: (3,).
        axes: (3, 3) rotation from the cloud's frame to that of the field; its z is the cloud's.
        lengths: (3,) half the cloud's extent: horizontally the larger one for both axes.
        after: the similarity.
    """

    kind: str
    amplitude: float
    center: FloatArray
    axes: FloatArray
    lengths: FloatArray
    after: Similarity

    def displacement(self, points: FloatArray) -> FloatArray:
        """What is added to points (N, 3) before the similarity, (N, 3)."""
        at = (points - self.center) @ self.axes.T / self.lengths
        field = self.amplitude * np.stack(_FIELDS[self.kind](*at.T), axis=1)
        moved: FloatArray = field @ self.axes
        return moved

    def apply(self, points: FloatArray) -> FloatArray:
        """Where points (N, 3) go."""
        return self.after.apply(points + self.displacement(points))

    def apply_cloud(self, cloud: Cloud) -> Cloud:
        """The cloud, bent; normals turn with the surface and keep their lengths."""
        normals = cloud.normals
        if normals is not None:
            steps = _STEP * self.lengths.max() * np.eye(3)
            jacobian = np.eye(3) + np.stack(
                [
                    (self.displacement(cloud.points + h) - self.displacement(cloud.points - h)) / (2 * h.max())
                    for h in steps
                ],
                axis=2,
            )
            turned = np.linalg.solve(jacobian.transpose(0, 2, 1), normals[..., None])[..., 0]
            before, now = (np.linalg.norm(n, axis=1, keepdims=True) for n in (normals, turned))
            normals = self.after.apply_normals(
                np.divide(turned * before, now, out=np.zeros_like(turned), where=now > 0)
            )
        moved = cloud.transformed(self.after)  # leaves out what a change of frame makes wrong
        return replace(moved, points=self.apply(cloud.points), normals=normals)

    def record(self, points: FloatArray) -> dict[str, Any]:
        """What was done to `points` (N, 3), for a JSON file: enough to do it again, and the figures to find back."""
        displacement = self.displacement(points)
        affine, rest = without_affine(points, displacement)
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
    """Where `write_warped` says what was done to the cloud in `out`."""
    return out.with_name(f"{out.name}.json")


def write_warped(out: Path, cloud: Cloud, warp: Warp) -> dict[str, Any]:
    """Write a cloud, bent, and beside it as JSON what was done to it.

    Returns:
        The record (`Warp.record`).

    Raises:
        InputError: the extension is unknown or only read.
        OSError: a file cannot be written.
    """
    record = warp.record(cloud.points)
    write_cloud(out, warp.apply_cloud(cloud))
    with atomic_write(record_path(out)) as file:
        file.write((json.dumps(record, indent=1) + "\n").encode())
    return record


def warp_of(kind: str, points: FloatArray, rms: float, after: Similarity | None = None) -> Warp:
    """A deformation of points (N, 3) with an RMS of `rms` (their unit) beyond the best affine map.

    Raises:
        InputError: the kind is unknown, the RMS not positive, or an affine map explains all of it on these points, as
            it does a shear by height of what has no height.
    """
    if kind not in _FIELDS:
        raise InputError(f"unknown kind of warp {kind!r}: choose one of {', '.join(KINDS)}")
    if not 0 < rms <= MAX_COORDINATE:
        raise InputError(f"expected a positive RMS of the deformation up to {MAX_COORDINATE:g}, got {rms:g}")
    low, high = points.min(axis=0), points.max(axis=0)
    half = (high - low) / 2
    # The field's x runs along the longest horizontal direction.
    flat = points[:, :2] - points[:, :2].mean(axis=0)
    along = np.linalg.eigh(flat.T @ flat)[1][:, -1]
    along = along if along[np.abs(along).argmax()] > 0 else -along
    axes = np.array([[along[0], along[1], 0], [-along[1], along[0], 0], [0, 0, 1]])
    lengths = np.array([half[:2].max(), half[:2].max(), half[2]])
    if not (lengths > 0).all():
        lengths[lengths <= 0] = max(lengths.max(), 1.0)
    unit = Warp(kind, 1.0, (low + high) / 2, axes, lengths, after or Similarity.identity())
    displacement = unit.displacement(points)
    rest = _rms(without_affine(points, displacement)[1])
    if not rest > 1e-9 * max(_rms(displacement), 1e-300):
        raise InputError(f"an affine map explains a {kind} of these {len(points)} points: it needs more of an extent")
    return replace(unit, amplitude=rms / rest)


def without_affine(points: FloatArray, displacement: FloatArray) -> tuple[Affine, FloatArray]:
    """The affine map nearest to points -> points + displacement (each (N, 3)), and what it leaves (N, 3).

    By the singular values, so that points in one plane have an answer too.
    """
    middle = points.mean(axis=0)
    design = np.column_stack([points - middle, np.full(len(points), np.abs(points - middle).max() or 1.0)])
    weights = np.linalg.lstsq(design, displacement, rcond=1e-10)[0]
    linear = np.eye(3) + weights[:3].T
    shift = weights[3] * design[0, 3]
    return Affine(linear, middle + shift - linear @ middle), displacement - design @ weights


def _rms(vectors: FloatArray) -> float:
    return float(np.sqrt(np.mean(np.square(vectors).sum(axis=1))))


def turn(
    angles_deg: tuple[float, float, float],
    shift: tuple[float, float, float],
    scale: float,
    about: ArrayLike = (0.0, 0.0, 0.0),
) -> Similarity:
    """Rotations about axes along x, then y, then z, and a scale, all about the place `about` (3,), and a shift."""
    rotation = np.eye(3)
    for axis, angle in enumerate(np.radians(angles_deg)):
        c, s = np.cos(angle), np.sin(angle)
        i, j = (axis + 1) % 3, (axis + 2) % 3
        step = np.eye(3)
        step[i, i] = step[j, j] = c
        step[i, j], step[j, i] = -s, s
        rotation = step @ rotation
    return Similarity(rotation, np.array(shift), scale).about(np.asarray(about, np.float64))
