"""Smoothing of a fused cloud where its surface is flat, and confidences of its points by those around them.

Fusion merges only depths that agree closely. The errors that remain at neighboring points come from several maps and
are largely independent, so that a plane through the neighbors is more accurate than a single point.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pcbench.geometry.arrays import FloatArray, freeze
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.neighbors import Index
from reconstructors.mvs.confidence import CONFIDENCE, SCORE, point_confidences

NEIGHBORS = 20  # points of a plane, the point itself included; their radius is about 2.5 times the point spacing
_MAX_ANGLE_DEG = 30.0  # between the normals of a plane and of its points
_MIN_PARALLEL_SHARE = 0.9  # share of the neighbors with a parallel normal on flat surface; edges have fewer
_MAX_SHIFT = 1 / 3  # of the radius of the neighbors, somewhat less than the point spacing, so that steps remain
_BLOCK_POINTS = 1 << 14  # points processed at a time: each needs some 200 float64 values of temporary memory


def flatten(cloud: Cloud, around: Sequence[Cloud] = ()) -> Cloud:
    """Return a cloud whose points on flat surface are moved along its normal onto planes through their neighbors.

    A plane has the mean normal of 20 nearest points and passes through their median along this normal. The surface is
    flat if nine tenths of these points have normals within 30 degrees of the plane's. A point on flat surface moves to
    the plane and takes its normal. Points at edges, on thin walls and on steps higher than the point spacing stay where
    they are.

    The attribute `score`, if there is one, becomes the attribute `confidence`, which also depends on the mean score of
    these 20 points.

    Args:
        cloud: cloud with normals.
        around: other clouds with normals, whose points are neighbors too. They do not move, and their scores do not
            count.
    """
    assert cloud.normals is not None
    points, normals = cloud.points.copy(), cloud.normals.copy()
    all_points = np.concatenate([points, *(other.points for other in around)]) if around else cloud.points
    all_normals = np.concatenate([normals, *(_normals(other) for other in around)]) if around else cloud.normals
    scores = cloud.attributes.get(SCORE, np.zeros(len(cloud))).astype(np.float64)
    mean_scores = np.full(len(cloud), scores.mean())
    if len(all_points) < NEIGHBORS:
        return _with_confidence(cloud, mean_scores)
    index = Index(all_points)
    for start in range(0, len(cloud), _BLOCK_POINTS):
        rows = np.arange(start, min(start + _BLOCK_POINTS, len(cloud)))
        neighbors = index.query(cloud.points[rows], NEIGHBORS)
        in_cloud = neighbors.indices < len(cloud)  # as is the point itself
        neighbor_scores = scores[np.where(in_cloud, neighbors.indices, 0)]
        mean_scores[rows] = np.average(neighbor_scores, axis=1, weights=in_cloud)
        neighbor_normals = all_normals[neighbors.indices]
        planes = neighbor_normals.sum(axis=1)
        planes /= np.maximum(np.linalg.norm(planes, axis=1, keepdims=True), np.finfo(float).tiny)
        cosines = _dot(neighbor_normals, planes[:, None])
        is_parallel = cosines >= np.cos(np.radians(_MAX_ANGLE_DEG))
        offsets = _dot(all_points[neighbors.indices] - cloud.points[rows, None], planes[:, None])
        shift = np.median(offsets, axis=1)
        is_flat = is_parallel.mean(axis=1) >= _MIN_PARALLEL_SHARE
        is_flat &= np.abs(shift) <= _MAX_SHIFT * neighbors.distances[:, -1]
        points[rows[is_flat]] += shift[is_flat, None] * planes[is_flat]
        normals[rows[is_flat]] = planes[is_flat]
    return _with_confidence(replace(cloud, points=points, normals=normals), mean_scores)


def _with_confidence(cloud: Cloud, mean_scores: FloatArray) -> Cloud:
    """Replace the scores of a cloud, if it has some, by confidences, with the mean scores (N,) around its points."""
    attributes = dict(cloud.attributes)
    if SCORE in attributes:
        scores = attributes.pop(SCORE).astype(np.float64)
        attributes[CONFIDENCE] = freeze(point_confidences(scores, mean_scores))
    return replace(cloud, attributes=attributes)


def _normals(cloud: Cloud) -> FloatArray:
    assert cloud.normals is not None
    return cloud.normals


def _dot(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return the scalar products of vectors along the last axis."""
    products: FloatArray = np.einsum("...i,...i->...", a, b)
    return products
