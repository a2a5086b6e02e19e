"""One-way distances candidate → reference and reference → candidate, and their sampling floors."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

from pcbench.geometry.arrays import FloatArray, IntArray
from pcbench.geometry.neighbors import Index, Matches
from pcbench.measure import floors, metrics
from pcbench.measure.metrics import Distances
from pcbench.measure.reference import Reference


class MeanMetric(NamedTuple):
    """A metric that is a mean over the queries of one direction.

    Floors, intervals, area weighting, differences between candidates and all outputs follow from this definition.

    Attributes:
        name: key of the metric.
        label: label of its row in tables.
        definition: definition in words.
        power: power of the unit of length.
        values_of: function that returns the averaged values (M,), or None if they do not exist.
        root_name: key of its square root, if that is reported too.
        root_label: label of the square root in tables.
        has_symmetric_max: whether the larger of both directions is reported.
        headline: label in the summary, of the square root if there is one; empty: not in the summary.
        column: heading of its column in the summary.
        ranks: `Headline.rank` of that column for c→r and r→c, each with the rank of the floor.
    """

    name: str
    label: str
    definition: str
    power: int
    values_of: Callable[[Distances], FloatArray | None]
    root_name: str | None = None
    root_label: str | None = None
    has_symmetric_max: bool = False
    headline: str = ""
    column: str = ""
    ranks: tuple[tuple[int | None, int | None], tuple[int | None, int | None]] = ((None, None), (None, None))


def _squares(values: FloatArray | None) -> FloatArray | None:
    return None if values is None else np.square(values)


MEAN_METRICS = (
    MeanMetric(
        "d1_mse",
        "D1 MSE",
        "mean square, point to nearest point",
        2,
        lambda distances: _squares(distances.to_points),
        "d1_rms",
        "D1 RMS",
        has_symmetric_max=True,
    ),
    MeanMetric(
        "d2_mse",
        "D2 MSE",
        "mean square, point to tangent plane of the reference",
        2,
        lambda distances: _squares(distances.to_planes),
        "d2_rms",
        "D2 RMS",
        has_symmetric_max=True,
        headline="RMS off the surface (D2)",
        column="D2 RMS",
        ranks=((0, 1), (None, None)),
    ),
    MeanMetric(
        "mean_distance",
        "mean distance",
        "mean distance to the nearest point",
        1,
        lambda distances: distances.to_points,
        headline="mean distance",
        column="mean",
        ranks=((5, 5), (0, 1)),
    ),
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
    cells: IntArray


def from_candidate(reference: Reference, queries: FloatArray, matches: Matches) -> Direction:
    """Measure the direction candidate → reference."""
    distances, closest = matches
    planes = None
    if reference.has_normals:
        n = reference.surface.compute_normals(closest)
        planes = metrics.plane_distances(queries, reference.points, n, closest_rows=closest, normal_rows=closest)
    floor = _means(floors.to_reference(reference, queries))
    return Direction(queries, Distances(distances, planes), floor, reference.cells.of_point[closest])


def from_reference(
    reference: Reference, candidate: Index, matched: IntArray, back: Matches, *, forth: Direction, seed: int
) -> Direction:
    """Measure the direction reference → candidate.

    Args:
        reference: the prepared reference.
        candidate: search index of the aligned candidate.
        matched: (N,) the reference's point nearest to each point of the candidate; negative if unknown.
        back: closest candidate points of the reference's measured points.
        forth: the other direction; its plane distances and their floor estimate the candidate's errors.
        seed: random seed of the floor's sample.
    """
    rows, queries = reference.rows, reference.measured_points
    planes = None
    if reference.has_normals:
        n = reference.surface.compute_normals(rows)
        planes = metrics.plane_distances(queries, candidate.points, n, closest_rows=back.indices, normal_rows=rows)
    cells = reference.cells.of_point if rows is None else reference.cells.of_point[rows]
    error = 0.0
    if forth.distances.to_planes is not None:
        error = _error_share(metrics.mean_square(forth.distances.to_planes), forth.floors["d2_mse"])
    floor = _means(floors.to_candidate(reference, candidate, matched, error, seed))
    return Direction(queries, Distances(back.distances, planes), floor, cells)


def _means(distances: Distances | None) -> dict[str, float | None]:
    """Return the mean of each mean metric by name."""
    means: dict[str, float | None] = {}
    for metric in MEAN_METRICS:
        values = None if distances is None else metric.values_of(distances)
        means[metric.name] = None if values is None else float(np.mean(values))
    return means


def _error_share(score: float, floor: float | None) -> float:
    """Return the share of a score that sampling does not explain."""
    return 0.0 if floor is None or score <= floor else 1 - floor / score
