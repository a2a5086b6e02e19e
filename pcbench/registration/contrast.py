"""Contrast of a pose: how much a displacement worsens the fit, compared with the same displacement of the reference.

A wrong pose may fit well: flat ground fits flat ground, and in a cloud that fills a volume some point is always near.
But a wrong pose fits little better than its surroundings. So the candidate is displaced in both directions along each
motion. The growth of its distances to the reference is compared with the growth for the reference's own points at the
same positions, each queried against the others. For two samples of the same surface or forest the two growths are
similar, whatever the scene and the density. At a wrong pose the candidate's growth is much smaller, at least along the
motions in which the pose is wrong. The smallest ratio over all motions is therefore the contrast.

A scanner samples lines. A displacement smaller than the gap between lines meets the same line again or none, whether
the pose is right or not. So the displacement spans several gaps, and the reference's own points are shifted at random
between their line and the next, as the points of another scan would be.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pcbench.geometry.arrays import FloatArray, IntArray
from pcbench.geometry.neighbors import Index, Matches
from pcbench.geometry.normals import Surface
from pcbench.geometry.order_statistics import robust_sigma
from pcbench.geometry.sampling import line_gaps, nearest_elsewhere

MIN_CONTRAST = 0.55  # below this contrast all restarts have to return
DOUBTFUL_CONTRAST = 0.75  # below it at the scale of the noise, likewise
CONFIDENT_CONTRAST = 0.85  # above it a pose may be right, however far the clouds are apart
SURE_CONTRAST = 0.93  # below it restarts decide
BLURRED_CONTRAST = 0.65  # a right pose with less has a blurred or noisy candidate

_MAX_POSITIONS = (
    600  # reference points evaluated, at most twice as many: the contrast is then accurate to a few per cent
)
_MIN_POSITIONS = 50  # with fewer, the contrast is mostly noise
# The displacement, in point spacings and as a share of the extent.
_MIN_SPACINGS, _MAX_SPACINGS, _MAX_EXTENT_SHARE = 3.0, 12.0, 0.1
_MIN_LINE_GAPS = 5.0  # the displacement spans at least this multiple of the gap between scan lines at most positions
_MIN_SIGMAS = 8.0  # and at least this multiple of the residuals' standard deviation
# Motions that change the distances of the reference's own points less are ignored: share of the displacement, and
# multiple of the standard error.
_MIN_GROWTH, _MIN_SIGNIFICANCE = 0.03, 8.0


class Contrast(NamedTuple):
    """Contrast of a pose, and how sensitive the reference itself is to displacement."""

    share: float  # growth of the candidate over that of the reference: minimum over the motions it is sensitive to
    min_sensitivity: float  # smallest growth of the reference's own distances over all motions, over the displacement


def contrast(
    surface: Surface,
    moved: FloatArray,
    nearest: Matches,
    near: IntArray,
    *,
    sigma: float,
    spacing: float,
    extent: float,
    with_scale: bool,
) -> Contrast | None:
    """Return the contrast of a pose: the candidate's growth of distances over the reference's, about 1 if right.

    Args:
        surface: reference surface.
        moved: (M, 3) candidate points at the pose.
        nearest: reference points closest to them.
        near: (K,) rows of `moved` that may have a counterpart.
        sigma: robust standard deviation of the residuals of the points on the reference.
        spacing: point spacing of the reference.
        extent: extent of the reference.
        with_scale: whether the scale is one of the motions.

    Returns:
        The contrast; None if the clouds overlap in too few points, or if no motion changes the reference's distances
        significantly.
    """
    near = np.random.default_rng(0).permutation(near)
    # One candidate point per reference point: all points beyond the end of the reference have its last points as their
    # closest points, and would otherwise dominate by their number.
    positions, first = np.unique(nearest.indices[near], return_index=True)
    if len(positions) < _MIN_POSITIONS or spacing <= 0:
        return None
    rows = near[first]
    subset = slice(None, None, max(1, len(positions) // _MAX_POSITIONS))
    reference_rows, candidate_points = positions[subset], moved[rows[subset]]
    reference_points = surface.points[reference_rows]
    gaps = line_gaps(surface.index, reference_points)
    gap = float(np.percentile(np.linalg.norm(gaps, axis=1), 75))
    distance = max(_MAX_SPACINGS * spacing, _MIN_LINE_GAPS * gap, _MIN_SIGMAS * sigma)
    distance = min(distance, max(_MAX_EXTENT_SHARE * extent, _MIN_SPACINGS * spacing))
    center = candidate_points.mean(axis=0)
    radius = float(np.sqrt(np.square(candidate_points - center).sum(axis=1).mean())) or 1.0
    size = 7 if with_scale else 6

    def mean_growth(distances: FloatArray) -> FloatArray:
        """(size, P) mean growth of each point's distance over both directions, clamped to the displacement."""
        bounded = (np.minimum(distances, distance) / distance).reshape(1 + 2 * size, -1)
        growth: FloatArray = (bounded[1::2] + bounded[2::2]) / 2 - bounded[0]
        return growth

    def reference_growth(points: FloatArray) -> FloatArray:
        displaced = _displaced_points(points, center, distance, radius, size)
        own = np.tile(reference_rows, 1 + 2 * size)  # a point matches neither itself nor its copies
        return mean_growth(nearest_elsewhere(surface.index, surface.sampling, own, displaced).distances)

    displaced = _displaced_points(candidate_points, center, distance, radius, size)
    candidate_growth = mean_growth(surface.index.query(displaced).distances).mean(axis=1)
    growth = reference_growth(reference_points)
    mean, error = growth.mean(axis=1), growth.std(axis=1) / np.sqrt(len(reference_rows))
    is_sensitive = mean > np.maximum(_MIN_GROWTH, _MIN_SIGNIFICANCE * error)
    if not is_sensitive.any():
        return None
    share = float((candidate_growth[is_sensitive] / mean[is_sensitive]).min())
    if share < CONFIDENT_CONTRAST:
        noise = _added_noise(moved[rows], surface.points[positions])
        rng = np.random.default_rng(0)
        reference_points = (
            reference_points
            + rng.normal(0, noise, reference_points.shape)
            + rng.uniform(-0.5, 0.5, (len(reference_points), 1)) * gaps
        )
        blurred = np.minimum(mean, reference_growth(reference_points).mean(axis=1))[is_sensitive]
        # If the noise leaves no sensitivity, compare with the growth without noise.
        expected = np.where(blurred > _MIN_GROWTH, blurred, mean[is_sensitive])
        share = float((candidate_growth[is_sensitive] / expected).min())
    return Contrast(share, float(mean.min()))


