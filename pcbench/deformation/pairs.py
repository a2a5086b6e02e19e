"""From two aligned clouds to the pairs that a deformation is measured on, and to the answer.

Pairs and weights are found under the largest model and only then frozen: a robust fit that grows from the rigid model
takes a bend of many standard deviations for outliers and never sees it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pcbench.deformation.answer import judge
from pcbench.deformation.displacement import Displacement, share_of
from pcbench.deformation.result import Deformation
from pcbench.deformation.sums import TileSums
from pcbench.errors import Notice
from pcbench.geometry.arrays import FloatArray, IntArray
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.crs import euclidean_offsets
from pcbench.geometry.normals import Surface
from pcbench.geometry.voxels import cells, voxel_downsample_to
from pcbench.registration import Registration

_MAX_PAIRS = 20_000
_MAX_COARSE_PAIRS = 5_000  # of all but the last rounds
_ROUNDS = 7
_MIN_PAIRS = 300
_MAX_CHANGED_SHARE = 0.1  # of the cells: so few are left out, and the rest is judged again
_RESOLUTION = 5e-3  # spacings of the points that planes go through
CELLS_ALONG = 16  # of the scene's extent, at first
_MIN_TILES = 60  # wanted of the middle size
_MAX_CELLS = 480  # more only cost time
_NEIGHBORS = 8  # that a place is the mean of
_ROUGH = 4.0  # times the lower quartile of the surface variation: a pair that is so rough counts a quarter
_MIN_MAP_COORDINATE = 1e5  # beyond it, coordinates are a map's
_EARTH_RADIUS = 6.37e6  # metres
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
    """Frozen pairs: where (N, 3), along which normals (N, 3), residuals n . (p - q) (N,) and weights (N,), and what
    the largest model leaves of the residuals (N,).
    """

    places: FloatArray
    normals: FloatArray
    residuals: FloatArray
    weights: FloatArray
    left: FloatArray
    quality: FloatArray  # (N,) the part of the weights that does not depend on the residuals
    spacing: float  # of the points that the planes come from


def residual_deformation(
    reference: Side, candidate: Side, registration: Registration, origin: FloatArray, *, seed: int = 0
) -> Deformation:
    """What is left between two registered clouds that a rigid, a similarity or an affine motion does not explain.

    Args:
        reference, candidate: in the reference's coordinates minus `origin`.
        registration: that brought the candidate there; a scale that it solved for is no deformation.
        origin: (3,).
        seed: of the bootstrap.
    """
    pairs = find_pairs(reference, candidate)
    if pairs is None or np.count_nonzero(pairs.weights) < _MIN_PAIRS or _extent(pairs.places[pairs.weights > 0]) == 0:
        count = 0 if pairs is None else int(np.count_nonzero(pairs.weights))
        text = f"{count} pairs of points: too few to tell a bend from noise"
        return Deformation.unanswered(Notice("few-pairs", text))
    pairs, notes = _without_map_projection(pairs, reference, candidate, registration, origin)
    metric = reference.is_metric and candidate.is_metric and not registration.solved_scale
    return judge_pairs(pairs, metric=metric, seed=seed).shifted(origin).with_warnings(notes)


def judge_pairs(pairs: Pairs, *, metric: bool = True, seed: int = 0) -> Deformation:
    """The verdict on pairs, see `judge`; what changed locally is left out: a house that moved does not bend a scene."""
    sums = tile_sums(pairs)
    resolution = _RESOLUTION * pairs.spacing
    found = judge(sums, metric=metric, resolution=resolution, seed=seed)
    if not 0 < found.changed_share <= _MAX_CHANGED_SHARE:
        return found
    kept = sums.without(found.changed)
    return judge(kept, metric=metric, resolution=resolution, seed=seed).with_changes(found)


def find_pairs(reference: Side, candidate: Side) -> Pairs | None:
    """Pairs of evenly spread points of the sparser cloud with tangent planes at their closest points of the denser one.

    The maximum correspondence distance shrinks while the largest model follows, then Tukey's biweight decides, all
    under that model. None where there are too few pairs.
    """
    swapped = len(candidate.surface) > len(reference.surface)
    asking, surface = (reference, candidate) if swapped else (candidate, reference)
    rows = np.flatnonzero(asking.inside)
    if len(rows) < _MIN_PAIRS or len(surface.surface) < _MIN_PAIRS:
        return None
    if _extent(asking.surface.points[rows]) == 0 or surface.surface.spacing == 0:
        return None  # one place, however often
    points = asking.surface.points[rows]
    rows = rows[voxel_downsample_to(points, 3 * _MAX_PAIRS, start=1e-3 * _extent(points))]
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
        distances, closest = index.query(asked - sign * bend)
        near = np.flatnonzero(distances <= max_distance)
        if len(near) < _MIN_PAIRS:
            return None
        normals = surface.surface.normals(closest[near])
        residuals = sign * np.einsum("ni,ni->n", asked[near] - index.points[closest[near]], normals)
        left = residuals - np.einsum("ni,ni->n", bend[near], normals)
        # Graduated: at first nearly everything within that distance counts.
        noise = 1.4826 * float(np.median(np.abs(left)))
        width = max(4.685 * noise, 0.0 if final else 0.5 * max_distance, 1e-300)
        weights = np.square(1 - np.square(np.clip(left / width, -1, 1)))
        asked_rows = rows[near] if final else rows[::step][near]
        quality = (
            _smoothness(surface.surface, closest[near])
            * asking.class_weights(asked_rows)
            * surface.class_weights(closest[near])
        )
        weights *= quality
        if not weights.any():
            return None
        field = field.fitted(asked[near], normals, residuals, weights, noise)
        narrower = 0.6 * max_distance if number < _ROUNDS - 4 else 0.0
        max_distance = max(narrower, last, min(4 * noise, max_distance))
    closest, asked = closest[near], asked[near]
    # A point's own noise is in its residual: places come from its neighbours, so that noise does not look like slope.
    around = index.query(index.points[closest], min(_NEIGHBORS + 1, len(index))).indices[:, 1:]
    places = index.points[around].mean(axis=1)
    left = residuals - np.einsum("ni,ni->n", field(asked), normals)
    return Pairs(places, normals, residuals, weights, left, quality, spacing)


def tile_sums(pairs: Pairs) -> TileSums:
    """Sums over cells that are as large as the scene allows: about 60 tiles of two cells' edge."""
    counted = pairs.places[pairs.weights > 0]
    lower, upper = np.percentile(counted, [1, 99], axis=0)
    extent = float((upper - lower).max())
    side = extent / CELLS_ALONG
    for _ in range(12):
        tiles = len(cells(counted, 2 * side, lower).first)
        if tiles >= _MIN_TILES or len(counted) < 40 * tiles:
            break
        side *= 0.87
    while len(cells(counted, side, lower).first) > _MAX_CELLS:
        side *= 1.1
    kept = ((pairs.places >= lower - 0.1 * extent) & (pairs.places <= upper + 0.1 * extent)).all(axis=1)
    return TileSums.of(
        pairs.places[kept],
        pairs.normals[kept],
        pairs.residuals[kept],
        pairs.weights[kept],
        left=pairs.left[kept],
        quality=pairs.quality[kept],
        lower=lower - 0.1 * extent,
        center=(lower + upper) / 2,
        side=side,
        radius=0.6 * extent,
    )


