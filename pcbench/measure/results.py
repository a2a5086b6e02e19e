"""Result types of a comparison.

There are two directions: `accuracy` is candidate → reference (c→r: how far the reconstruction is from the true surface)
and `completeness` is reference → candidate (r→c: how far the true surface is from the reconstruction). Lengths are in
the reference's unit, mean squares in its square. A value that does not exist is None: D2 without normals, or the
sampling floor of a single point.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

from pcbench.changes import Changes
from pcbench.deformation import Deformation
from pcbench.errors import Notice, one_line
from pcbench.geometry.arrays import FloatArray
from pcbench.measure.budget import D2Budget
from pcbench.measure.checkpoints.accuracy import CandidateAccuracy, CloudAccuracy
from pcbench.measure.deviation import DeviationMap, Spread
from pcbench.measure.intervals import Interval
from pcbench.measure.offset import SignedOffset
from pcbench.measure.own_metrics import FAILED_METRIC, OwnResult
from pcbench.measure.presets import Preset
from pcbench.registration import Registration

# The directions as keys of comparison.json and as arrows in tables.
CANDIDATE_TO_REFERENCE, REFERENCE_TO_CANDIDATE = "candidate_to_reference", "reference_to_candidate"
ARROWS = {CANDIDATE_TO_REFERENCE: "c→r", REFERENCE_TO_CANDIDATE: "r→c"}


class Estimate(NamedTuple):
    """A value of one direction or of both together, with its floor and interval.

    Attributes:
        value: measured value.
        floor: sampling floor: the value for independent, error-free points of the same surface. A value near it shows
            no error.
        interval: 95 % confidence interval of the expected value, over new draws of the noise and points on this scene.
        area_weighted: mean over occupied voxels of each voxel's mean, so that dense areas do not dominate.
    """

    value: float | None = None
    floor: float | None = None
    interval: Interval | None = None
    area_weighted: float | None = None

    def root(self) -> Estimate:
        """Return the square root of a mean square and of all that belongs to it: an estimate of a length."""
        interval = None if self.interval is None else Interval(*(math.sqrt(max(end, 0.0)) for end in self.interval))
        return Estimate(_root(self.value), _root(self.floor), interval, _root(self.area_weighted))


_UNKNOWN = Estimate()


@dataclass(frozen=True)
class DirectedMetric:
    """A mean in both directions, and for D1 and D2 the larger of the two, which is symmetric."""

    accuracy: Estimate = _UNKNOWN
    completeness: Estimate = _UNKNOWN
    symmetric_max: Estimate | None = None

    def __getitem__(self, direction: str) -> Estimate:
        """Return the estimate of a direction, `CANDIDATE_TO_REFERENCE` or `REFERENCE_TO_CANDIDATE`."""
        return {CANDIDATE_TO_REFERENCE: self.accuracy, REFERENCE_TO_CANDIDATE: self.completeness}[direction]

    def root(self) -> DirectedMetric:
        """Return the square roots of all values, with their floors and intervals: a mean square as a length."""
        larger = None if self.symmetric_max is None else self.symmetric_max.root()
        return DirectedMetric(self.accuracy.root(), self.completeness.root(), larger)


class Extremes(NamedTuple):
    """Largest distances of one direction, and the position (3,) of the maximum in the reference's coordinates."""

    largest: float
    p95: float
    p99: float
    worst_point: FloatArray


@dataclass(frozen=True, eq=False)
class Hausdorff:
    """Hausdorff distances, unsquared: the largest distance of each direction and the larger of both."""

    accuracy: Extremes
    completeness: Extremes

    def __getitem__(self, direction: str) -> Extremes:
        """Return the extremes of a direction, `CANDIDATE_TO_REFERENCE` or `REFERENCE_TO_CANDIDATE`."""
        return {CANDIDATE_TO_REFERENCE: self.accuracy, REFERENCE_TO_CANDIDATE: self.completeness}[direction]

    @property
    def symmetric_max(self) -> float:
        """Larger of the two one-way Hausdorff distances, in the reference's unit."""
        return max(self.accuracy.largest, self.completeness.largest)


@dataclass(frozen=True)
class Chamfer:
    """Chamfer distances; the variants differ by orders of magnitude, so each is named.

    Attributes:
        sum_unsquared: mean distance c→r + mean distance r→c, a length.
        sum_squared: mean squared distance c→r + mean squared distance r→c, a squared length.
    """

    sum_unsquared: Estimate
    sum_squared: Estimate


@dataclass(frozen=True)
class ThresholdScores:
    """Shares in [0, 1] of the points within `threshold`: precision c→r, recall r→c, and their harmonic mean."""

    threshold: float
    precision: Estimate
    recall: Estimate
    fscore: Estimate


