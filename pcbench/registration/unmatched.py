"""Points of one cloud inside the other that have no counterpart: what a wrong pose with a large overlap leaves.

A part of a scene may slide onto another part: half of a room fits the other half, and streets fit streets. Most points
then lie on the other cloud, and every displacement worsens the fit. But the furniture or the houses of either cloud
stand where the other one has nothing. At a right pose only the points outside the other cloud have no counterpart, and
outliers.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pcbench.geometry.arrays import FloatArray, random_rows
from pcbench.geometry.neighbors import Index
from pcbench.geometry.sampling import median_spacing
from pcbench.registration.target import Target

# Share above which a pose found by a search is refused. It was at most 0.019 at 111 right poses of unchanged scenes.
MAX_UNMATCHED_SHARE = 0.025

_NEAR_EXTENT_SHARE = 0.05  # of the extent: within this distance a point may have a counterpart
_MIN_SPACINGS = 5.0  # and at least this multiple of the larger point spacing
_MAX_SAMPLE = 30_000  # points of the reference that are tested
_SURFACE_NEIGHBORS = 15  # own points within the distance around a point on a surface; a strewn outlier has fewer
_MIN_INSIDE = 50  # points inside the other cloud: with fewer the share means nothing
_DIRECTIONS = 60  # slabs whose intersection encloses a cloud
_OUTER_PERCENT = 1.0  # points cut off at either side of each slab: outliers would enclose empty space


def unmatched_share(target: Target, moved: FloatArray) -> float:
    """Return the share of points inside the other cloud that have no counterpart: the larger of both directions.

    Outliers that are strewn in space do not count: they have few neighbours in their own cloud.

    Args:
        target: reference.
        moved: (N, 3) random sample of the candidate at a pose, in the reference's local coordinates.
    """
    reference, candidate = random_rows(target.surface.points, _MAX_SAMPLE), Index(moved)
    spacing = max(target.spacing, median_spacing(candidate))
    max_distance = max(_NEAR_EXTENT_SHARE * target.extent, _MIN_SPACINGS * spacing)
    candidate_inside = moved[_is_inside(moved, reference)]
    reference_inside = reference[_is_inside(reference, moved)]
    return max(
        _share_beyond(target.surface.index, candidate_inside, candidate, max_distance),
        _share_beyond(candidate, reference_inside, Index(reference), max_distance),
    )


def _share_beyond(index: Index, points: FloatArray, own: Index, max_distance: float) -> float:
    """Return the share of points (N, 3) that lie on surfaces of one cloud, but not within a distance of another.

    For few points it is 0.
    """
    if len(points) < _MIN_INSIDE or len(own) < _SURFACE_NEIGHBORS:
        return 0.0
    beyond = points[index.query(points).distances > max_distance]
    on_surface = own.query(beyond, k=_SURFACE_NEIGHBORS).distances[:, -1] <= max_distance
    return float(np.count_nonzero(on_surface) / len(points))


def _is_inside(points: FloatArray, cloud: FloatArray) -> NDArray[np.bool_]:
    """Return which points (N, 3) lie in the intersection of the slabs that hold the inner 98 % of a cloud (M, 3)."""
    inside = np.ones(len(points), dtype=bool)
    for direction in _directions():
        lower, upper = np.percentile(cloud @ direction, (_OUTER_PERCENT, 100 - _OUTER_PERCENT))
        positions = points @ direction
        inside &= (positions >= lower) & (positions <= upper)
    return inside


def _directions() -> FloatArray:
    """Return unit vectors (60, 3) spread evenly over half a sphere, on a Fibonacci spiral."""
    k = np.arange(_DIRECTIONS)
    z = (k + 0.5) / _DIRECTIONS
    angle = k * np.pi * (3 - np.sqrt(5))
    radius = np.sqrt(1 - z**2)
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle), z])
