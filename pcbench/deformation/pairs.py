"""From two aligned clouds to the pairs that a deformation is measured on.

Weights are found under the largest model and only then frozen: a robust fit that grows from the rigid model takes a
bend of many standard deviations for outliers and never sees it. Closest points are found twice, under that model and
under none: where points fill a volume, whatever is assumed finds closest points that bear it out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pcbench.deformation.blocks import noise_sizes, smoothed
from pcbench.deformation.displacement import Displacement
from pcbench.deformation.sums import TileSums
from pcbench.geometry.arrays import FloatArray, IntArray
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.neighbors import Index, median_spacing
from pcbench.geometry.normals import Surface
from pcbench.geometry.voxels import cells, voxel_downsample_to

_MAX_PAIRS = 20_000
_MAX_COARSE_PAIRS = 5_000  # of all but the last rounds
_ROUNDS = 7
MIN_PAIRS = 300
_LAST_FITS, _HALF_FOLLOWED_LAST = 12, 1e-4  # far fewer fits but where a part that moved is let go
_SETTLED = 0.01  # of the noise
_TUKEY = 4.685  # standard deviations: 95 % efficient for normal residuals
_MIN_SLOPE = 0.2  # of the mean influence of a residual: below it, nearly all are outliers
CELLS_ALONG = 16  # of the scene's extent, at first
_MIN_TILES = 60  # wanted of the middle size
_MAX_CELLS = 480  # more only cost time
_NEIGHBORS = 8  # that a place is the mean of
_ROUGH = 4.0  # times the lower quartile of the surface variation: a pair that is so rough counts a quarter
_MAX_ROUGH = 0.005  # surface variation; whatever the scene, a pair that is so rough counts a quarter: it is no plane
_CLASS_WEIGHTS = {3: 0.1, 4: 0.1, 5: 0.1, 7: 0.0, 9: 0.1, 18: 0.0}  # ASPRS: vegetation, noise, water


@dataclass(frozen=True, eq=False)
class Side:
    """One cloud of the pair, in the reference's coordinates minus the local origin.

    Attributes:
        surface: its points and normals.
        inside: (N,) which points may be asked for; all are searched.
        cloud: as it was read: classes, coordinate system, unit.
    """

    surface: Surface
    inside: NDArray[np.bool_]
    cloud: Cloud

    @property
    def is_metric(self) -> bool:
        return self.cloud.unit is not None or self.cloud.crs is not None

    def class_weights(self, rows: IntArray) -> FloatArray:
        """(M,) of points by their LAS class; one where there is none."""
        classes = self.cloud.attributes.get("classification")
        if classes is None:
            return np.ones(len(rows))
        table = np.ones(256)
        table[list(_CLASS_WEIGHTS)] = list(_CLASS_WEIGHTS.values())
        weights: FloatArray = table[np.clip(classes[rows].astype(np.int64), 0, 255)]
        return weights


@dataclass(frozen=True, eq=False)
class Pairs:
    """Frozen pairs, N of them.

    Outliers are limited by pseudo-values (Huber 1981, section 7.10): with these residuals and weights, least squares
    gives the robust fit, and its residuals scatter as that fit does. Weights that depend on residuals do not: they
    shrink the residuals' moments but not the fit's variance (by 1.46 for normal residuals).

    Attributes:
        places: (N, 3).
        normals: (N, 3) unit normals of the planes.
        residuals: (N,) n . (p - q), outliers limited.
        weights: (N,) from 0 to 1.
        scales: (N,) sizes of the noise, about 1.
        left: (N,) residuals of the largest model, outliers limited.
        apart: (N,) the same as measured.
        quality: (N,) the part of the weights that does not depend on the residuals.
        areas: (N,) of surface that a pair stands for, in any unit.
        inliers: share of the pairs that lie within the robust fit's reach.
        rough: share of the pairs in places that are no smooth surface.
        spacing: of the points that the planes come from.
        distance: median distance of the closest points.
    """

    places: FloatArray
    normals: FloatArray
    residuals: FloatArray
    weights: FloatArray
    scales: FloatArray
    left: FloatArray
    apart: FloatArray
    quality: FloatArray
    areas: FloatArray
    inliers: float
    rough: float
    spacing: float
    distance: float


def find_pairs(reference: Side, candidate: Side, follow: bool = True) -> Pairs | None:
    """Pairs of evenly spread points of the sparser cloud with tangent planes at their closest points of the denser one.

    The maximum correspondence distance shrinks while the largest model is fitted, then Tukey's biweight decides.
    Closest points are those of the points that the model brings back (`follow`), or of the points as they are. None
    where there are too few pairs.
    """
    swapped = len(candidate.surface) > len(reference.surface)
    asking, surface = (reference, candidate) if swapped else (candidate, reference)
    rows = np.flatnonzero(asking.inside)
    if len(rows) < MIN_PAIRS or len(surface.surface) < MIN_PAIRS:
        return None
    if extent(asking.surface.points[rows]) == 0 or surface.surface.spacing == 0:
        return None  # one place, however often
    points = asking.surface.points[rows]
    rows = rows[voxel_downsample_to(points, 3 * _MAX_PAIRS, start=1e-3 * extent(points))]
    sign = -1.0 if swapped else 1.0  # a point that asks less the surface's, times it: candidate less reference
    index = surface.surface.index
    spacing = surface.surface.spacing
    # The nearest tenth lies on the surface however little the clouds overlap, and bends are a few times as far. Voxel
    # downsampling leaves strays, which fill space, more than their share: what is far off is dropped before it is
    # counted.
    first = index.query(asking.surface.points[rows]).distances
    max_distance = max(10 * float(np.percentile(first, 10)), 3 * float(np.percentile(first, 25)), 5 * spacing)
    rows = rows[first <= max_distance]
    rows = rows[:: -(-len(rows) // _MAX_PAIRS)]
    points = asking.surface.points[rows]
    step = max(1, len(rows) // _MAX_COARSE_PAIRS)
    lower, upper = np.percentile(points, [1, 99], axis=0)
    field = Displacement.nothing((lower + upper) / 2, 0.6 * float((upper - lower).max()))
    last = 4 * spacing
    for number in range(_ROUNDS):
        final = number >= _ROUNDS - 3
        asked = points if final else points[::step]
        bend = field(asked)
        distances, closest = index.query(asked - sign * bend if follow else asked)
        near = np.flatnonzero(distances <= max_distance)
        if len(near) < MIN_PAIRS:
            return None
        normals = surface.surface.normals(closest[near])
        residuals = sign * np.einsum("ni,ni->n", asked[near] - index.points[closest[near]], normals)
        left = residuals - np.einsum("ni,ni->n", bend[near], normals)
        # Graduated: at first nearly everything within that distance counts.
        noise = 1.4826 * float(np.median(np.abs(left)))
        variation = surface.surface.variation(closest[near])
        classes = asking.class_weights((rows if final else rows[::step])[near]) * surface.class_weights(closest[near])
        quality = _smoothness(variation) * classes
        sizes = noise_sizes(asked[near], left, quality) if final else np.full(len(left), noise)
        width = np.maximum(_TUKEY * sizes, 0.0 if final else 0.5 * max_distance) + 1e-300
        weights = quality * np.square(1 - np.square(np.clip(left / width, -1, 1)))
        if not weights.any():
            return None
        field = field.fitted(asked[near], normals, residuals, weights, noise)
        narrower = 0.6 * max_distance if number < _ROUNDS - 4 else 0.0
        max_distance = max(narrower, last, min(4 * noise, max_distance))
    closest, asked = closest[near], asked[near]
    # A point's own noise is in its residual: places come from its neighbours, so that noise does not look like slope.
    around = index.query(index.points[closest], min(_NEIGHBORS + 1, len(index))).indices[:, 1:]
    places = index.points[around].mean(axis=1)
    left = np.full(len(residuals), np.inf)
    for _ in range(_LAST_FITS):  # with all that these pairs show, now that none are looked for any more
        field = field.fitted(places, normals, residuals, weights, noise, _HALF_FOLLOWED_LAST)
        fitted = np.einsum("ni,ni->n", field(places), normals)
        before, left = left, residuals - fitted
        squared = np.square(np.clip(left / width, -1, 1))
        weights = quality * np.square(1 - squared)
        if np.abs(left - before).max() <= _SETTLED * noise:
            break
    slopes = (1 - squared) * (1 - 5 * squared)  # of Tukey's influence function left * (1 - squared)^2
    mean_slope = np.maximum(smoothed(asked, slopes, quality), _MIN_SLOPE)
    limited = left * np.square(1 - squared) / mean_slope
    power = smoothed(asked, np.square(limited), quality)
    inliers = float(np.average(squared < 1, weights=quality))
    return Pairs(
        places,
        normals,
        residuals=fitted + limited,
        weights=quality * mean_slope,
        scales=np.sqrt(power / np.average(power, weights=quality)) if power.any() else np.ones(len(power)),
        left=limited,
        apart=left,
        quality=quality,
        areas=_areas(asked),
        inliers=inliers,
        rough=float(np.mean(variation > _MAX_ROUGH)),
        spacing=spacing,
        distance=float(np.median(distances[near])),
    )


def tile_sums(pairs: Pairs) -> TileSums:
    """Sums over cells that are as large as the scene allows: about 60 tiles of two cells' edge."""
    counted = pairs.places[pairs.weights > 0]
    lower, upper = np.percentile(counted, [1, 99], axis=0)
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
        left=pairs.left[kept],
        apart=pairs.apart[kept],
        quality=pairs.quality[kept],
        areas=pairs.areas[kept],
        lower=lower - 0.1 * span,
        center=(lower + upper) / 2,
        side=side,
        radius=0.6 * span,
    )


def _smoothness(variation: FloatArray) -> FloatArray:
    """Weights (M,) of points of a surface: edges and foliage are no planes, and what is rougher than the smooth quarter
    of the scene counts less.
    """
    limit = min(_MAX_ROUGH, _ROUGH * max(float(np.percentile(variation, 25)), 1e-6))
    weights: FloatArray = 1 / np.square(1 + np.square(variation / limit))
    return weights


def _areas(points: FloatArray) -> FloatArray:
    """(N,) of surface that each point stands for, relative: voxels of two spacings hold about as much of it each."""
    side = 2 * median_spacing(Index(points))
    if side == 0:
        return np.ones(len(points))
    voxels = cells(points, side)
    return 1 / voxels.counts[voxels.of_point]


def extent(points: FloatArray) -> float:
    """Longest side of the box that holds the inner 98 % along each axis."""
    lower, upper = np.percentile(points, [1, 99], axis=0)
    return float((upper - lower).max())