@dataclass(frozen=True)
class DirectedSpread:
    """Distributions of the distances in both directions."""

    accuracy: Spread
    completeness: Spread

    def __getitem__(self, direction: str) -> Spread:
        """Return the distribution of a direction, `CANDIDATE_TO_REFERENCE` or `REFERENCE_TO_CANDIDATE`."""
        return {CANDIDATE_TO_REFERENCE: self.accuracy, REFERENCE_TO_CANDIDATE: self.completeness}[direction]


@dataclass(frozen=True)
class DirectedBudget:
    """The budgets of D2 in both directions.

    Attributes:
        accuracy: budget c→r.
        completeness: budget r→c.
        keeps_pose: whether the candidate's pose is the given one. The part `motion` is then how far the candidate
            moved; otherwise it is what its registration left.
    """

    accuracy: D2Budget
    completeness: D2Budget
    keeps_pose: bool

    def __getitem__(self, direction: str) -> D2Budget:
        """Return the budget of a direction, `CANDIDATE_TO_REFERENCE` or `REFERENCE_TO_CANDIDATE`."""
        return {CANDIDATE_TO_REFERENCE: self.accuracy, REFERENCE_TO_CANDIDATE: self.completeness}[direction]


class SampledMean(NamedTuple):
    """A mean square that was estimated from a random sample.

    Attributes:
        points: number of points in the sample.
        half_width: half of the width of the 95 % confidence interval of the mean square of all points, in squared
            units.
    """

    points: int
    half_width: float


@dataclass(frozen=True, eq=False)
class Metrics:
    """All metrics of one candidate.

    Attributes:
        directed: the means of `pcbench.measure.directions.MEAN_METRICS` by name. The most common ones are also
            properties: `d1_mse`, `d2_mse` and `mean_distance`, and the roots `d1_rms` and `d2_rms`.
        hausdorff: largest distances.
        chamfer: sums over both directions.
        fscores: F-scores, one per threshold.
        percentiles_accuracy: percentiles of the distances c→r to the nearest point, as {"p50": ...}.
        percentiles_completeness: percentiles of the distances r→c to the nearest point.
        presets: definitions of other tools and papers by name, see `pcbench.measure.presets`.
        spreads: median, standard deviation, NMAD and more of `distance` (to the nearest point) and, if there are
            normals, of `plane_distance` (signed, to the reference's tangent planes).
        d2_samples: sample of each direction in which D2 was estimated, see `Settings.tolerance`. All distances to
            tangent planes are estimated from it.
        own: user-defined metrics by name, see `Settings.metrics`.
    """

    directed: Mapping[str, DirectedMetric]
    hausdorff: Hausdorff
    chamfer: Chamfer
    fscores: tuple[ThresholdScores, ...]
    percentiles_accuracy: Mapping[str, float]
    percentiles_completeness: Mapping[str, float]
    presets: Mapping[str, Preset] = field(default_factory=dict)
    spreads: Mapping[str, DirectedSpread] = field(default_factory=dict)
    d2_samples: Mapping[str, SampledMean] = field(default_factory=dict)
    own: Mapping[str, OwnResult] = field(default_factory=dict)

    @property
    def d1_mse(self) -> DirectedMetric:
        """Mean squared distance to the nearest point, in both directions."""
        return self.directed["d1_mse"]

    @property
    def d2_mse(self) -> DirectedMetric:
        """Mean squared distance to the reference's tangent planes, in both directions."""
        return self.directed["d2_mse"]

    @property
    def mean_distance(self) -> DirectedMetric:
        """Mean distance to the nearest point, in both directions."""
        return self.directed["mean_distance"]

    @property
    def d1_rms(self) -> DirectedMetric:
        """Root of `d1_mse`, a length."""
        return self.d1_mse.root()

    @property
    def d2_rms(self) -> DirectedMetric:
        """Root of `d2_mse`, a length."""
        return self.d2_mse.root()


@dataclass(frozen=True)
class ReferenceSummary:
    """The reference that the candidates were compared with.

    Attributes:
        points: number of points.
        points_in_region: number of points inside the region.
        spacing_median: median spacing of all points, see `pcbench.geometry.sampling.median_spacing`.
        extent: diagonal of the box that contains the inner 98 % of all points along each axis.
        crs: coordinate system, if known.
        unit: unit of the coordinates, if known.
        steps: steps in which x, y and z are rounded, see `pcbench.geometry.quantisation`; 0 if none is visible.
        normals: "given" with the points, "estimated", or None if there are too few points for normals.
        faces: number of faces if the reference is a mesh; None for a cloud.
        block_side: side of the correlation cells of the intervals.
        voxel_side: side of the voxels of area weighting.
        warnings: warnings about the reference that concern all candidates.
        check_points: its accuracy by check points; None if there are none.
    """

    points: int
    points_in_region: int
    spacing_median: float
    extent: float
    crs: str | None
    unit: str | None
    steps: tuple[float, ...]
    normals: str | None
    faces: int | None
    block_side: float
    voxel_side: float
    warnings: tuple[Notice, ...] = ()
    check_points: CloudAccuracy | None = None


