"""Find the pairs of points and tangent planes on which a deformation is measured.

Weights are found under the largest model and then frozen. A robust fit that starts from the rigid model would treat a
deformation of many standard deviations as outliers and miss it. Closest points are found twice, under that model and
without one: in a volume such as a forest, closest points seem to confirm any assumed deformation.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pcbench.deformation.blocks import Blocks, noise_sizes
from pcbench.deformation.displacement import Displacement
from pcbench.deformation.result import RESOLUTION_SHARE
from pcbench.deformation.sides import MIN_PAIRS, Side
from pcbench.deformation.sums import TileSums
from pcbench.geometry.arrays import FloatArray, IntArray
from pcbench.geometry.neighbors import Index, Matches
from pcbench.geometry.normals import Surface
from pcbench.geometry.order_statistics import percentiles_of_columns, robust_sigma
from pcbench.geometry.sampling import line_gaps, median_spacing
from pcbench.geometry.voxels import cells

_MAX_PAIRS = 20_000
_MAX_COARSE_PAIRS = 5_000  # in all but the last rounds
_ROUNDS = 7
_FIELD_REACH = 0.7  # maximum correspondence distance, in the 95th percentile of the field found so far
_MAX_WIDENINGS = 5  # searches for pairs under the field found so far
_MAX_GAP_SAMPLE = 1_000  # pairs at which the gap between scan lines is measured; at most twice as many are used
_MIN_FIELD_CHANGE = 1.0  # RMS change of the field, in spacings, below which no further search is needed
_MAX_FINAL_FITS, _FINAL_HALF_DAMPED_INFORMATION = 12, 1e-4  # usually far fewer fits
_CONVERGENCE_TOLERANCE = 0.01  # in standard deviations of the noise
_TUKEY_CONSTANT = 4.685  # standard deviations: 95 % efficiency for normal residuals
_MIN_INFLUENCE_SLOPE = 0.2  # minimum mean slope of the influence function: below it, nearly all pairs are outliers
CELLS_ALONG = 16  # initial number of cells along the scene's extent
_MIN_TILES = 60  # tiles aimed for
_MAX_CELLS = 480  # more cells cost time without adding information
_POSITION_NEIGHBORS = 8  # points averaged for a position
_ROUGHNESS_RATIO = 4.0  # times the lower quartile of the variation: such a pair has a quarter of the weight
_EXACT_VARIATION = 1e-6  # surface variation up to which a plane is exact: no scan is that smooth at its spacing
_MAX_VARIATION = 0.005  # surface variation at which a pair has at most a quarter of the weight: not a plane


@dataclass(frozen=True, eq=False)
class Pairs:
    """Frozen pairs, N of them.

    Outliers are limited by pseudo-values (Huber 1981, section 7.10): with these residuals and weights, least squares
    gives the robust fit, and its residuals have the variance of that fit. Weights that depend on residuals do not: they
    shrink the moments of the residuals but not the variance of the fit (by 1.46 for normal residuals).

    Attributes:
        places: (N, 3) positions.
        normals: (N, 3) unit normals of the planes.
        residuals: (N,) n . (p - q), outliers limited.
        weights: (N,) from 0 to 1.
        scales: (N,) relative scale of the noise, about 1.
        remainders: (N,) residuals from the largest model, outliers limited.
        raw_remainders: (N,) residuals from the largest model, as measured.
        quality: (N,) factor of the weights that does not depend on the residuals.
        areas: (N,) surface area that each pair represents, in any unit.
        inliers: share of the pairs within the support of Tukey's biweight.
        share: share of the surface, in blocks of a tenth of the scene, whose pairs have weight in the fit.
        rough: share of the pairs that are not on a smooth surface.
        spacing: median spacing of the points that define the planes.
        plane_spacing: root mean square of their spacing at the pairs, which is larger where the density varies.
        distance: median distance of the closest points.
        field: the largest model, of the candidate.
    """

    places: FloatArray
    normals: FloatArray
    residuals: FloatArray
    weights: FloatArray
    scales: FloatArray
    remainders: FloatArray
    raw_remainders: FloatArray
    quality: FloatArray
    areas: FloatArray
    inliers: float
    share: float
    rough: float
    spacing: float
    plane_spacing: float
    distance: float
    field: Displacement


@dataclass(frozen=True, eq=False)
class PairSearch:
    """Search for pairs of evenly spread points of the sparser cloud and tangent planes of the denser one.

    The maximum correspondence distance shrinks while the largest model is fitted; then Tukey's biweight sets the
    weights.

    Attributes:
        queries: the sparser cloud.
        surface: the denser cloud.
        sign: factor that turns query minus closest point into candidate minus reference.
        rows: (M,) rows of the query points.
        closest: points of the denser cloud closest to them.
    """

    queries: Side
    surface: Side
    sign: float
    rows: IntArray
    closest: Matches

    @classmethod
    def of(cls, reference: Side, candidate: Side) -> PairSearch | None:
        """Return the search for pairs of a reference and its aligned candidate; None if there are too few points."""
        swapped = len(candidate.surface) > len(reference.surface)
        queries, surface = (reference, candidate) if swapped else (candidate, reference)
        if len(surface.surface) < MIN_PAIRS or surface.surface.spacing == 0:
            return None  # or all points coincide
        rows = queries.spread_rows(3 * _MAX_PAIRS)
        if rows is None:
            return None
        closest = surface.surface.index.query(queries.surface.points[rows])
        return cls(queries, surface, -1.0 if swapped else 1.0, rows, closest)

    @property
    def candidate(self) -> Side:
        """The candidate, which may be queried or searched."""
        return self.queries if self.sign > 0 else self.surface

    @property
    def reference(self) -> Side:
        """The reference."""
        return self.surface if self.sign > 0 else self.queries

    def coincides(self, within: float) -> bool:
        """Return whether every candidate point lies within a distance of a reference point, however it is weighted."""
        if self.closest.distances.max() > within:
            return False
        return self.candidate.lies_on(self.reference, within)

    def find(self, follow: bool) -> Pairs | None:
        """Return the pairs; None if there are too few.

        Args:
            follow: whether closest points are searched after the model's displacement is removed, or at the points as
                they are.
        """
        fitted = self._fit(follow)
        return None if fitted is None else _freeze(*fitted, self.surface.surface)

    def displacement(self) -> Displacement | None:
        """Return the displacement of the candidate by the largest model; None if there are too few pairs."""
        fitted = self._fit(follow=True)
        return None if fitted is None else fitted[1]

    def _fit(self, follow: bool) -> tuple[_PlanePairs, Displacement] | None:
        """Fit the largest model to closest points; return the last pairs, and the model."""
        points, surface = self.queries.surface.points[self.rows], self.surface.surface
        lower, upper = percentiles_of_columns(points, [1, 99])
        field = Displacement.zero((lower + upper) / 2, 0.6 * float((upper - lower).max()))
        pairs, closest, displacements = None, self.closest, np.zeros_like(points)
        for _ in range(_MAX_WIDENINGS if follow else 1):
            near, max_distance = _near_queries(closest.distances, displacements, surface.spacing)
            matches = Matches(closest.distances[near], closest.indices[near])
            fitted = _graduated_fit(self, self.rows[near], matches, field, max_distance, follow=follow)
            if fitted is None:
                break
            pairs, field = fitted
            before, displacements = displacements, field(points)
            change = np.sqrt(np.square(displacements - before).sum(axis=1).mean())
            if change <= max(_MIN_FIELD_CHANGE * surface.spacing, pairs.noise):
                break
            closest = surface.index.query(points - self.sign * displacements, hint=closest.indices)
        return None if pairs is None else (pairs, field)


class _PlanePairs(NamedTuple):
    """Closest points within the maximum correspondence distance, N pairs, with their weights."""

    queries: FloatArray  # (N, 3) points of the sparser cloud
    closest: IntArray  # (N,) rows of the denser cloud
    distances: FloatArray  # (N,) point to point
    normals: FloatArray  # (N, 3) unit normals at the closest points
    residuals: FloatArray  # (N,) candidate minus reference, along the normals
    quality: FloatArray  # (N,) weights that do not depend on the residuals
    variation: FloatArray  # (N,) surface variation at the closest points
    width: FloatArray  # (N,) residual from the model at which Tukey's biweight is zero
    weights: FloatArray  # (N,)
    noise: float  # robust standard deviation of the residuals from the model


def _near_queries(distances: FloatArray, displacements: FloatArray, spacing: float) -> tuple[IntArray, float]:
    """Select the query points that may have a counterpart under a displacement, and the maximum distance for that.

    The nearest tenth lies on the surface even at small overlap, and deformations are a few times larger. Voxel
    downsampling favours outliers, which fill space, so distant points are removed before the final selection.

    Args:
        distances: (M,) distances of the displaced points to their closest points.
        displacements: (M, 3) displacements.
        spacing: spacing of the searched cloud.
    """
    lowest_tenth, lowest_quarter = (float(np.percentile(distances, q)) for q in (10, 25))
    reach = _FIELD_REACH * float(np.percentile(np.linalg.norm(displacements, axis=1), 95))
    max_distance = max(10 * lowest_tenth, 3 * lowest_quarter, 5 * spacing, reach)
    near = np.flatnonzero(distances <= max_distance)
    return near[:: max(1, -(-len(near) // _MAX_PAIRS))], max_distance


def _graduated_fit(
    search: PairSearch,
    rows: IntArray,
    matches: Matches,
    field: Displacement,
    max_distance: float,
    *,
    follow: bool,
) -> tuple[_PlanePairs, Displacement] | None:
    """Fit the largest model in rounds of closest points; return the pairs of the last round and the fitted model.

    Args:
        search: both clouds.
        rows: (N,) rows of the query points.
        matches: their closest points under `field`.
        field: the model found so far.
        max_distance: initial maximum correspondence distance.
        follow: whether closest points are searched after the model's displacement is removed.
    """
    coarse_step = max(1, len(rows) // _MAX_COARSE_PAIRS)
    surface, last_closest = search.surface.surface, matches.indices.copy()
    min_distance = 4 * surface.spacing
    for number in range(_ROUNDS):
        final = number >= _ROUNDS - 3
        some = slice(None, None, 1 if final else coarse_step)
        points = search.queries.surface.points[rows[some]]
        displacements = field(points)
        if follow and number > 0:
            closest = surface.index.query(points - search.sign * displacements, hint=last_closest[some])
            last_closest[some] = closest.indices
        else:
            closest = Matches(matches.distances[some], matches.indices[some])
        weighted = _weighted_planes(search, rows[some], closest, displacements, max_distance, final=final)
        if weighted is None or not weighted.weights.any():
            return None
        pairs = weighted
        frame = field.frame(pairs.queries, pairs.noise)
        field = field.fit(frame, pairs.normals, pairs.residuals, pairs.weights)
        narrower = 0.6 * max_distance if number < _ROUNDS - 4 else 0.0
        max_distance = max(narrower, min_distance, min(4 * pairs.noise, max_distance))
    return pairs, field


def _weighted_planes(
    search: PairSearch, rows: IntArray, matches: Matches, displacements: FloatArray, max_distance: float, *, final: bool
) -> _PlanePairs | None:
    """Weight the pairs of query points and tangent planes within a distance; None if there are too few.

    Args:
        search: both clouds.
        rows: (N,) rows of the query points.
        matches: their closest points.
        displacements: (N, 3) displacements by the current model.
        max_distance: maximum correspondence distance.
        final: whether the weights use the local noise; before, nearly all pairs within the distance count.
    """
    queries, surface = search.queries, search.surface
    near = np.flatnonzero(matches.distances <= max_distance)
    if len(near) < MIN_PAIRS:
        return None
    points, closest = queries.surface.points[rows[near]], matches.indices[near]
    normals = surface.surface.normals(closest)
    residuals = search.sign * np.einsum("ni,ni->n", points - surface.surface.points[closest], normals)
    remainders = residuals - np.einsum("ni,ni->n", displacements[near], normals)
    variation = surface.surface.variation(closest)
    quality = _smoothness(variation) * (queries.class_weights(rows[near]) * surface.class_weights(closest))
    if final:
        sizes = noise_sizes(points, remainders, quality, exact=RESOLUTION_SHARE * surface.surface.spacing)
    else:
        sizes = np.full(len(remainders), robust_sigma(remainders))
    width = np.maximum(_TUKEY_CONSTANT * sizes, 0.0 if final else 0.5 * max_distance) + 1e-300
    return _PlanePairs(
        points,
        closest,
        matches.distances[near],
        normals,
        residuals,
        quality,
        variation,
        width,
        weights=quality * np.square(1 - _squared_ratios(remainders, width)),
        noise=float(np.median(sizes)),
    )


def _squared_ratios(remainders: FloatArray, width: FloatArray) -> FloatArray:
    """Squared ratios (N,) of residuals to the width of Tukey's biweight, clamped to 1, where the weight is zero."""
    squared: FloatArray = np.square(np.clip(remainders / width, -1, 1))
    return squared


