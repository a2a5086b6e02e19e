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

from pcbench.geometry.arrays import FloatArray, IntArray
from pcbench.geometry.cameras import Camera
from reconstructors.mvs.maps import DepthMap

_BLOCK_PIXELS = 1 << 16  # pixels processed at a time: each needs some twenty float64 values of temporary memory
_MIN_SEEING_CONFIDENCE = 0.5  # a less confident depth behind a point does not contradict it
_MAX_DEPTH_RATIO = 1.05  # between a plane's depth half a pixel off its centre and at it; steeper normals are unreliable


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

    confidence: float = 0.3
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
    for k, (other, map_) in enumerate(sources):
        rows, columns = np.nonzero(candidates)
        for start in range(0, len(rows), _BLOCK_PIXELS):
            pixels = (rows[start : start + _BLOCK_PIXELS], columns[start : start + _BLOCK_PIXELS])
            confirmation = confirm(camera, depth_map, pixels, other, map_, criteria)
            confirmed = pixels[0][confirmation.indices], pixels[1][confirmation.indices]
            agree[k][confirmed] = True
            total[confirmed] += confirmation.depths
            seen_through[pixels[0][confirmation.seen_through], pixels[1][confirmation.seen_through]] += 1
    confirmations = agree.sum(axis=0)
    kept = candidates & (1 + confirmations >= criteria.views) & (confirmations > seen_through)
    means = (total / (1 + confirmations)).astype(np.float32)
    return FilteredMap(replace(depth_map, depth=means).where(kept), agree & kept)


class _Warp(NamedTuple):
    """Maps pixels of one pinhole with depths to homogeneous pixels of another: depth * linear (u, v, 1) + shift."""

    linear: FloatArray
    shift: FloatArray

    @classmethod
    def between(cls, a: Camera, b: Camera) -> _Warp:
        """Return the warp from pixels of a to pixels of b."""
        k = b.intrinsics.matrix
        turn = b.cam_from_world.rotation @ a.cam_from_world.rotation.T
        step = b.cam_from_world.translation - turn @ a.cam_from_world.translation
        return cls(k @ turn @ np.linalg.inv(a.intrinsics.matrix), k @ step)

    def apply(self, u: FloatArray, v: FloatArray, depth: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return pixel coordinates and depths (N,) each; not finite or not meaningful behind the other camera."""
        x, y, z = (depth * (m[0] * u + m[1] * v + m[2]) + t for m, t in zip(self.linear, self.shift, strict=True))
        with np.errstate(divide="ignore", invalid="ignore"):
            return x / z, y / z, z


class Confirmation(NamedTuple):
    """Pixels that another map confirms.

    Args:
        indices: (N,) indices into the queried pixels, ascending.
        depths: (N,) depths of the other map's surface at these pixels, in the querying camera.
        seen_through: (M,) indices of the queried pixels whose points the other image sees through: its surface there
            is farther away.
    """

    indices: IntArray
    depths: FloatArray
    seen_through: IntArray


def confirm(
    camera: Camera,
    depth_map: DepthMap,
    pixels: tuple[NDArray[np.int64], NDArray[np.int64]],
    other: Camera,
    other_map: DepthMap,
    criteria: Criteria,
) -> Confirmation:
    """Return the pixels of a map that another map confirms; those that fail a test skip the remaining tests.

    Depths of the other map below the minimum confidence confirm nothing.

    Args:
        camera: pinhole of the map.
        depth_map: the map.
        pixels: rows and columns of the queried pixels, (N,) each.
        other: pinhole of the other map.
        other_map: the other map.
        criteria: criteria for agreement.
    """
    height, width = other_map.depth.shape
    v, u = (index.astype(np.float64) + 0.5 for index in pixels)
    x, y, z = _Warp.between(camera, other).apply(u, v, depth_map.depth[pixels].astype(np.float64))
    indices = np.flatnonzero((z > 0) & (x >= 0) & (x < width) & (y >= 0) & (y < height))
    row, column = y[indices].astype(np.int64), x[indices].astype(np.int64)
    usable = (other_map.depth[row, column] > 0) & (other_map.confidence[row, column] >= criteria.confidence)
    indices, row, column = indices[usable], row[usable], column[usable]

    depths = depths_on_planes(other, other_map, row, column, x[indices], y[indices])
    beyond = depths - z[indices]
    is_seen_through = beyond > criteria.depth * z[indices]
    is_seen_through &= other_map.confidence[row, column] >= _MIN_SEEING_CONFIDENCE
    seen_through = indices[is_seen_through]
    close = np.abs(beyond) <= criteria.depth * z[indices]
    indices, row, column, depths = indices[close], row[close], column[close], depths[close]

    back_u, back_v, back_z = _Warp.between(other, camera).apply(x[indices], y[indices], depths)
    close = (back_z > 0) & (np.hypot(back_u - u[indices], back_v - v[indices]) <= criteria.pixels)
    turn = camera.cam_from_world.rotation @ other.cam_from_world.rotation.T
    normals = depth_map.normal[pixels[0][indices], pixels[1][indices]]
    other_normals = other_map.normal[row, column] @ turn.T.astype(np.float32)
    close &= np.einsum("ni,ni->n", normals, other_normals) >= np.cos(np.radians(criteria.normal_deg))
    return Confirmation(indices[close], back_z[close], seen_through)


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
