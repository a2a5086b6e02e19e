"""One-way distances candidate → reference and reference → candidate, and their sampling floors."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

from pcbench.geometry.arrays import FloatArray, IntArray
from pcbench.geometry.neighbors import Matches
from pcbench.geometry.normals import Surface
from pcbench.geometry.quantisation import PlacedQuantisation
from pcbench.measure import floors, metrics
from pcbench.measure.intervals import CellNumbers
from pcbench.measure.metrics import Distances
from pcbench.measure.plane_sample import PlaneSample, sample_planes
from pcbench.measure.quantity import LENGTH, SQUARED_LENGTH
from pcbench.measure.reference import Reference


class MeanMetric(NamedTuple):
    """A metric that is a mean over the queries of one direction.

    Floors, intervals, area weighting, differences between candidates and all outputs follow from this definition;
    `pcbench.report.layout` has its labels.

    Attributes:
        name: key of the metric.
        definition: definition in words.
        unit: unit of the values, see `Quantity.unit`.
        values_of: function that returns the averaged values (M,), or None if they do not exist.
        root_name: key of its square root, if that is reported too.
        has_symmetric_max: whether the larger of both directions is reported.
    """

    name: str
    definition: str
    unit: str
    values_of: Callable[[Distances], FloatArray | None]
    root_name: str | None = None
    has_symmetric_max: bool = False


PLANE_METRIC = "d2_mse"
"""Name of the metric that needs distances to tangent planes."""
MEAN_METRICS = (
    MeanMetric(
        "d1_mse",
        "mean square, point to nearest point",
        SQUARED_LENGTH,
        lambda distances: np.square(distances.to_points),
        root_name="d1_rms",
        has_symmetric_max=True,
    ),
    MeanMetric(
        PLANE_METRIC,
        "mean square, point to tangent plane of the reference",
        SQUARED_LENGTH,
        lambda distances: distances.plane_squares,
        root_name="d2_rms",
        has_symmetric_max=True,
    ),
    MeanMetric("mean_distance", "mean distance to the nearest point", LENGTH, lambda distances: distances.to_points),
)


class Direction(NamedTuple):
    """One-way distances of the queries inside the region.

    Attributes:
        points: (M, 3) queries, in local coordinates.
        distances: (M,) distances of each kind.
        floors: sampling floor of each mean metric by name; None if it does not exist.
        cells: (M,) correlation cell in which each query is measured.
    """

    points: FloatArray
    distances: Distances
    floors: Mapping[str, float | None]
    cells: CellNumbers


def from_candidate(
    reference: Reference,
    queries: FloatArray,
    matches: Matches,
    *,
    seed: int,
    rounding: PlacedQuantisation | None = None,
) -> Direction:
    """Measure the direction candidate → reference.

    Args:
        reference: the prepared reference.
        queries: (M, 3) points of the aligned candidate.
        matches: their closest points of the reference.
        seed: random seed of the sample, if distances to planes are sampled.
        rounding: how the candidate's coordinates are rounded; None: rounding is negligible in both clouds.
    """
    distances, closest = matches

    def measure(rows: IntArray | None) -> FloatArray:
        nearest = closest if rows is None else closest[rows]
        n = reference.surface.compute_normals(nearest)
        return metrics.plane_distances(
            queries, reference.points, n, query_rows=rows, closest_rows=nearest, normal_rows=nearest
        )

    planes = _to_planes(reference, distances, measure, seed)
    few = queries[floors.even_sample(len(queries))]
    floor = mean_values(floors.to_reference(reference.for_floors, few, rounding))
    return Direction(queries, Distances(distances, planes), floor, reference.cells.of_point[closest])


def from_reference(
    reference: Reference,
    candidate: Surface,
    matched: IntArray,
    back: Matches,
    *,
    forth: Direction,
    seed: int,
    rounding: PlacedQuantisation | None = None,
) -> Direction:
    """Measure the direction reference → candidate.

    Args:
        reference: the prepared reference.
        candidate: the aligned candidate.
        matched: (N,) the reference's point nearest to each point of the candidate; negative if unknown.
        back: closest candidate points of the reference's measured points.
        forth: the other direction; its plane distances and their floor estimate the candidate's errors.
        seed: random seed of the sample, if distances to planes are sampled.
        rounding: how the candidate's coordinates are rounded; None: rounding is negligible in both clouds.
    """
    measured, queries = reference.rows, reference.measured_points

    def measure(rows: IntArray | None) -> FloatArray:
        tangents = measured if rows is None else rows if measured is None else measured[rows]
        closest = back.indices if rows is None else back.indices[rows]
        n = reference.surface.compute_normals(tangents)
        return metrics.plane_distances(
            queries, candidate.points, n, query_rows=rows, closest_rows=closest, normal_rows=tangents
        )

    planes = _to_planes(reference, back.distances, measure, seed)
    cells = reference.cells.of_point if measured is None else reference.cells.of_point[measured]
    error = 0.0
    if (squares := forth.distances.plane_squares) is not None:
        error = error_share(float(np.mean(squares)), forth.floors[PLANE_METRIC])
    few = floors.even_sample(len(queries))
    rows = few if measured is None else measured[few]
    floor = mean_values(
        floors.to_candidate(reference.for_floors, rows, candidate, lambda rows: matched[rows], error, rounding)
    )
    return Direction(queries, Distances(back.distances, planes), floor, cells)


def _to_planes(
    reference: Reference, to_points: FloatArray, measure: Callable[[IntArray | None], FloatArray], seed: int
) -> FloatArray | PlaneSample | None:
    """Return the distances to planes of all queries, or of a sample if the comparison has a tolerance.

    Args:
        reference: the prepared reference.
        to_points: (M,) distances of all queries to their closest points.
        measure: function that returns the distances to planes at rows of the queries, or at all if None.
        seed: random seed of the sample.
    """
    if not reference.has_normals:
        return None
    sample = None
    if reference.tolerance is not None:
        if not to_points.any():
            return np.zeros(len(to_points))
        sample = sample_planes(to_points, measure, reference.tolerance, seed)
    return measure(None) if sample is None else sample


def mean_values(distances: Distances | None) -> dict[str, float | None]:
    """Return the mean of each mean metric by name."""
    means: dict[str, float | None] = {}
    for metric in MEAN_METRICS:
        values = None if distances is None else metric.values_of(distances)
        means[metric.name] = None if values is None else float(np.mean(values))
    return means


def error_share(score: float, floor: float | None) -> float:
    """Return the share of a score that sampling does not explain."""
    return 0.0 if floor is None or score <= floor else 1 - floor / score