def _freeze(pairs: _PlanePairs, field: Displacement, surface: Surface) -> Pairs:
    """Turn the robust fit to the final pairs into pseudo-values for least squares."""
    places, spacings = _local_means(surface, pairs.closest)
    quality, blocks = pairs.quality, Blocks.of(pairs.queries)
    field, fitted, remainders = _fit_frozen_pairs(pairs, field, places)
    squared = _squared_ratios(remainders, pairs.width)
    slopes = (1 - squared) * (1 - 5 * squared)  # slope of Tukey's influence function remainder * (1 - squared)^2
    mean_slope = np.maximum(blocks.smooth(slopes, quality), _MIN_INFLUENCE_SLOPE)
    limited = remainders * np.square(1 - squared) / mean_slope  # Huber 1981, section 7.10
    power = _powers(pairs, blocks, np.square(limited))
    weights, areas = quality * mean_slope, _areas(pairs.queries)
    return Pairs(
        places,
        pairs.normals,
        residuals=fitted + limited,
        weights=weights,
        scales=np.sqrt(power / np.average(power, weights=quality)) if power.any() else np.ones(len(power)),
        remainders=limited,
        raw_remainders=remainders,
        quality=quality,
        areas=areas,
        inliers=float(np.average(squared < 1, weights=quality)),
        share=blocks.share_with_weight(quality * (squared < 1), areas),
        rough=float(np.mean(pairs.variation > _MAX_VARIATION)),
        spacing=surface.spacing,
        plane_spacing=math.sqrt(np.average(np.square(spacings), weights=weights)) if weights.any() else surface.spacing,
        distance=float(np.median(pairs.distances)),
        field=field,
    )


