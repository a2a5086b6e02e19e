"""Ladders of deformations, for the verdicts; levels are the RMS along the normals beyond an affine motion, in noises.

One noise is the standard deviation of the difference of both clouds. The affine part of each field, as far as the
surface shows it, is removed: a registration and an affine motion explain nothing of what is left.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from pcbench.geometry.arrays import FloatArray
from pcbench.scenes.synthetic.warp import make_warp
from pcbench.studies.stress.ladders.ladder import Ladder
from pcbench.studies.stress.scenes import StressPair
from pcbench.studies.stress.verdicts import VERDICTS

Field = Callable[[FloatArray, np.random.Generator], FloatArray]

_LEVELS = (0, 0.25, 0.5, 1, 2, 4, 10)
_GRID = 5  # control points along each axis of a free-form deformation, as in ModelNet40-C
_CENTRES = 16  # of a radial-basis deformation


def _warp_field(kind: str) -> Field:
    def field(points: FloatArray, _: np.random.Generator) -> FloatArray:
        displacement: FloatArray = make_warp(kind, points, 1.0).displacement(points)
        return displacement

    return field


def _free_form(points: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Displace a grid of control points at random; Bernstein polynomials interpolate (Sederberg and Parry 1986)."""
    low, high = points.min(axis=0), points.max(axis=0)
    shares = (points - low) / np.where(high > low, high - low, 1.0)
    control = rng.normal(size=(_GRID, _GRID, _GRID, 3))
    weights = [_bernstein(shares[:, axis]) for axis in range(3)]
    displacement: FloatArray = np.einsum("ni,nj,nk,ijkc->nc", *weights, control, optimize=True)
    return displacement


def _radial_basis(points: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Displace random centres at random; Gaussian kernels of a fifth of the extent carry it to the points."""
    centres = points[rng.integers(len(points), size=_CENTRES)]
    width = 0.2 * float(np.ptp(points, axis=0).max())
    distances = np.square(points[:, None] - centres[None]).sum(axis=2)
    displacement: FloatArray = np.exp(-0.5 * distances / width**2) @ rng.normal(size=(_CENTRES, 3))
    return displacement


def _bent(field: Field) -> Callable[[StressPair, float, np.random.Generator], StressPair]:
    def perturb(pair: StressPair, level: float, rng: np.random.Generator) -> StressPair:
        displacement = field(pair.points, rng)
        left, along = split_observable_affine(pair.points, pair.normals, displacement)
        rms = float(np.sqrt(np.mean(along**2)))
        size = level * float(np.hypot(pair.noise, pair.candidate_noise))
        moved = pair.with_points(pair.points + left * (size / rms))
        return replace(moved, true_rms=size)

    return perturb


def _sheared(pair: StressPair, level: float, rng: np.random.Generator) -> StressPair:
    """Shear the candidate, an affine deformation; levels are the RMS along the normals."""
    centred = pair.points - pair.points.mean(axis=0)
    angle = rng.uniform(0, 2 * np.pi)
    direction = np.array([np.cos(angle), np.sin(angle), 0.0])
    displacement = centred[:, [2]] * direction + (centred @ direction)[:, None] * [0.0, 0.0, 1.0]
    along = np.einsum("ni,ni->n", displacement, pair.normals)
    size = level * float(np.hypot(pair.noise, pair.candidate_noise))
    return pair.with_points(pair.points + displacement * (size / float(np.sqrt(np.mean(along**2)))))


def split_observable_affine(
    points: FloatArray, normals: FloatArray, displacement: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Remove from a displacement (N, 3) the affine motion that explains most of it along the normals (N, 3).

    Returns:
        The displacement that is left (N, 3), and its components along the normals (N,).
    """
    centred = points - points.mean(axis=0)
    scale = float(np.abs(centred).max())
    columns = np.column_stack([centred / scale, np.ones(len(points))])  # (N, 4)
    design = (normals[:, :, None] * columns[:, None, :]).reshape(len(points), 12)
    along = np.einsum("ni,ni->n", displacement, normals)
    weights = np.linalg.lstsq(design, along, rcond=1e-8)[0].reshape(3, 4)
    left: FloatArray = displacement - columns @ weights.T
    return left, np.einsum("ni,ni->n", left, normals)


def _bernstein(t: FloatArray) -> FloatArray:
    """Return (N, 5) Bernstein polynomials of degree 4."""
    binomials = (1, 4, 6, 4, 1)
    return np.stack([b * t**k * (1 - t) ** (4 - k) for k, b in enumerate(binomials)], axis=1)


def _warp_ladder(name: str, title: str, field: Field, quick: tuple[float, ...] = ()) -> Ladder:
    return Ladder(f"warp-{name}", title, "warp", "x noise", _LEVELS, quick, _bent(field), (VERDICTS,))


WARP_LADDERS = (
    _warp_ladder("dome", "dome", _warp_field("dome"), (0, 1, 4)),
    _warp_ladder("twist", "twist about the vertical", _warp_field("twist")),
    _warp_ladder("subsidence", "local basin", _warp_field("subsidence")),
    _warp_ladder("drift", "drift along the strip", _warp_field("drift")),
    _warp_ladder("free-form", "free-form deformation", _free_form),
    _warp_ladder("radial-basis", "radial-basis deformation", _radial_basis),
    Ladder("shear", "shear (affine)", "warp", "x noise", _LEVELS, (), _sheared, (VERDICTS,)),
)
