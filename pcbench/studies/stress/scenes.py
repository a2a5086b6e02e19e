"""Pairs of clouds with a known true pose: two independent samples of a built-in scene, or a given pair."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pcbench.errors import InputError, RegistrationError
from pcbench.geometry.arrays import FloatArray, IntArray
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.mesh import Mesh, MeshIndex
from pcbench.geometry.neighbors import Index
from pcbench.geometry.normals import estimate_normals
from pcbench.geometry.sampling import median_spacing
from pcbench.geometry.transform import Similarity
from pcbench.geometry.voxels import robust_bounds
from pcbench.registration import as_similarity, register
from pcbench.registration.result import UNOBSERVABLE
from pcbench.studies.stress.descriptions import SceneInfo
from pcbench.studies.stress.surfaces import CITY_SIDE, DEGENERATE, FREE, SURFACES, wooded_surface
from pcbench.studies.stress.vegetation import plants_of

GIVEN = "given"  # name of the scene of a given pair
SHAPES = "shapes"  # name of the scene that stands for all degenerate surfaces
WOODED = "wooded city"  # name of the scene of ladders that need vegetation
SCENES = tuple(SURFACES)
# Standard deviations of each cloud's noise, in metres.
_NOISE = {"city": 0.03, WOODED: 0.03, "terrain": 0.03, "room": 0.003, "object": 0.001}
_DEGENERATE_NOISE = 0.02
POINTS, QUICK_POINTS = 24_000, 8_000  # of the reference; the candidate has half of them
_MAX_GIVEN_POINTS = 60_000  # of each cloud of a given pair


@dataclass(frozen=True, eq=False)
class TrueChange:
    """A change between the clouds of a pair.

    Attributes:
        kinds: kinds of changes that are right; see `pcbench.changes.result`.
        points: (K, 3) points of both clouds that belong to it, at the true pose.
        size: length by which it moved, in the clouds' unit; None for an added or removed object.
    """

    kinds: tuple[str, ...]
    points: FloatArray
    size: float | None = None


@dataclass(frozen=True, eq=False)
class StressPair:
    """A reference and a candidate, with the truth.

    Attributes:
        reference: (N, 3) points of the reference.
        points: (M, 3) points of the candidate at its true pose, in the reference's coordinates.
        normals: (M, 3) true normals of the surface at the candidate's points; zero for outliers, and estimated for a
            given pair.
        spacing: median spacing of the reference.
        extent: side of the cube that holds the middle 98 % of the reference.
        noise: standard deviation of the reference's noise along each axis; for a given pair, the RMS residual of its
            registration.
        candidate_noise: the same for the candidate.
        T_true: true transform from candidate to reference coordinates.
        surface: true surface of the reference; None if unknown.
        true_rms: RMS of the candidate's deformation along the normals, beyond an affine one.
        free: whether the geometry does not determine the pose.
        plants: (M,) number of the plant that each point of the candidate shows, -1 for none; None without vegetation.
        change: what changed between the clouds; None for nothing.
    """

    reference: FloatArray
    points: FloatArray
    normals: FloatArray
    spacing: float
    extent: float
    noise: float
    candidate_noise: float
    T_true: Similarity
    surface: Mesh | None = None
    true_rms: float = 0.0
    free: bool = False
    plants: IntArray | None = None
    change: TrueChange | None = None

    @cached_property
    def candidate(self) -> FloatArray:
        """Points (M, 3) of the candidate in its own coordinates, as a method gets them."""
        return self.T_true.inverse().apply(self.points)

    @property
    def tolerance(self) -> float:
        """Largest RMS error of a right pose: the spacing of the reference, or the candidate's noise if it is larger."""
        return max(self.spacing, self.candidate_noise)

    def with_points(self, points: FloatArray, normals: FloatArray | None = None) -> StressPair:
        """Return the pair with other points of the candidate at its true pose."""
        if normals is None:
            return replace(self, points=points)
        return replace(self, points=points, normals=normals, plants=None)

    def select(self, which: NDArray[Any]) -> StressPair:
        """Return the pair with some points of the candidate, given by a mask or indices."""
        plants = None if self.plants is None else self.plants[which]
        return replace(self, points=self.points[which], normals=self.normals[which], plants=plants)

    def info(self, name: str, unit: str = "m") -> SceneInfo:
        """Return the description of the pair as a scene."""
        noise = None if self.surface is None else self.noise
        return SceneInfo(name, self.extent, self.spacing, noise, unit, (len(self.reference), len(self.points)))


