"""Patches: the points within a radius of seeds, with the surface through each and the spread of the points about it.

A patch is flat if its points extend in two directions and lie close to a surface of second order; the noise is their
robust spread along the normal. Seeds are the first points of voxels with the radius as edge, so that they are spread
over the surface and not over the points.
"""

from __future__ import annotations

from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from pcbench.geometry.arrays import FloatArray, IntArray
from pcbench.geometry.neighbors import Index, is_kept
from pcbench.geometry.voxels import voxel_downsample
from pcbench.measure.quality.groups import PointGroups

RADIUS_SPACINGS = 8.0
"""Radius of a patch in spacings: about 45 points of a surface with strewn points."""
MIN_FLAT_PATCHES = 30
"""Flat patches below which noise is not reported."""
_MAX_SEEDS, _TRIAL_SEEDS = 20_000, 1_500
_DOUBLINGS = 4  # of the radius, at most
_MAX_NOISE_SHARE = 0.1  # of the radius: thicker surfaces need a larger one
_MIN_TRIAL_SHARE = 0.15  # of patches that are flat, for a radius to suit
_MAX_EXTENT_SHARE = 0.1  # of the extent, for the radius
_MEAN_POINTS, _MAX_MEAN_POINTS = 60.0, 90.0  # in a patch, to which denser clouds are thinned
_CHUNK_ROWS = 2_000_000  # neighbours at once
_MIN_BREADTH = 0.12  # second over first eigenvalue: points along a line have less
_MAX_FLATNESS = 0.3  # noise over the standard deviation along the surface
_MAX_CENTRE_OFFSET = 0.5  # of the radius, from the seed to the centroid: beyond it, the seed is at an edge
_REJECT_SIGMAS = 3.5  # beyond which points of a patch are outliers
_TERMS = 6  # of a surface of second order
_MIN_CURVATURE_GAIN = 0.6  # of the plane's variance, that remains about a curved surface: below it, it is curved


class SurfacePatches(NamedTuple):
    """Patches of a cloud; P patches.

    Attributes:
        centres: (P, 3) centroids.
        normals: (P, 3) unit normals, oriented upwards.
        noise: (P,) robust standard deviation of the points about the surface of second order.
        relief: (P,) standard deviation of the points about the plane, which the shape of the surface is part of.
        thickness: (P,) width along the normal that holds 90 % of the points, less the surface's curvature.
        counts: (P,) number of points.
        is_flat: (P,) whether the points lie on a surface.
        is_plane: (P,) whether they lie on a plane.
        radius: radius of the neighbourhoods.
    """

    centres: FloatArray
    normals: FloatArray
    noise: FloatArray
    relief: FloatArray
    thickness: FloatArray
    counts: IntArray
    is_flat: NDArray[np.bool_]
    is_plane: NDArray[np.bool_]
    radius: float

    def select(self, mask: NDArray[np.bool_]) -> Self:
        """Return the patches of a mask (P,)."""
        return self._replace(**{name: getattr(self, name)[mask] for name in self._fields if name != "radius"})


def seeds_of(points: FloatArray, radius: float, seed: int, most: int = _MAX_SEEDS) -> FloatArray:
    """Return the first points (S, 3) of voxels with an edge, a random sample of them if there are more than `most`."""
    rows = voxel_downsample(points, radius)
    if len(rows) > most:
        rows = np.sort(np.random.default_rng(seed).choice(rows, most, replace=False))
    return points[rows]


def choose_radius(index: Index, spacing: float, extent: float, min_neighbors: int, seed: int) -> float:
    """Return the radius of patches: 8 spacings, doubled while the noise exceeds a tenth of it.

    If it always does, the radius is the one that it exceeds least; if few patches are flat, 8 spacings.
    """
    first, ratios = RADIUS_SPACINGS * spacing, dict[float, float]()
    for radius in [first * 2.0**doubling for doubling in range(_DOUBLINGS + 1)]:
        if radius > max(_MAX_EXTENT_SHARE * extent, first):
            break
        patches = fit_patches(index, seeds_of(index.points, radius, seed, _TRIAL_SEEDS), radius, min_neighbors, seed)
        flat = patches.is_flat
        if np.count_nonzero(flat) < max(_MIN_TRIAL_SHARE * len(flat), MIN_FLAT_PATCHES):
            continue
        ratios[radius] = float(np.median(patches.noise[flat])) / radius
        if ratios[radius] <= _MAX_NOISE_SHARE:
            break
    return min(ratios, key=ratios.__getitem__, default=first)


def fit_patches(index: Index, seeds: FloatArray, radius: float, min_neighbors: int, seed: int) -> SurfacePatches:
    """Fit a surface to the points within a radius of each seed (S, 3).

    Seeds with fewer than `min_neighbors` points have no patch.
    """
    parts = [
        _fit(seeds[start : start + len(members.counts)], members, radius)
        for start, members in neighborhoods(index, seeds, radius, min_neighbors, seed)
    ]
    columns: dict[str, Any] = {
        name: np.concatenate([getattr(part, name) for part in parts])
        for name in SurfacePatches._fields
        if name != "radius"
    }
    patches = SurfacePatches(**columns, radius=radius)
    return patches.select(patches.counts >= min_neighbors)


