"""Repeated samples of the distances to tangent planes, whose exact mean square is known."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcbench.geometry.neighbors import Index, match_both_directions
from pcbench.geometry.normals import estimate_normals
from pcbench.measure.metrics import plane_distances
from pcbench.measure.plane_sample import sample_planes

Floats = NDArray[np.float64]


class Direction(NamedTuple):
    """All distances of one direction: to the closest points, and signed to the reference's tangent planes."""

    to_points: Floats
    to_planes: Floats

    @property
    def mean_square(self) -> float:
        return float(np.mean(np.square(self.to_planes)))


class Coverage(NamedTuple):
    """Outcome of repeated samples.

    Attributes:
        covered: runs whose interval contains the exact mean square.
        sampled: runs with a sample; in the others all distances would be measured.
        within: runs whose estimate is within the tolerance of the exact mean square.
        points: mean number of points of a sample.
    """

    covered: int
    sampled: int
    within: int
    points: float


def directions(reference: Floats, candidate: Floats) -> dict[str, Direction]:
    """Measure both directions of two clouds (N, 3) and (M, 3)."""
    origin = reference.mean(axis=0)
    of_reference, of_candidate = Index(reference - origin), Index(candidate - origin)
    forth, back = match_both_directions(of_reference, of_candidate)
    normals, found = estimate_normals(of_reference).directions, {}
    for name, queries, points, matches, rows in (
        ("c→r", of_candidate.points, of_reference.points, forth, forth.indices),
        ("r→c", of_reference.points, of_candidate.points, back, None),
    ):
        planes = plane_distances(queries, points, normals, closest_rows=matches.indices, normal_rows=rows)
        found[name] = Direction(matches.distances, planes)
    return found


def coverage(direction: Direction, tolerance: float, seeds: range) -> Coverage:
    """Sample a direction once per seed."""
    exact, covered, within, sizes = direction.mean_square, 0, 0, []
    for seed in seeds:
        sample = sample_planes(direction.to_points, lambda rows: direction.to_planes[rows], tolerance, seed)
        if sample is None:
            continue
        error = abs(sample.mean_square - exact)
        covered += error <= sample.half_width
        within += error <= tolerance * exact
        sizes.append(len(sample.rows))
    return Coverage(covered, len(sizes), within, float(np.mean(sizes)) if sizes else np.nan)
