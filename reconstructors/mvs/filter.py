"""Filtering of depth maps: keep confident depths that the maps of other images confirm.

The first two constraints are those of Gao et al. on COLMAP's maps. The photometric one is a minimum confidence. The
geometric one is forward-backward reprojection (Schonberger et al. 2016, section 4.3): another image confirms a depth if
the pixel returns to itself when the two maps project it there and back. The third constraint is free space (Merrell et
al. 2007): more images must confirm a depth than see through it, to a surface behind it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.cameras import Camera
from reconstructors.mvs.maps import DepthMap
from reconstructors.mvs.native import _patchmatch

_MAX_DEPTH_RATIO = 1.05  # as in native/confirm.h


@dataclass(frozen=True)
class Criteria:
    """Criteria that a depth must meet to be kept.

    Args:
        confidence: minimum confidence.
        views: minimum number of images that agree, including the reference.
        pixels: maximum forward-backward reprojection error in pixels.
        depth: maximum relative difference of the depths.
        normal_deg: maximum angle between the normals. It is wide because normals are least certain on slanted surface.
    """

    confidence: float = 0.1
    views: int = 2
    pixels: float = 2.0
    depth: float = 0.02
    normal_deg: float = 60.0


class FilteredMap(NamedTuple):
    """A filtered map, and which sources confirm each of its depths.

    Args:
        depth_map: the map with its confirmed depths only.
        agreement: (sources, H, W), True if a source confirms a depth.
    """

    depth_map: DepthMap
    agreement: NDArray[np.bool_]


def filter_map(
    camera: Camera,
    depth_map: DepthMap,
    sources: Sequence[tuple[Camera, DepthMap]],
    criteria: Criteria,
    valid: NDArray[np.bool_] | None = None,
) -> FilteredMap:
    """Return the depths that are confident, valid, and confirmed by the maps of the sources.

    More sources must confirm a depth than see through it. A kept depth is the mean of the image's own and of the
    confirming maps' surfaces at its pixel, so that independent errors of the maps cancel.

    Args:
        camera: pinhole of the map's size.
        depth_map: depth map of the image.
        sources: pinholes with their maps. Their depths below the minimum confidence confirm nothing.
        criteria: criteria that a depth must meet.
        valid: (H, W), False where the image's mask hides it.
    """
    candidates = depth_map.known & (depth_map.confidence >= criteria.confidence)
    if valid is not None:
        candidates &= valid
    agree = np.zeros((len(sources), *candidates.shape), dtype=np.bool_)
    seen_through = np.zeros(candidates.shape, dtype=np.uint8)
    total = depth_map.depth.astype(np.float64)
    rows, columns = np.nonzero(candidates)
    for k, (other, map_) in enumerate(sources):
        depths, sees_through = confirm(camera, depth_map, (rows, columns), other, map_, criteria)
        agree[k][rows, columns] = confirmed = np.isfinite(depths)
        total[rows, columns] += np.where(confirmed, depths, 0)
        seen_through[rows, columns] += sees_through
    confirmations = agree.sum(axis=0)
    kept = candidates & (1 + confirmations >= criteria.views) & (confirmations > seen_through)
    means = (total / (1 + confirmations)).astype(np.float32)
    return FilteredMap(replace(depth_map, depth=means).where(kept), agree & kept)


class Confirmation(NamedTuple):
    """Answers of another map to pixels of a map.

    Args:
        depths: (N,) depths of the other map's surface at these pixels, in the map's camera; NaN where it does not
            confirm the map's depth.
        sees_through: (N,), True if the other image sees through the pixel's point: its surface there is farther away.
    """

    depths: FloatArray
    sees_through: NDArray[np.bool_]


def confirm(
    camera: Camera,
    depth_map: DepthMap,
    pixels: tuple[NDArray[np.int64], NDArray[np.int64]],
    other: Camera,
    other_map: DepthMap,
    criteria: Criteria,
) -> Confirmation:
    """Compare depths of a map with another map.

    Depths of the other map below the minimum confidence confirm nothing. Its depth off the centre of a pixel is that of
    the plane through the pixel's depth and normal.

    Args:
        camera: pinhole of the map.
        depth_map: the map.
        pixels: rows and columns of the queried pixels, (N,) each.
        other: pinhole of the other map.
        other_map: the other map.
        criteria: criteria for agreement.
    """
    k, (rows, columns) = other.intrinsics, pixels
    depths, sees_through = np.empty(len(rows)), np.empty(len(rows), np.bool_)
    _patchmatch.confirm(
        *_arrays(depth_map), np.ascontiguousarray(rows), np.ascontiguousarray(columns),
        *_arrays(other_map), np.array([k.fx, k.fy, k.cx, k.cy]), _warp(camera, other), _warp(other, camera),
        camera.cam_from_world.rotation @ other.cam_from_world.rotation.T,
        criteria.confidence, criteria.pixels, criteria.depth, np.cos(np.radians(criteria.normal_deg)),
        depths, sees_through,
    )  # fmt: skip
    return Confirmation(depths, sees_through)


def _arrays(depth_map: DepthMap) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Return depths, normals and confidences as compiled code reads them."""
    depth, normal, confidence = (
        np.ascontiguousarray(part, np.float32) for part in (depth_map.depth, depth_map.normal, depth_map.confidence)
    )
    return depth, normal, confidence


def _warp(a: Camera, b: Camera) -> FloatArray:
    """Return the matrix (3, 4) from homogeneous pixels of a times their depths to those of b."""
    k = b.intrinsics.matrix
    turn = b.cam_from_world.rotation @ a.cam_from_world.rotation.T
    step = b.cam_from_world.translation - turn @ a.cam_from_world.translation
    return np.column_stack([k @ turn @ np.linalg.inv(a.intrinsics.matrix), k @ step])


def depths_on_planes(
    camera: Camera, depth_map: DepthMap, row: NDArray[np.int64], column: NDArray[np.int64], u: FloatArray, v: FloatArray
) -> FloatArray:
    """Return depths (N,) at coordinates off the pixel centres, on the plane through each pixel's depth and normal."""
    k, (a, b, c) = camera.intrinsics, depth_map.normal[row, column].T.astype(np.float64)
    centre = a * ((column + 0.5 - k.cx) / k.fx) + b * ((row + 0.5 - k.cy) / k.fy) + c
    with np.errstate(divide="ignore", invalid="ignore"):
        slope = centre / (a * ((u - k.cx) / k.fx) + b * ((v - k.cy) / k.fy) + c)
    steep = ~((slope < _MAX_DEPTH_RATIO) & (slope > 1 / _MAX_DEPTH_RATIO))
    depths: FloatArray = depth_map.depth[row, column].astype(np.float64) * np.where(steep, 1.0, slope)
    return depths


def world_points(camera: Camera, pixels: FloatArray, depth: NDArray[np.float32] | FloatArray) -> FloatArray:
    """Return world points (N, 3) at pixel coordinates (N, 2) and z-depths (N,) of a camera."""
    local = camera.intrinsics.directions(pixels) * np.asarray(depth, dtype=np.float64)[:, None]
    points: FloatArray = (local - camera.cam_from_world.translation) @ camera.cam_from_world.rotation
    return points