def neighborhoods(
    index: Index, seeds: FloatArray, radius: float, min_neighbors: int, seed: int
) -> list[tuple[int, PointGroups]]:
    """Return the points within a radius of each seed (S, 3), some seeds at once.

    A cloud with more than 90 points per patch is thinned at random to 60, so that a large radius costs no more.
    """
    share = thinning_share(index, seeds, radius, min_neighbors, seed)
    kept = np.flatnonzero(is_kept(np.arange(len(index)), share, seed)) if share < 1 else np.arange(len(index))
    searched = index if share == 1 else Index(index.points[kept])
    mean = max(_mean_count(searched, seeds, radius, seed), 1.0)
    size = max(int(_CHUNK_ROWS / mean), 1)
    return [
        (start, PointGroups.of(searched.query_radius(seeds[start : start + size], radius), index.points, kept))
        for start in range(0, len(seeds), size)
    ]


def thinning_share(index: Index, seeds: FloatArray, radius: float, min_neighbors: int, seed: int) -> float:
    """Return the share of the points that is kept, so that patches have about 60 points on average."""
    mean, wanted = _mean_count(index, seeds, radius, seed), max(_MEAN_POINTS, 5.0 * min_neighbors)
    return 1.0 if mean <= max(_MAX_MEAN_POINTS, 1.5 * wanted) else wanted / mean


def _mean_count(index: Index, seeds: FloatArray, radius: float, seed: int) -> float:
    rows = np.random.default_rng(seed).integers(0, len(seeds), 64)
    return float(index.query_radius(seeds[rows], radius).counts.mean())


def _fit(seeds: FloatArray, groups: PointGroups, radius: float) -> SurfacePatches:
    """Fit patches: a plane, again without outliers, and a surface of second order."""
    offsets = groups.values - seeds[groups.of_row]
    weights = np.ones(len(offsets))
    centres, values, axes = groups.principal_axes(offsets, weights)
    heights = groups.along(offsets - centres[groups.of_row], axes[:, :, 0])
    middle, spread = groups.median_and_sigma(heights)
    weights = (np.abs(heights - middle[groups.of_row]) <= _REJECT_SIGMAS * spread[groups.of_row]).astype(float)
    weights[np.repeat(spread == 0, groups.counts)] = 1.0
    centres, values, axes = groups.principal_axes(offsets, weights)
    local = np.stack([groups.along(offsets - centres[groups.of_row], axes[:, :, k]) for k in (1, 2, 0)], axis=1)
    plane_variance = groups.sums(weights * local[:, 2] ** 2) / np.maximum(groups.sums(weights) - 3, 1)
    residuals = _residuals(groups, local / radius, weights) * radius
    _, noise = groups.median_and_sigma(residuals)
    noise *= np.sqrt(groups.counts / np.maximum(groups.counts - _TERMS, 1))
    curved_variance = groups.sums(weights * residuals**2) / np.maximum(groups.sums(weights) - _TERMS, 1)
    low, high = groups.quantiles(residuals, (0.05, 0.95))
    breadth = np.sqrt(np.maximum(values[:, 1], 0))
    is_flat = (
        (values[:, 1] > _MIN_BREADTH * values[:, 2])
        & (noise < _MAX_FLATNESS * breadth)
        & (np.sqrt(np.maximum(values[:, 0], 0)) < 2 * _MAX_FLATNESS * breadth)
        & (np.linalg.norm(centres, axis=1) < _MAX_CENTRE_OFFSET * radius)
    )
    is_plane = is_flat & ((curved_variance > _MIN_CURVATURE_GAIN * plane_variance) | (plane_variance == 0))
    normals = axes[:, :, 0] * np.where(axes[:, 2:, 0] < 0, -1.0, 1.0)
    return SurfacePatches(
        centres + seeds, normals, noise, np.sqrt(plane_variance), high - low, groups.counts, is_flat, is_plane, radius
    )


def _residuals(groups: PointGroups, local: FloatArray, weights: FloatArray) -> FloatArray:
    """Return the heights (N,) of points above surfaces of second order through the points of each group."""
    u, v, height = local.T
    terms = np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=1)
    moments = np.empty((len(groups.counts), _TERMS, _TERMS))
    right = np.empty((len(groups.counts), _TERMS))
    for row in range(_TERMS):
        right[:, row] = groups.sums(weights * terms[:, row] * height)
        for column in range(row, _TERMS):
            moments[:, row, column] = moments[:, column, row] = groups.sums(weights * terms[:, row] * terms[:, column])
    scale = np.maximum(moments[:, 0, 0], 1.0)
    moments += (1e-9 * scale)[:, None, None] * np.eye(_TERMS)  # where the points lie on a line
    solved = np.linalg.solve(moments, right[:, :, None])[:, :, 0]
    fitted: FloatArray = np.einsum("ni,ni->n", terms, solved[groups.of_row])
    residuals: FloatArray = height - fitted
    return residuals
