"""Volume of change along normals, from M3C2 at core points: for cliffs, facades and overhangs.

A DEM of difference has one height per cell, so that it is blind to what lies below an overhang and stretches what
happens on a wall. Here a change is measured along the normal of the surface (Lague et al. 2013), and its volume is the
sum of distances times the surface that each core point stands for.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from pcbench.geometry.arrays import FloatArray, IntArray
from pcbench.geometry.neighbors import Index
from pcbench.geometry.normals import Surface
from pcbench.geometry.order_statistics import NORMAL_MAD
from pcbench.geometry.voxels import cells
from pcbench.measure.dem.covariance import Mask
from pcbench.measure.dem.volumes import CutFill, EstimatedChange
from pcbench.measure.deviation import M3C2, m3c2

_RADIUS_SPACINGS = 3.0
_HALF_LENGTH_RADII = 8.0
STEEP_DEG = 60.0
"""Slope from which a surface counts as steep: a cell of a DEM is then seen from the side."""
_SAMPLE, _LAG_BINS = 1500, 24
_NEIGHBORS = 8  # of a core point, with which its normal agrees


@dataclass(frozen=True, eq=False)
class NormalVolume:
    """The volume of change along normals.

    Attributes:
        m3c2: distances at the core points, of which there is one per cube of the edge `side`.
        areas: (K,) surface that each core point stands for.
        side: edge of the cubes, the diameter of the cylinders.
        area: surface with a distance.
        void_area: surface without points of the later epoch in reach.
        volumes: volumes in front of the surface (fill), behind it (cut), and their difference. Fill and cut are sums
            by the sign of each core point, which errors enlarge, so that only the difference has an interval.
        mean: mean distance.
        steep_share: share of the surface that is steeper than `STEEP_DEG` or overhangs.
        undetected_share: share of the surface whose change is below the level of detection.
    """

    m3c2: M3C2
    areas: FloatArray
    side: float
    area: float
    void_area: float
    volumes: CutFill
    mean: EstimatedChange
    steep_share: float
    undetected_share: float


def volume_along_normals(
    before: FloatArray, after: FloatArray, *, datum_sigma: float = 0.0, seed: int = 0
) -> NormalVolume:
    """Measure the volume between two clouds along the normals of the first.

    The fill lies on the side that the normals point to. They agree on each connected surface, which faces upwards on
    the whole: a cliff with its top and its foot faces away from the rock. Which side of a lone wall is its front is
    unknown.

    Args:
        before: points (N, 3) of the first epoch.
        after: points (M, 3) of the second epoch.
        datum_sigma: standard deviation of an offset in height between the epochs.
        seed: random seed of the sample from which the correlation of errors is estimated.
    """
    origin = before.mean(axis=0)
    first, second = Index(before - origin), Index(after - origin)
    surface = Surface(first)
    radius = _RADIUS_SPACINGS * max(surface.spacing, Surface(second).spacing)
    side = 2 * radius
    low = first.points.min(axis=0)
    grid = cells(first.points, side, low)
    cores = np.stack([grid.means(first.points[:, axis]) for axis in range(3)], axis=1)
    cubes, counts = np.floor((first.points[grid.first] - low) / side).astype(np.int64), grid.counts
    normals = surface.normals(first.query(cores).indices)
    usable = np.isfinite(normals).all(axis=1)
    cores, normals = cores[usable], _oriented(cores[usable], normals[usable])
    result = m3c2(first, second, cores, normals, radius=radius, half_length=_HALF_LENGTH_RADII * radius)
    areas = _areas(cubes[usable], counts[usable], normals, side)
    measured = np.isfinite(result.distances)
    distances = np.where(measured, result.distances, 0.0)
    tested = np.isfinite(result.lod)
    sigma = np.where(tested, result.sigma, np.median(result.sigma[tested]) if tested.any() else 0.0)
    correlation = _Correlation.of(cores, distances, sigma, measured & tested, seed)
    weights = areas * measured
    half = 1.96 * math.hypot(correlation.sigma_of(weights), datum_sigma * float(weights @ normals[:, 2]))
    fill, cut = (float((areas * np.maximum(sign * distances, 0)).sum()) for sign in (1, -1))
    area = float(areas[measured].sum())
    steep = np.abs(normals[:, 2]) < np.cos(np.radians(STEEP_DEG))
    net = EstimatedChange.within(fill - cut, half)
    level = 1.96 * np.hypot(sigma, correlation.sigma)
    return NormalVolume(
        result.shifted(-origin),
        areas,
        side,
        area,
        float(areas[~measured].sum()),
        CutFill(EstimatedChange(fill, np.nan, np.nan), EstimatedChange(cut, np.nan, np.nan), net),
        net.scaled(1 / area if area else np.nan),
        float(areas[steep].sum() / areas.sum()) if len(areas) else 0.0,
        float(areas[measured & (np.abs(distances) <= level)].sum() / area) if area else 1.0,
    )


def _oriented(cores: FloatArray, normals: FloatArray) -> FloatArray:
    """Turn normals (K, 3) so that neighbours agree, and each connected surface faces upwards on the whole.

    The agreement is passed on along the minimum spanning tree of the neighbours, over the flattest places first (Hoppe
    et al. 1992, section 3.3), so that a wall faces the side from which its foot and its top are seen.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import breadth_first_order, connected_components, minimum_spanning_tree

    count = min(_NEIGHBORS + 1, len(cores))
    if count < 2:
        return normals
    neighbors = Index(cores).query(cores, count).indices[:, 1:]
    rows = np.repeat(np.arange(len(cores)), count - 1)
    others = neighbors.ravel()
    # Edges of weight 0 would not exist.
    weights = 1.001 - np.abs((normals[rows] * normals[others]).sum(axis=1))
    graph = coo_array((weights, (rows, others)), shape=(len(cores), len(cores))).tocsr()
    tree = minimum_spanning_tree(graph.maximum(graph.T))
    tree = tree + tree.T
    result = normals.copy()
    _, labels = connected_components(tree, directed=False)
    order = np.argsort(labels, kind="stable")
    for members in np.split(order, np.flatnonzero(np.diff(labels[order])) + 1):
        start = members[np.abs(normals[members, 2]).argmax()]
        path, parents = breadth_first_order(tree, start, directed=False)
        for place in path[1:]:
            if result[place] @ result[parents[place]] < 0:
                result[place] = -result[place]
        if result[members, 2].sum() < 0:
            result[members] = -result[members]
    return result