def scene_pair(name: str, seed: int, points: int) -> StressPair:
    """Return a pair of a built-in scene: two independent samples with noise, at the true pose.

    Args:
        name: one of `SCENES`, or `WOODED`.
        seed: random seed of the scene and its samples.
        points: number of points of the reference; the candidate has half of them.
    """
    if name != WOODED:
        return _sampled_pair(name, SURFACES[name](seed), _NOISE[name], seed, points)
    surface, plants = wooded_surface(seed)
    pair = _sampled_pair(name, surface, _NOISE[name], seed, points)
    clean, _ = _sample(name, surface, points // 2, seed, 1)
    return replace(pair, plants=plants[MeshIndex(surface).query(clean).faces])


def degenerate_pair(name: str, seed: int, points: int) -> StressPair:
    """Return a pair of a surface whose pose is not determined, or hardly so; see `DEGENERATE`."""
    pair = _sampled_pair(name, DEGENERATE[name](seed), _DEGENERATE_NOISE, seed, points)
    return replace(pair, free=name in FREE)


def given_pair(reference: Cloud, candidate: Cloud, method: str) -> StressPair:
    """Return a given pair; its true pose is the one that a registration method finds without doubt.

    Args:
        reference: the reference.
        candidate: the candidate.
        method: registration method, as for `pcbench.register`.

    Raises:
        InputError: the method finds no pose or a doubtful one, or the geometry does not fix the pose.
    """
    try:
        registration = register(reference, candidate, method)
    except RegistrationError as error:
        raise InputError(f"the study needs a true pose, and `{method}` finds none: {error}") from error
    if registration.doubtful:
        reasons = "; ".join(str(notice) for notice in registration.warnings)
        raise InputError(
            f"the study needs a true pose, and the one that `{method}` finds is doubtful: {reasons}; choose another"
            " --register, such as matrix:FILE with a surveyed pose"
        )
    for notice in registration.warnings:
        if notice.code == UNOBSERVABLE:
            raise InputError(f"the study needs a true pose: {notice}; use clouds with surfaces in several directions")
    T = registration.T_reference_candidate
    fixed, moving = (_thinned(cloud.points) for cloud in (reference, candidate))
    points = T.apply(moving)
    extent = extent_of(fixed)
    return StressPair(
        reference=fixed,
        points=points,
        normals=estimate_normals(Index(points)).directions,
        spacing=median_spacing(Index(fixed)),
        extent=extent,
        noise=registration.rmse,
        candidate_noise=registration.rmse,
        T_true=T,
        plants=plants_of(points, reference, extent),
    )


def extent_of(points: FloatArray) -> float:
    """Return the side of the cube that holds the middle 98 % of points (N, 3)."""
    lower, upper = robust_bounds(points)
    return float((upper - lower).max())


def _sampled_pair(name: str, surface: Mesh, noise: float, seed: int, points: int) -> StressPair:
    reference, _ = _sample(name, surface, points, seed, 0)
    clean, normals = _sample(name, surface, points // 2, seed, 1)
    rng = np.random.default_rng([seed, 4])
    reference = reference + rng.normal(0, noise, reference.shape)
    clean = clean + rng.normal(0, noise, clean.shape)
    return StressPair(
        reference=reference,
        points=clean,
        normals=normals,
        spacing=median_spacing(Index(reference)),
        extent=extent_of(reference),
        noise=noise,
        candidate_noise=noise,
        T_true=as_similarity(np.eye(4)),
        surface=surface,
    )


def _sample(name: str, surface: Mesh, count: int, seed: int, which: int) -> tuple[FloatArray, FloatArray]:
    """Return points and normals; those of cities lie in their middle square."""
    if name not in ("city", WOODED):
        cloud = surface.sample(count, 2 * seed + which)
    else:
        cloud = surface.sample(4 * count, 2 * seed + which)
        cloud = cloud.select(np.flatnonzero(np.abs(cloud.points[:, :2]).max(axis=1) < CITY_SIDE / 2)[:count])
    assert cloud.normals is not None
    return cloud.points, cloud.normals


def _thinned(points: FloatArray) -> FloatArray:
    if len(points) <= _MAX_GIVEN_POINTS:
        return points
    return np.random.default_rng(0).permutation(points)[:_MAX_GIVEN_POINTS]