@dataclass(frozen=True, eq=False, repr=False)
class Candidate:
    """All results of one candidate: registration, metrics, budget, deviation maps, changes and deformation.

    Attributes:
        name: name of the candidate.
        points: number of points.
        points_in_region: number of aligned points inside the region.
        registration: its registration to the reference.
        metrics: all metrics.
        deviation: the candidate's measured points with their distances to the reference.
        completeness: the reference's measured points with their `distance` to the nearest point of the candidate; its
            `rows` are the reference's.
        deformation: the deformation that remains after registration.
        timings_s: seconds per step.
        peak_rss_bytes: peak memory of the process so far.
        warnings: warnings about the clouds; registration and deformation have their own.
        steps: steps in which its own x, y and z are rounded, in its own unit; 0 if none is visible.
        censored: share of the points of each direction without a closest point within the maximum distance, by
            `CANDIDATE_TO_REFERENCE` and `REFERENCE_TO_CANDIDATE`; empty if there is no maximum. Their distances
            count as the maximum, so that means, mean squares and extremes are lower bounds. Their distances to planes
            are unknown, and so are D2, and the standard deviation and the NMAD of distances.
        offset: signed offset from the reference's surface; None without normals.
        faces: number of faces if the candidate is a mesh, whose points are samples; None for a cloud.
        budget: what D2 consists of; None if there are no normals, or if D2 is estimated from a sample or unknown.
        changes: the changes, in tiles with the labels of sampled points; None if they were not searched for.
        check_points: its accuracy by check points, as given and as aligned; None if there are none.
    """

    name: str
    points: int
    points_in_region: int
    registration: Registration
    metrics: Metrics
    deviation: DeviationMap
    completeness: DeviationMap
    deformation: Deformation
    timings_s: Mapping[str, float]
    peak_rss_bytes: int
    steps: tuple[float, ...]
    warnings: tuple[Notice, ...] = ()
    censored: Mapping[str, float] = field(default_factory=dict)
    offset: SignedOffset | None = None
    faces: int | None = None
    budget: DirectedBudget | None = None
    changes: Changes | None = None
    check_points: CandidateAccuracy | None = None

    @property
    def is_noise(self) -> bool:
        """Return whether no part changed and noise explains the distances to the surface, as far as both are known."""
        changed = self.changes is not None and bool(self.changes.found)
        return not changed and (self.budget is None or self.budget.accuracy.is_noise)

    @property
    def failures(self) -> tuple[str, ...]:
        """The warnings of user-defined metrics that failed."""
        return tuple(str(notice) for notice in self.warnings if notice.code == FAILED_METRIC)

    @property
    def summary(self) -> str:
        """Its name, its distances and the verdict on its deformation, in one line."""
        off, distance = self.metrics.d2_rms.accuracy.value, self.metrics.mean_distance
        surface = "" if off is None else f"{off:.4g} RMS off the surface, "
        means = f"mean distance {distance.accuracy.value:.4g} c→r, {distance.completeness.value:.4g} r→c"
        return f"<Candidate {self.name}: {surface}{means}, deformation {self.deformation.verdict}>"

    def __repr__(self) -> str:
        """Return the summary, and a line for each metric that failed."""
        return "\n  ".join([self.summary, *(f"warning: {one_line(text)}" for text in self.failures)])


class LeftOut(NamedTuple):
    """A damaged file that was left out of a tiled comparison, the number of its points if known, and the reason."""

    path: str
    points: int | None
    reason: str


@dataclass(frozen=True)
class Tiling:
    """How a comparison of clouds on disk was computed.

    Attributes:
        tile_points: largest number of points of a tile, except where more points coincide.
        tiles: number of tiles of the reference and of each candidate together.
        sampled_points: number of points of the reference that registration is based on; None: all points.
        max_distance: length beyond which no closest point was searched; None: all distances are exact.
        left_out: damaged files that were left out.
    """

    tile_points: int
    tiles: int
    sampled_points: int | None = None
    max_distance: float | None = None
    left_out: tuple[LeftOut, ...] = ()


class Difference(NamedTuple):
    """The difference a - b between two candidates in one metric, with an interval from the paired differences of cells.

    `metric` is named as in comparison.json: "d1_mse/candidate_to_reference", "chamfer/sum_squared", "fscore/0.1".
    """

    a: str
    b: str
    metric: str
    difference: float
    interval: Interval


def _root(value: float | None) -> float | None:
    return None if value is None else math.sqrt(value)
