"""What of a map is kept: confident depths that the maps of other images confirm.

The two constraints of Gao et al. on COLMAP's maps: photometric (a confidence) and geometric (a depth is confirmed by
another image where a pixel that is taken there and back by the two maps returns to itself, Schonberger et al. 2016,
section 4.3), with at least three images to a point.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcbench.geometry.arrays import FloatArray, IntArray
from pcbench.geometry.cameras import Camera
from reconstructors.mvs.maps import DepthMap

_BLOCK = 1 << 16  # pixels at a time: what lies between map and map is twenty numbers each in float64
_MAX_SLOPE = 1.05  # of depths on the plane of a pixel half a pixel beside its centre: steeper ones are guessed


@dataclass(frozen=True)
class Criteria:
    """What a depth has to be to be kept.

    Args:
        confidence: at least.
        views: images that have to agree, the reference counted.
        pixels: there and back, at most.
        depth: relative difference of the depths, at most.
        normal_deg: between the normals, at most. They are the least certain where surface is seen at a slant.
    """

    confidence: float = 0.3
    views: int = 3
    pixels: float = 2.0
    depth: float = 0.02
    normal_deg: float = 60.0


class Filtered(NamedTuple):
    """A map of what is kept, and which of its sources confirm it.

    Args:
        made: the map.
        agree: (sources, H, W).
    """

    made: DepthMap
    agree: NDArray[np.bool_]


def filter_map(
    camera: Camera,
    made: DepthMap,
    sources: Sequence[tuple[Camera, DepthMap]],
    criteria: Criteria,
    valid: NDArray[np.bool_] | None = None,
) -> Filtered:
    """The map of an image with what is confident, valid, and confirmed by the maps of its sources.

    Args:
        camera: a pinhole of the map's size.
        sources: pinholes with their maps; what of these is not confident confirms nothing.
        valid: (H, W), False where the image's mask hides it.
    """
    asked = made.known & (made.confidence >= criteria.confidence)
    if valid is not None:
        asked &= valid
    agree = np.zeros((len(sources), *asked.shape), dtype=np.bool_)
    for k, (other, map_) in enumerate(sources):
        rows, columns = np.nonzero(asked)
        for start in range(0, len(rows), _BLOCK):
            at = (rows[start : start + _BLOCK], columns[start : start + _BLOCK])
            which = confirmed(camera, made, at, other, map_, criteria).which
            agree[k, at[0][which], at[1][which]] = True
    kept = asked & (1 + agree.sum(axis=0) >= criteria.views)
    return Filtered(made.where(kept), agree & kept)


class _Warp(NamedTuple):
    """From pixels of one pinhole and their depths to homogeneous ones of another: depth * linear (u, v, 1) + shift."""

    linear: FloatArray
    shift: FloatArray

    @classmethod
    def between(cls, a: Camera, b: Camera) -> _Warp:
        """From pixels of a to pixels of b."""
        k = b.intrinsics.matrix
        turn = b.cam_from_world.rotation @ a.cam_from_world.rotation.T
        step = b.cam_from_world.translation - turn @ a.cam_from_world.translation
        return cls(k @ turn @ np.linalg.inv(a.intrinsics.matrix), k @ step)

    def apply(self, u: FloatArray, v: FloatArray, depth: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Pixel coordinates and depths (N,) each; not finite, or of no meaning, behind the other camera."""
        x, y, z = (depth * (m[0] * u + m[1] * v + m[2]) + t for m, t in zip(self.linear, self.shift, strict=True))
        with np.errstate(divide="ignore", invalid="ignore"):
            return x / z, y / z, z


class Confirmed(NamedTuple):
    """What another map says of pixels.

    Args:
        which: (N,) of the pixels asked for, rising.
        depths: (N,) of the other map's surface there, in the camera that asks.
    """

    which: IntArray
    depths: FloatArray


def confirmed(
    camera: Camera,
    made: DepthMap,
    at: tuple[NDArray[np.int64], NDArray[np.int64]],
    other: Camera,
    theirs: DepthMap,
    criteria: Criteria,
) -> Confirmed:
    """The pixels (rows, columns) of a map that another one confirms; those that fail one test are not asked the next.

    Where the other map has depths of less than the least confidence it confirms nothing.
    """
    height, width = theirs.depth.shape
    v, u = (index.astype(np.float64) + 0.5 for index in at)
    x, y, z = _Warp.between(camera, other).apply(u, v, made.depth[at].astype(np.float64))
    open_ = np.flatnonzero((z > 0) & (x >= 0) & (x < width) & (y >= 0) & (y < height))
    row, column = y[open_].astype(np.int64), x[open_].astype(np.int64)
    known = (theirs.depth[row, column] > 0) & (theirs.confidence[row, column] >= criteria.confidence)
    open_, row, column = open_[known], row[known], column[known]

    found = depths_beside(other, theirs, row, column, x[open_], y[open_])
    close = np.abs(found - z[open_]) <= criteria.depth * z[open_]
    open_, row, column, found = open_[close], row[close], column[close], found[close]

    back_u, back_v, back_z = _Warp.between(other, camera).apply(x[open_], y[open_], found)
    close = (back_z > 0) & (np.hypot(back_u - u[open_], back_v - v[open_]) <= criteria.pixels)
    turn = camera.cam_from_world.rotation @ other.cam_from_world.rotation.T
    own, there = made.normal[at[0][open_], at[1][open_]], theirs.normal[row, column] @ turn.T.astype(np.float32)
    close &= np.einsum("ni,ni->n", own, there) >= np.cos(np.radians(criteria.normal_deg))
    return Confirmed(open_[close], back_z[close])


def depths_beside(
    camera: Camera, made: DepthMap, row: NDArray[np.int64], column: NDArray[np.int64], u: FloatArray, v: FloatArray
) -> FloatArray:
    """Depths (N,) of a map at coordinates between the centres of its pixels: on the plane of the pixel."""
    k, (a, b, c) = camera.intrinsics, made.normal[row, column].T.astype(np.float64)
    centre = a * ((column + 0.5 - k.cx) / k.fx) + b * ((row + 0.5 - k.cy) / k.fy) + c
    with np.errstate(divide="ignore", invalid="ignore"):
        slope = centre / (a * ((u - k.cx) / k.fx) + b * ((v - k.cy) / k.fy) + c)
    steep = ~((slope < _MAX_SLOPE) & (slope > 1 / _MAX_SLOPE))
    found: FloatArray = made.depth[row, column].astype(np.float64) * np.where(steep, 1.0, slope)
    return found


def world_points(camera: Camera, pixels: FloatArray, depth: NDArray[np.float32] | FloatArray) -> FloatArray:
    """Points (N, 3) in the world at pixel coordinates (N, 2) of a camera and z-depths (N,)."""
    local = camera.intrinsics.directions(pixels) * np.asarray(depth, dtype=np.float64)[:, None]
    points: FloatArray = (local - camera.cam_from_world.translation) @ camera.cam_from_world.rotation
    return points
