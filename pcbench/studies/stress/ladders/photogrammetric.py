"""Ladders of measured photogrammetric noise: distances of reconstructed clouds to their exact surface, resampled.

Errors of dense stereo and of splatting have heavy tails, are correlated over several points, and are larger on steep
surfaces and beside edges. A block bootstrap keeps all of this: whole patches of the measured errors are laid on the
surface, chosen at random among those of the same stratum (Künsch, "The jackknife and the bootstrap for general
stationary observations", Annals of Statistics 17, 1989; for spatial data Lahiri, "Resampling Methods for Dependent
Data", 2003, chapter 12). A stratum is level or steep, beside an edge or away from it.
`benchmarks/photogrammetric_noise.py` measures the patches.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache, partial
from importlib.resources import files

import numpy as np
from numpy.typing import NDArray

from pcbench.geometry.arrays import FloatArray, IntArray
from pcbench.geometry.mesh import MeshIndex
from pcbench.geometry.neighbors import Index
from pcbench.geometry.sampling import median_spacing
from pcbench.measure.metrics import nmad
from pcbench.studies.stress.ladders.ladder import Ladder
from pcbench.studies.stress.metrics import METRICS
from pcbench.studies.stress.registration import REGISTRATION
from pcbench.studies.stress.scenes import StressPair
from pcbench.studies.stress.verdicts import VERDICTS

PATCHES = "photogrammetric_noise.npz"
PATCH_CELLS = 32  # cells along each side of a patch; a cell is as wide as the point spacing
STRATA = ("level", "steep", "level edge", "steep edge")
_LEVELS = (0, 0.5, 1, 2, 4, 8)
_STEEP = 0.5  # vertical component of the normal up to which a surface is steep
EDGE_RADIUS = 3.0  # spacings from a point to a surface of another direction, for the point to be beside an edge
_EDGE_COSINE = 0.7  # between the directions of two surfaces that meet in an edge
_RAYS = 16  # rays per side that tell the open side
_RAY_START = 1e-3  # spacings from the surface to their start
_BLOCK = 0.7 * PATCH_CELLS  # spacings between the centres of neighbouring patches, so that patches cover the surface
# Patches hold a byte per cell: asinh(value / _LINEAR) * _STEPS, accurate to 3 % and up to 200 NMAD.
_LINEAR, _STEPS = 0.1, 15.3


def encode_patches(values: FloatArray) -> NDArray[np.int8]:
    """Return errors in units of their NMAD as bytes; `decode_patches` is the inverse up to rounding."""
    return np.clip(np.round(np.arcsinh(values / _LINEAR) * _STEPS), -127, 127).astype(np.int8)


def decode_patches(codes: NDArray[np.int8]) -> FloatArray:
    """Return errors in units of their NMAD from bytes."""
    values: FloatArray = _LINEAR * np.sinh(codes.astype(np.float64) / _STEPS)
    return values


@cache
def measured_patches(method: str) -> FloatArray:
    """Return the measured errors of `mvs` or `splat` in units of their NMAD: (strata, patches, cells, cells)."""
    with (files("pcbench.studies.stress.ladders") / PATCHES).open("rb") as stream, np.load(stream) as arrays:
        return decode_patches(arrays[method])


def strata_of(
    normals: FloatArray, points: FloatArray, surface: Index, directions: FloatArray, radius: float
) -> IntArray:
    """Return the stratum (N,) of each point, an index into `STRATA`.

    Args:
        normals: (N, 3) normals of the surface at the points.
        points: (N, 3) points of the surface.
        surface: index of M points that cover the surface.
        directions: (M, 3) normals at these points.
        radius: distance up to which a point is beside an edge.
    """
    near = surface.query_radius(points, radius)
    first = np.repeat(np.arange(len(points)), near.counts)
    turned = np.abs(np.einsum("ni,ni->n", normals[first], directions[near.indices])) < _EDGE_COSINE
    beside = np.bincount(first[turned], minlength=len(points)) > 0
    return 2 * beside + (np.abs(normals[:, 2]) < _STEEP)


def resampled_errors(
    points: FloatArray,
    normals: FloatArray,
    patches: FloatArray,
    spacing: float,
    rng: np.random.Generator,
    *,
    oriented: bool = True,
) -> FloatArray:
    """Return errors (N,) at points of a surface, in units of the NMAD of the measured ones.

    In each stratum the points are divided into blocks about random centres. A block takes its errors from a random
    patch of the stratum, turned at random about the normal. The distance from the centre is kept, also where the
    surface bends.

    Args:
        points: (N, 3) points of the surface.
        normals: (N, 3) unit normals.
        patches: errors as from `measured_patches`.
        spacing: length of a cell of the patches.
        rng: random generator.
        oriented: whether all normals point to the visible side; otherwise errors of steep surfaces get a random sign
            per block, because a one-sided error would displace walls that face each other in the same direction.
    """
    strata = strata_of(normals, points, Index(points), normals, EDGE_RADIUS * spacing)
    errors = np.zeros(len(points))
    for stratum, measured in enumerate(patches):
        rows = np.flatnonzero(strata == stratum)
        if len(rows):
            has_sides = oriented or not STRATA[stratum].startswith("steep")
            errors[rows] = _blocks(points[rows], normals[rows], measured, spacing, rng, has_sides=has_sides)
    return errors


def _blocks(
    points: FloatArray,
    normals: FloatArray,
    patches: FloatArray,
    spacing: float,
    rng: np.random.Generator,
    *,
    has_sides: bool,
) -> FloatArray:
    """Return errors (N,) of one stratum from its patches.

    Without sides, normals may point to either side, also at neighbouring points. Each block then gets a random sign,
    and a point whose normal is opposite to that of the block's centre gets the opposite sign.
    """
    cells = np.floor((points - rng.uniform(0, 1, 3)) / (_BLOCK * spacing)).astype(np.int64)
    order = rng.permutation(len(points))
    _, first = np.unique(cells[order], axis=0, return_index=True)
    centres = order[first]
    block = Index(points[centres]).query(points).indices.ravel()
    patch, turn = rng.integers(len(patches), size=len(centres)), rng.uniform(0, 2 * np.pi, len(centres))
    u, v = _tangents(normals[centres], turn)
    offsets = (points - points[centres][block]) / spacing
    flat = np.stack([np.einsum("ni,ni->n", offsets, axis[block]) for axis in (u, v)], axis=1)
    lengths = np.linalg.norm(flat, axis=1, keepdims=True)
    flat *= np.linalg.norm(offsets, axis=1, keepdims=True) / np.where(lengths > 0, lengths, 1.0)
    row, column = _folded(np.floor(flat + PATCH_CELLS / 2).astype(np.int64)).T
    errors: FloatArray = patches[patch[block], row, column]
    if has_sides:
        return errors
    agreement = np.where(np.einsum("ni,ni->n", normals, normals[centres][block]) < 0, -1.0, 1.0)
    signs: FloatArray = agreement * rng.choice([-1.0, 1.0], len(centres))[block]
    return errors * signs


def outward_normals(points: FloatArray, normals: FloatArray, surface: MeshIndex, spacing: float) -> FloatArray:
    """Return normals (N, 3) that point to the side of the surface that is open to the sky.

    It is the side from which more upward rays leave the scene; where neither side has any, as in a room, rays in all
    directions count.

    Args:
        points: (N, 3) points at the surface.
        normals: (N, 3) unit normals of either side.
        surface: index of the surface.
        spacing: spacing of the points.
    """
    closest = surface.query(points).closest
    rays = np.random.default_rng(0).normal(size=(_RAYS, 3))
    upward, all_directions = np.zeros((2, len(points)))
    for side in (1.0, -1.0):
        start = closest + side * _RAY_START * spacing * normals
        for ray in rays:
            away = np.where(side * (normals @ ray) < 0, -1.0, 1.0)[:, None] * ray
            leaves = ~surface.is_occluded(start, away)
            upward += side * (leaves & (away[:, 2] > 0))
            all_directions += side * leaves
    turned: FloatArray = np.where(np.where(upward != 0, upward, all_directions) < 0, -1.0, 1.0)[:, None] * normals
    return turned


def _tangents(normals: FloatArray, turn: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return two perpendicular unit vectors (N, 3) across the normals, turned by angles (N,) about them."""
    helper = np.where(np.abs(normals[:, [2]]) < 0.9, [0.0, 0.0, 1.0], [1.0, 0.0, 0.0])
    first = np.cross(helper, normals)
    size = np.linalg.norm(first, axis=1, keepdims=True)
    first = np.where(size > 0, first / np.where(size > 0, size, 1.0), [0.0, 1.0, 0.0])
    second = np.where(size > 0, np.cross(normals, first), [0.0, 0.0, 1.0])
    cos, sin = np.cos(turn)[:, None], np.sin(turn)[:, None]
    return cos * first + sin * second, cos * second - sin * first


