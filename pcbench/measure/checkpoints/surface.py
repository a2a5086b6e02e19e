"""Height of a cloud's surface at a place: by the triangulation of its points, and by a plane fitted to them."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from pcbench.geometry.arrays import FloatArray
from pcbench.measure.wording import with_unit

_MAX_GAP_SPACINGS = 3.0  # to the nearest point; of evenly random points, one place in 10^12 has a larger gap
_PLANE_SPACINGS = 3.0  # radius of the fitted plane: about 28 points
_TRIANGLE_SHARE = 1.5  # of the distance to the farthest corner of the triangle, for unevenly spaced points
_MIN_PLANE_POINTS = 6
_ROUNDING = 1e-9


class LocalSurface(NamedTuple):
    """The surface of a cloud at a place, in the unit of the cloud.

    Attributes:
        tin: height of the triangle around the place in the Delaunay triangulation of the cloud.
        plane: height of the least-squares plane through the points around it.
        spacing: local point spacing in plan view: the square root of the area per point.
        noise: standard deviation of the heights about the plane.
        slope: slope of the plane, as rise over run.
        radius: radius of the plane's points.
        fitted: number of the plane's points.
    """

    tin: float
    plane: float
    spacing: float
    noise: float
    slope: float
    radius: float
    fitted: int


def local_surface(position: FloatArray, points: FloatArray, *, are_all: bool, unit: str | None) -> LocalSurface | str:
    """Return the surface of a cloud at a place, or why the cloud does not cover it.

    Args:
        position: (2,) x and y of the place.
        points: (K, 3) the nearest points of the cloud in plan view, the nearest first.
        are_all: whether these are all points of the cloud.
        unit: unit of the coordinates, if known.

    The triangle of the nearest points around the place is one of the complete cloud's Delaunay triangulation if no
    unknown point can lie in its circumcircle, that is, if the circle lies within the distance of the farthest point.
    """
    local = _without_copies(points - np.append(position, 0.0))
    distances = np.hypot(local[:, 0], local[:, 1])
    if len(local) < 3:
        return "fewer than three points of the cloud"
    spacing = distances[-1] * math.sqrt(math.pi / len(local))
    if distances[0] > _MAX_GAP_SPACINGS * spacing:
        return f"the nearest point is {with_unit(f'{distances[0]:.3g}', unit)} away"
    corners = _triangle_around(local)
    if corners is None:
        return "outside the cloud"
    center, radius = _circumcircle(local[corners, :2])
    if not are_all and math.hypot(*center) + radius > distances[-1] * (1 + _ROUNDING):
        return "at the edge of the cloud or of a gap"
    height = _interpolated(local[corners])
    reach = max(_PLANE_SPACINGS * spacing, _TRIANGLE_SHARE * float(distances[corners].max()))
    count = max(int(np.searchsorted(distances, reach, side="right")), min(_MIN_PLANE_POINTS, len(local)))
    plane, noise, slope = _fitted_plane(local[:count])
    return LocalSurface(height, plane, spacing, noise, slope, float(min(reach, distances[-1])), count)


def _without_copies(local: FloatArray) -> FloatArray:
    """Return points (K, 3), the nearest first, with those at the same x and y as one at their mean height.

    Tiles may overlap, and copies would look like a dense cloud.
    """
    _, first, inverse, counts = np.unique(
        local[:, :2], axis=0, return_index=True, return_inverse=True, return_counts=True
    )
    if len(first) == len(local):
        return local
    merged = local[first]
    base = merged[inverse.ravel(), 2]  # differences of heights lose less to rounding
    merged[:, 2] += np.bincount(inverse.ravel(), local[:, 2] - base) / counts
    return merged[np.argsort(first)]


def _triangle_around(local: FloatArray) -> list[int] | None:
    """Return the corners of the Delaunay triangle that contains the origin; None if it is outside the hull."""
    from scipy.spatial import Delaunay, QhullError

    scale = np.abs(local[:, :2]).max()
    if scale == 0:
        return None
    try:
        triangulation = Delaunay(local[:, :2] / scale)
    except QhullError:  # all points lie on one line
        return None
    row = int(triangulation.find_simplex(np.zeros((1, 2)), tol=_ROUNDING)[0])
    return None if row < 0 else [int(corner) for corner in triangulation.simplices[row]]


def _circumcircle(triangle: FloatArray) -> tuple[FloatArray, float]:
    """Return centre (2,) and radius of the circle through three points (3, 2); infinite if they lie on one line."""
    a, b, c = triangle
    p, q = b - a, c - a
    doubled = 2.0 * (p[0] * q[1] - p[1] * q[0])
    if doubled == 0.0:
        return a, math.inf
    pp, qq = p @ p, q @ q
    offset = np.array([q[1] * pp - p[1] * qq, p[0] * qq - q[0] * pp]) / doubled
    return a + offset, math.hypot(*offset)


def _interpolated(triangle: FloatArray) -> float:
    """Return the height at the origin of the plane through three points (3, 3), by barycentric coordinates."""
    (ax, ay), (bx, by), (cx, cy) = triangle[:, :2].tolist()
    weights = np.array([bx * cy - by * cx, cx * ay - cy * ax, ax * by - ay * bx])
    base = float(triangle[0, 2])  # differences of heights lose less to rounding
    return base + float((weights * (triangle[:, 2] - base)).sum() / weights.sum())


def _fitted_plane(local: FloatArray) -> tuple[float, float, float]:
    """Return height at the origin, standard deviation about the plane, and slope of the plane through points (K, 3)."""
    scale, base = float(np.abs(local[:, :2]).max()), float(local[:, 2].mean())
    system = np.column_stack([np.ones(len(local)), local[:, :2] / scale])
    # Normal equations of scaled coordinates are well conditioned, and small enough for one thread.
    products = (system[:, :, None] * system[:, None, :]).sum(axis=0)
    right = (system * (local[:, 2] - base)[:, None]).sum(axis=0)
    solution = np.linalg.pinv(products) @ right
    residuals = local[:, 2] - base - (system * solution).sum(axis=1)
    noise = math.sqrt(float(np.square(residuals).sum()) / max(len(local) - 3, 1))
    return float(solution[0]) + base, noise, math.hypot(*solution[1:]) / scale