def _without_map_projection(
    pairs: Pairs, reference: Side, candidate: Side, registration: Registration, origin: FloatArray
) -> tuple[Pairs, list[Notice]]:
    """The pairs in a Euclidean frame where one cloud alone is on a map grid and the residuals agree with that.

    A map's heights follow the Earth and its scale varies: against a Euclidean cloud it is bent (2 cm at 500 m).
    """
    ours, theirs = reference.cloud.crs, candidate.cloud.crs
    noise = 1.4826 * float(np.median(np.abs(pairs.left)))
    if ours is None and theirs is None and float(np.abs(origin).max()) > _MIN_MAP_COORDINATE:
        sagitta = _extent(pairs.places) ** 2 / (8 * _EARTH_RADIUS)
        if sagitta > 0.2 * noise:
            text = (
                "coordinates look like a map's, but no file says which: against a Euclidean cloud the Earth's"
                f" curvature alone bends it by {sagitta:.2g} (if the unit is the metre)"
            )
            return pairs, [Notice("map-not-named", text)]
    name = ours if theirs is None else theirs
    if name is None or (ours is not None and theirs is not None):
        return pairs, []
    T = registration.T_reference_candidate
    places = pairs.places + origin
    offsets = euclidean_offsets(name, places if theirs is None else T.inverse().apply(places))
    if offsets is None:
        return pairs, []
    # What is at q on the map is at q + offset in space: there a Euclidean candidate lies, and seems displaced by it.
    bend = np.einsum("ni,ni->n", offsets if theirs is None else -offsets @ T.linear.T, pairs.normals)
    gauge = "similarity" if registration.solved_scale else "rigid"
    share, size = share_of(pairs.places, pairs.normals, pairs.residuals, pairs.weights, bend, gauge)
    if share < 0.5 or size < 0.1 * noise:
        return pairs, []
    text = f"one cloud is on a map grid: its bend of {size:.2g} RMS against Euclidean space was taken off first"
    return replace(pairs, residuals=pairs.residuals - bend), [Notice("map-bend-taken-off", text)]


def _smoothness(surface: Surface, rows: IntArray) -> FloatArray:
    """Weights (M,) of points of a surface: edges and foliage are no planes, and what is rougher than the smooth quarter
    of the scene counts less.
    """
    variation = surface.variation(rows)
    limit = _ROUGH * max(float(np.percentile(variation, 25)), 1e-6)
    weights: FloatArray = 1 / np.square(1 + np.square(variation / limit))
    return weights


def _extent(points: FloatArray) -> float:
    """Longest side of the box that holds the inner 98 % along each axis."""
    lower, upper = np.percentile(points, [1, 99], axis=0)
    return float((upper - lower).max())
