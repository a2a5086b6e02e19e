"""One-way distances, candidate → reference and reference → candidate, and what sampling alone would make of them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcbench.geometry.arrays import FloatArray, IntArray
from pcbench.geometry.neighbors import Index, Matches
from pcbench.measure import metrics
from pcbench.measure.reference import Reference


class Distances(NamedTuple):
    """Of each query of one direction (M,): to the nearest point, and signed to tangent planes of the reference."""

    to_points: FloatArray
    to_planes: FloatArray | None  # None without normals


class MeanMetric(NamedTuple):
    """A metric that is a mean over the queries of a direction. Floors, intervals, area weighting, comparison.json,
    metrics.csv and the table follow from this definition alone.

    Attributes:
        name: its key; root_name: that of its square root, if that is reported too.
        label, root_label: in tables.
        definition: in words.
        power: of the unit of length.
        of_each: what is averaged (M,), None where it does not exist.
        has_symmetric_max: whether the larger of both directions is reported.
    """

    name: str
    label: str
    definition: str
    power: int
    of_each: Callable[[Distances], FloatArray | None]
    root_name: str | None = None
    root_label: str | None = None
    has_symmetric_max: bool = False


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
    ),
    MeanMetric(
        "mean_distance",
        "mean distance",
        "mean distance to the nearest point",
        1,
        lambda distances: distances.to_points,
    ),
)


class Direction(NamedTuple):
    """One-way distances of the queries inside the region.

    Attributes:
        points: (M, 3) the queries, in local coordinates.
        distances: (M,) each.
        floors: of each mean metric by name, what it would be without any error; None where there is no such thing.
        blocks: (M,) of the bootstrap.
    """

    points: FloatArray
    distances: Distances
    floors: Mapping[str, float | None]
    blocks: IntArray


def from_candidate(reference: Reference, queries: FloatArray, matches: Matches) -> Direction:
    """Candidate → reference. Floor: leave-one-out distances inside the reference at the matched places."""
    distances, closest = matches
    planes = None
    if reference.has_normals:
        n = reference.surface.with_normals_at(closest)
        planes = metrics.plane_distances(queries, reference.points, n, closest_rows=closest, normal_rows=closest)
    floor = None
    if reference.nearest_other is not None:
        other = reference.nearest_other.indices[closest]
        floor_planes = None
        if reference.has_normals:
            n, a = reference.surface.with_normals_at(other), reference.points
            floor_planes = metrics.plane_distances(a, a, n, query_rows=closest, closest_rows=other, normal_rows=other)
        floor = Distances(reference.nearest_other.distances[closest], floor_planes)
    blocks = reference.blocks.of_point[closest]
    return Direction(queries, Distances(distances, planes), _floors(floor), blocks)


def from_reference(reference: Reference, candidate: Index, forth: Matches, back: Matches) -> Direction:
    """Reference → candidate. Floor: distances to the pseudo-candidate of the matched reference points."""
    rows, queries = reference.rows, reference.measured_points
    chosen: NDArray[np.bool_] = np.zeros(len(reference.points), bool)
    chosen[forth.indices] = True
    pseudo = Index(reference.points[chosen])
    floor, nearest = pseudo.nearest_of(reference.index) if rows is None else pseudo.query(queries)
    planes = floor_planes = None
    if reference.has_normals:
        n = reference.surface.with_normals_at(rows)
        planes = metrics.plane_distances(queries, candidate.points, n, closest_rows=back.indices, normal_rows=rows)
        floor_planes = metrics.plane_distances(queries, pseudo.points, n, closest_rows=nearest, normal_rows=rows)
    blocks = reference.blocks.of_point if rows is None else reference.blocks.of_point[rows]
    floors = _floors(Distances(floor, floor_planes))
    return Direction(queries, Distances(back.distances, planes), floors, blocks)


def _floors(distances: Distances | None) -> dict[str, float | None]:
    """Means over error-free distances: arrays are not kept, only one takes room at a time."""
    floors: dict[str, float | None] = {}
    for metric in MEAN_METRICS:
        values = None if distances is None else metric.of_each(distances)
        floors[metric.name] = None if values is None else float(np.mean(values))
    return floors