def _added_noise(candidate: FloatArray, reference: FloatArray) -> float:
    """Return the standard deviation of the candidate's (N, 3) noise beyond the reference's at the same N positions."""
    candidate_noise, reference_noise = roughness(candidate), roughness(reference)
    return float(np.sqrt(max(0.0, candidate_noise**2 - reference_noise**2)))


def roughness(points: FloatArray) -> float:
    """Return the robust standard deviation of points from the tangent planes of their closest points."""
    surface = Surface(Index(points))
    rows = np.arange(0, len(points), max(1, len(points) // _MAX_POSITIONS))
    subset, nearest = points[rows], nearest_elsewhere(surface.index, surface.sampling, rows).indices
    return robust_sigma(surface.plane_offsets(subset, nearest))


def _displaced_points(points: FloatArray, center: FloatArray, distance: float, radius: float, size: int) -> FloatArray:
    """Return points (N, 3) unchanged, then displaced in both directions along each axis, about each axis and in scale.

    Args:
        points: (N, 3) points.
        center: (3,) centre of the rotations and the scale.
        distance: displacement; rotations and the scale displace by it at `radius`.
        radius: RMS radius of the points.
        size: 7 with the scale, else 6.

    Returns:
        (N + 2 size N, 3) points.
    """
    displacements = [points]
    offsets = points - center
    for shift in distance * np.eye(3):
        displacements += [points + shift, points - shift]
    cos, sin = np.cos(distance / radius), np.sin(distance / radius)
    for axis in range(3):
        b, c = (axis + 1) % 3, (axis + 2) % 3
        for s in (sin, -sin):
            rotated = offsets.copy()
            rotated[:, b], rotated[:, c] = (
                cos * offsets[:, b] - s * offsets[:, c],
                s * offsets[:, b] + cos * offsets[:, c],
            )
            displacements.append(rotated + center)
    if size == 7:
        factor = np.exp(distance / radius)
        displacements += [center + factor * offsets, center + offsets / factor]
    return np.concatenate(displacements)