def _areas(cubes: IntArray, counts: IntArray, normals: FloatArray, side: float) -> FloatArray:
    """Return the surface (K,) that each core point stands for.

    Along the axis that is closest to its normal, a surface passes through one cube of a column or through adjacent
    ones. These share the surface in the column by their numbers of points. Separate cubes, such as the floor and the
    roof of a cave, each have it whole.
    """
    axes = np.abs(normals).argmax(axis=1)
    result = np.empty(len(cubes))
    for axis in range(3):
        rows = np.flatnonzero(axes == axis)
        across = [other for other in range(3) if other != axis]
        order = rows[np.lexsort((cubes[rows, axis], cubes[rows, across[1]], cubes[rows, across[0]]))]
        if not len(order):
            continue
        steps = np.diff(cubes[order], axis=0)
        starts = np.concatenate([[True], (steps[:, across] != 0).any(axis=1) | (steps[:, axis] > 1)])
        runs = np.cumsum(starts) - 1
        result[order] = counts[order] / np.bincount(runs, counts[order])[runs]
    areas: FloatArray = side**2 * result / np.abs(normals).max(axis=1)
    return areas


@dataclass(frozen=True, eq=False)
class _Correlation:
    """The correlated error of distances at core points, from the products of pairs of stable ones by their lag."""

    cores: FloatArray
    white: FloatArray
    edges: FloatArray
    covariances: FloatArray
    sigma: float

    @classmethod
    def of(cls, cores: FloatArray, distances: FloatArray, sigma: FloatArray, usable: Mask, seed: int) -> _Correlation:
        """Estimate the covariance of errors by lag; it is zero from the first lag on at which it is not positive."""
        rng = np.random.default_rng(seed)
        rows = np.flatnonzero(usable)
        rows = rng.choice(rows, min(_SAMPLE, len(rows)), replace=False)
        values = distances[rows]
        edges, covariances = np.zeros(1), np.zeros(0)
        if len(rows) > 30:
            middle = np.median(values)
            spread = NORMAL_MAD * np.median(np.abs(values - middle))
            stable = np.abs(values - middle) <= 3 * max(spread, 1e-300)
            residuals, places = values[stable] - values[stable].mean(), cores[rows[stable]]
            lags = np.linalg.norm(places[:, None] - places, axis=2)
            upper = np.triu_indices(len(places), 1)
            extent = float(lags.max())
            edges = np.geomspace(extent / 200, extent / 2, _LAG_BINS)
            numbers = np.digitize(lags[upper], edges)
            products = np.outer(residuals, residuals)[upper]
            counts = np.bincount(numbers, minlength=_LAG_BINS + 1)[:_LAG_BINS]
            covariances = np.bincount(numbers, products, _LAG_BINS + 1)[:_LAG_BINS] / np.maximum(counts, 1)
            covariances[counts < 30] = np.nan
            filled = covariances[np.isfinite(covariances)]
            covariances = np.where(np.isfinite(covariances), covariances, filled[0] if len(filled) else 0.0)
            ends = np.flatnonzero(covariances <= 0)
            covariances[ends[0] if len(ends) else _LAG_BINS :] = 0.0
        total = float(covariances[0]) if len(covariances) else 0.0
        return cls(cores, sigma, edges, covariances, max(total, 0.0) ** 0.5)

    def sigma_of(self, weights: FloatArray) -> float:
        """Return the standard deviation of a weighted sum (K,) of distances."""
        white = float(((weights * self.white) ** 2).sum())
        if not len(self.covariances) or not weights.any():
            return math.sqrt(white)
        rows = np.flatnonzero(weights)
        chosen = rows[:: max(1, len(rows) // _SAMPLE)]
        lags = np.linalg.norm(self.cores[chosen][:, None] - self.cores[chosen], axis=2)
        values = np.append(self.covariances, 0.0)[np.digitize(lags, self.edges)]
        np.fill_diagonal(values, self.covariances[0])
        scale = weights[rows].sum() / weights[chosen].sum()
        correlated = scale**2 * float(weights[chosen] @ values @ weights[chosen])
        return math.sqrt(white + correlated)
