"""Confidence of depths and points: the share of such points that lie within two pixel footprints of the surface.

A depth has a score, a logistic function of three cues, and a point the mean score of its depths. The confidence of a
point is a logistic function of its score and of the mean score of its neighbours: errors come in patches. All weights
are fitted together, to points of synthetic cities with exact truth (docs/measured/mvs.md). Other cues add next to
nothing to these, among them the correlation of the images and how it falls along the ray.

- Support: depths around a right one lie on its plane; those of repeats and of plain surface scatter.
- Triangulation angle: a small one turns small errors in the images into large ones of the depth.
- Texture at the pixel, compared with that of the matched window: if only the window has texture, its edge lies beside
  the pixel, and the depth may be that of the edge.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.cameras import Camera
from pcbench.geometry.cloud import Cloud
from reconstructors.mvs.maps import DepthMap
from reconstructors.mvs.patchmatch import noise_variance, window_variances

CONFIDENCE = "confidence"  # attribute of a cloud
SCORE = "score"  # attribute of a fused cloud, from which the confidence follows
# Median triangulation angle from which on points are dropped: confidences are calibrated with 12 to 36 degrees.
MIN_SCENE_ANGLE_DEG = 10.0

_SUPPORT_RADII_PX = (4, 8, 12)  # distances of the neighbours, eight at each
_MIN_COSINE = 0.2  # between normal and line of sight, when the tolerance of the neighbours is computed
_ANGLES_DEG = (5.0, 45.0)  # smaller and larger angles count like these
_WINDOW_SIDES_PX = (3, 9)  # at the pixel, and the matcher's window
_MAX_TEXTURE_TO_NOISE = 100.0  # ratio of variances; more texture counts like this
# python benchmarks/mvs_confidence.py --seeds 1-3 --fit, with a minimum correlation of 0.3
CUE_WEIGHTS = (-1.74, 0.14, -1.50, 0.53, -0.41)  # of the cues of `depth_cues` in the log odds of a depth's score
POINT_WEIGHTS = (2.57, 0.38, 1.67)  # of 1 and of the log odds of both scores in the log odds of a point's confidence
SCORE_LIMITS = (0.005, 0.995)  # smaller and larger scores count like these


def depth_percents(
    camera: Camera,
    depth_map: DepthMap,
    agreement: NDArray[np.bool_],
    sources: Sequence[Camera],
    gray: NDArray[np.uint8],
) -> NDArray[np.uint8]:
    """Return the score of each depth of a filtered map in whole percent, (H, W) from 0 to 100; 0 without a depth.

    Whole percents do not depend on how a processor rounds logarithms.

    Args:
        camera: pinhole of the map.
        depth_map: filtered map.
        agreement: (sources, H, W), True if a source confirms a depth.
        sources: pinholes of the sources.
        gray: the photograph (H, W), undistorted and of the map's size.
    """
    cues = depth_cues(camera, depth_map, agreement, sources, gray)
    log_odds = sum(weight * cue for weight, cue in zip(CUE_WEIGHTS, cues.T, strict=True))
    percents = np.zeros(depth_map.depth.shape, dtype=np.uint8)
    percents[depth_map.known] = np.round(100 / (1 + np.exp(-log_odds)))
    return percents


def depth_cues(
    camera: Camera,
    depth_map: DepthMap,
    agreement: NDArray[np.bool_],
    sources: Sequence[Camera],
    gray: NDArray[np.uint8],
) -> FloatArray:
    """Return the cues (N, 5) of the depths of a map, row by row; the arguments are those of `depth_percents`.

    They are 1, the log of the angle's sine over that of one degree, this log times the log of the missing support, and
    the logs of the texture at the pixel and in the window.
    """
    has_depth = depth_map.known
    sines = _largest_sines(camera, depth_map, agreement, sources)
    narrowest, widest = np.sin(np.radians(_ANGLES_DEG))
    support = _support(camera, depth_map, np.maximum(narrowest / np.maximum(sines, 1e-6), 1))
    missing = 1 + 1 / (8 * len(_SUPPORT_RADII_PX)) - support[has_depth]
    angle = np.log(np.clip(sines[has_depth], narrowest, widest) / np.sin(np.radians(1.0)))
    noise = max(1.0, noise_variance(gray))
    texture, around = (
        np.log(np.clip(window_variances(gray, side)[has_depth] / noise, 1, _MAX_TEXTURE_TO_NOISE))
        for side in _WINDOW_SIDES_PX
    )
    return np.column_stack([np.ones_like(angle), angle, angle * np.log(missing), texture, around])


def point_confidences(scores: FloatArray, around: FloatArray) -> NDArray[np.float32]:
    """Return the confidences (N,) of points in steps of a thousandth.

    Args:
        scores: (N,) mean scores of each point's depths, from 0 to 1.
        around: (N,) mean scores of the points around each, itself included.
    """
    own, near = (np.log(p / (1 - p)) for p in (np.clip(score, *SCORE_LIMITS) for score in (scores, around)))
    constant, weight, weight_near = POINT_WEIGHTS
    return np.round(1 / (1 + np.exp(-(constant + weight * own + weight_near * near))), 3).astype(np.float32)


def keep_precise(cloud: Cloud, precision: float) -> Cloud:
    """Return the cloud without its least confident points, so that a share of the others is expected to be right.

    Args:
        cloud: cloud with confidences.
        precision: expected share of the points within two pixel footprints of the surface. All points are kept if it is
            0 or if no point is that confident.
    """
    confidence = cloud.attributes[CONFIDENCE].astype(np.float64)
    ordered = np.sort(confidence)[::-1]
    count = int(np.count_nonzero(np.cumsum(ordered) >= precision * np.arange(1, len(ordered) + 1)))
    return cloud if count in (0, len(cloud)) else cloud.select(confidence >= ordered[count - 1])


def _largest_sines(
    camera: Camera, depth_map: DepthMap, agreement: NDArray[np.bool_], sources: Sequence[Camera]
) -> FloatArray:
    """Return the sine (H, W) of the largest angle, up to 90 degrees, at which a confirming source meets the ray."""
    rows, columns = np.nonzero(depth_map.known)
    rays = camera.intrinsics.directions(np.column_stack([columns + 0.5, rows + 0.5]))
    local = rays * depth_map.depth[rows, columns, None].astype(np.float64)
    least = np.ones(len(rows))
    for source, agree in zip(sources, agreement[:, rows, columns], strict=True):
        to_source = camera.cam_from_world.apply(source.position[None]) - local[agree]
        along = -np.einsum("ni,ni->n", rays[agree], to_source)
        lengths = np.einsum("ni,ni->n", rays[agree], rays[agree]) * np.einsum("ni,ni->n", to_source, to_source)
        least[agree] = np.minimum(least[agree], along / np.sqrt(np.maximum(lengths, np.finfo(float).tiny)))
    sines = np.zeros(depth_map.depth.shape)
    sines[rows, columns] = np.sqrt(np.maximum(1 - np.maximum(least, 0) ** 2, 0))
    return sines


def _support(camera: Camera, depth_map: DepthMap, tolerance: FloatArray) -> FloatArray:
    """Return the share (H, W) of a depth's neighbours that lie on its plane; neighbours without a depth do not.

    Args:
        camera: pinhole of the map.
        depth_map: the map.
        tolerance: distance (H, W) from the plane up to which a neighbour lies on it, in pixel footprints.
    """
    height, width = depth_map.depth.shape
    k = camera.intrinsics
    u, v = np.meshgrid((np.arange(width) + 0.5 - k.cx) / k.fx, (np.arange(height) + 0.5 - k.cy) / k.fy)
    # The inverse depth of a plane is linear in the image.
    inverse = np.divide(1, depth_map.depth, out=np.zeros((height, width)), where=depth_map.known, dtype=np.float64)
    x, y, z = np.moveaxis(depth_map.normal.astype(np.float64), 2, 0)
    facing = -(x * u + y * v + z)
    cosine = np.maximum(facing / np.sqrt(u * u + v * v + 1), _MIN_COSINE)
    facing = np.maximum(facing, 1e-6)
    steps = -inverse * x / (k.fx * facing), -inverse * y / (k.fy * facing)
    limit = tolerance * inverse / (k.fx * cosine)
    count = np.zeros((height, width), dtype=np.uint8)
    for radius in _SUPPORT_RADII_PX:
        for down, right in np.ndindex(3, 3):
            dy, dx = radius * (down - 1), radius * (right - 1)
            if (dy, dx) == (0, 0) or abs(dy) >= height or abs(dx) >= width:
                continue
            here = np.s_[max(0, -dy) : height - max(0, dy), max(0, -dx) : width - max(0, dx)]
            there = np.s_[max(0, dy) : height - max(0, -dy), max(0, dx) : width - max(0, -dx)]
            plane = inverse[here] + dx * steps[0][here] + dy * steps[1][here]
            count[here] += (np.abs(inverse[there] - plane) < limit[here]) & (inverse[there] > 0)
    return count / (8.0 * len(_SUPPORT_RADII_PX))