def _powers(pairs: _PlanePairs, blocks: Blocks, squares: FloatArray) -> FloatArray:
    """Return the local means (N,) of squared residuals (N,), apart for exact planes and for measured surface.

    Both lie side by side where walls of a model stand on scanned ground, and one mean is right for neither.
    """
    power, is_exact = np.empty(len(squares)), pairs.variation <= _EXACT_VARIATION
    for part in (is_exact, ~is_exact):
        if part.any():
            power[part] = blocks.smooth(squares, pairs.quality * part)[part]
    return power


def _local_means(surface: Surface, rows: IntArray) -> tuple[FloatArray, FloatArray]:
    """Return means (N, 3) of the nearest neighbours of rows (N,) of a surface, and its spacing (N,) there.

    The noise of a point is in its residual. Positions come from its neighbours, so that noise does not look like slope.
    Copies of the point have its noise, too.
    """
    index, sampling = surface.index, surface.sampling
    around = index.query(index.points[rows], min(sampling.neighbors(_POSITION_NEIGHBORS + 1), len(index)))
    points, distances = index.points[around.indices[:, 1:]], around.distances[:, 1:]
    if sampling.copies == 1:
        means: FloatArray = points.mean(axis=1)
        spacings = distances[:, 0]
    else:
        is_other = sampling.is_elsewhere(distances)
        means = np.einsum("nk,nki->ni", is_other, points) / np.count_nonzero(is_other, axis=1)[:, None]
        spacings = np.take_along_axis(distances, is_other.argmax(axis=1)[:, None], axis=1)[:, 0]
    if sampling.has_lines:  # planes bridge the gap to the next line, and a curved surface leaves them there
        gaps = line_gaps(index, index.points[rows[:: max(1, len(rows) // _MAX_GAP_SAMPLE)]])
        spacings = np.maximum(spacings, np.median(np.linalg.norm(gaps, axis=1)))
    return means, spacings


def _fit_frozen_pairs(
    pairs: _PlanePairs, field: Displacement, places: FloatArray
) -> tuple[Displacement, FloatArray, FloatArray]:
    """Fit by iteratively reweighted least squares; return the model, its part along the normals (N,), the residuals.

    Damping is minimal, because no further closest points are searched.
    """
    weights, frame = pairs.weights, field.frame(places, pairs.noise)
    remainders = np.full(len(pairs.residuals), np.inf)
    for _ in range(_MAX_FINAL_FITS):
        field = field.fit(frame, pairs.normals, pairs.residuals, weights, _FINAL_HALF_DAMPED_INFORMATION)
        fitted: FloatArray = np.einsum("ni,ni->n", field.from_monomials(frame.values), pairs.normals)
        before, remainders = remainders, pairs.residuals - fitted
        if np.abs(remainders - before).max() <= _CONVERGENCE_TOLERANCE * pairs.noise:
            break
        weights = pairs.quality * np.square(1 - _squared_ratios(remainders, pairs.width))
    return field, fitted, remainders


def tile_sums(pairs: Pairs) -> TileSums:
    """Sum pairs over cells as large as the scene allows: about 60 tiles of two cells' edge."""
    counted = pairs.places[pairs.weights > 0]
    lower, upper = percentiles_of_columns(counted, [1, 99])
    span = float((upper - lower).max())
    side = span / CELLS_ALONG
    for _ in range(12):
        tiles = len(cells(counted, 2 * side, lower).first)
        if tiles >= _MIN_TILES or len(counted) < 40 * tiles:
            break
        side *= 0.87
    while len(cells(counted, side, lower).first) > _MAX_CELLS:
        side *= 1.1
    kept = ((pairs.places >= lower - 0.1 * span) & (pairs.places <= upper + 0.1 * span)).all(axis=1)
    return TileSums.of(
        pairs.places[kept],
        pairs.normals[kept],
        pairs.residuals[kept],
        pairs.weights[kept],
        scales=pairs.scales[kept],
        remainders=pairs.remainders[kept],
        raw_remainders=pairs.raw_remainders[kept],
        quality=pairs.quality[kept],
        areas=pairs.areas[kept],
        lower=lower - 0.1 * span,
        center=(lower + upper) / 2,
        side=side,
        radius=0.6 * span,
    )


def _smoothness(variation: FloatArray) -> FloatArray:
    """Return weights (M,) of surface points: edges, foliage and points rougher than the smooth quarter count less.

    Exact planes do not set the limit: beside flat water or a synthetic floor, measured ground is as smooth as it gets.
    """
    measured = variation[variation > _EXACT_VARIATION]
    quarter = float(np.percentile(measured, 25)) if len(measured) else _EXACT_VARIATION
    limit = min(_MAX_VARIATION, _ROUGHNESS_RATIO * quarter)
    weights: FloatArray = 1 / np.square(1 + np.square(variation / limit))
    return weights


def _areas(points: FloatArray) -> FloatArray:
    """Return (N,) relative surface areas of points: voxels of two spacings contain about equal areas."""
    side = 2 * median_spacing(Index(points))
    if side == 0:
        return np.ones(len(points))
    voxels = cells(points, side)
    return 1 / voxels.counts[voxels.of_point]