def _folded(cells: IntArray) -> IntArray:
    """Return cells beyond the border of a patch reflected into it."""
    inside = np.mod(cells, 2 * PATCH_CELLS)
    return np.where(inside < PATCH_CELLS, inside, 2 * PATCH_CELLS - 1 - inside)


def _photogrammetric(pair: StressPair, level: float, rng: np.random.Generator, *, method: str) -> StressPair:
    """Displace points along the normals by measured errors, whose NMAD becomes `level` spacings of the reference.

    Cells of the patches become as wide as the spacing of the candidate: neighbouring points are correlated as measured.
    """
    if level == 0:
        return pair
    spacing, patches = median_spacing(Index(pair.points)), measured_patches(method)
    has_normal = np.linalg.norm(pair.normals, axis=1, keepdims=True) > 0.5
    normals = np.where(has_normal, pair.normals, [0.0, 0.0, 1.0])
    if pair.surface is not None:
        normals = outward_normals(pair.points, normals, MeshIndex(pair.surface), spacing)
    errors = resampled_errors(pair.points, normals, patches, spacing, rng, oriented=pair.surface is not None)
    errors *= level * pair.spacing / nmad(errors)
    moved = pair.with_points(pair.points + errors[:, None] * normals)
    return replace(moved, candidate_noise=float(np.hypot(pair.candidate_noise, level * pair.spacing)))


_SUBJECTS = (REGISTRATION, METRICS, VERDICTS)
PHOTOGRAMMETRIC_LADDERS = tuple(
    Ladder(
        f"noise-{method}",
        f"noise of {method}",
        "noise",
        "spacings",
        _LEVELS,
        (),
        partial(_photogrammetric, method=method),
        _SUBJECTS,
    )
    for method in ("mvs", "splat")
)
