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

from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.cameras import Camera
from reconstructors.mvs.maps import DepthMap

_BLOCK = 1 << 17  # pixels at a time: what lies between map and map is twenty numbers each in float64
_MAX_SLOPE = 1.05  # of depths on the plane of a pixel half a pixel beside its centre: steeper ones are guessed


@dataclass(frozen=True)
class Criteria:
    """What a depth has to be to be kept.

    Args:
        confidence: at least.
        views: images that have to agree, the reference counted.
        pixels: there and back, at most.
        depth: relative difference of the depths, at most.
        normal_deg: between the normals, at most.
    """

    confidence: float = 0.3
    views: int = 3
    pixels: float = 1.5
    depth: float = 0.01
    normal_deg: float = 30.0


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
        confident = map_.where(map_.confidence >= criteria.confidence)
        rows, columns = np.nonzero(asked)
        for start in range(0, len(rows), _BLOCK):
            at = (rows[start : start + _BLOCK], columns[start : start + _BLOCK])
            agree[k][at] = _agrees(camera, made, at, other, confident, criteria)
    kept = asked & (1 + agree.sum(axis=0) >= criteria.views)
    return Filtered(made.where(kept), agree & kept)


def _agrees(
    camera: Camera,
    made: DepthMap,
    at: tuple[NDArray[np.int64], NDArray[np.int64]],
    other: Camera,
    theirs: DepthMap,
    criteria: Criteria,
) -> NDArray[np.bool_]:
    """Which pixels (rows, columns) of a map another one confirms."""
    pixels = np.stack([at[1] + 0.5, at[0] + 0.5], axis=1)
    points = world_points(camera, pixels, made.depth[at])
    there, depth = other.project(points)
    height, width = theirs.depth.shape
    with np.errstate(invalid="ignore"):
        column, row = (np.floor(np.nan_to_num(there, nan=-1.0).clip(-1, 1 << 20))).astype(np.int64).T
    inside = (depth > 0) & (row >= 0) & (row < height) & (column >= 0) & (column < width)
    row, column = np.where(inside, row, 0), np.where(inside, column, 0)
    inside &= theirs.depth[row, column] > 0

    found = _depth_beside(other, theirs, row, column, np.where(inside[:, None], there, 0.5))
    back, depth_back = camera.project(world_points(other, np.where(inside[:, None], there, 0.5), found))
    close = inside & (depth_back > 0)
    close &= np.abs(found - depth) <= criteria.depth * depth
    with np.errstate(invalid="ignore"):
        close &= np.linalg.norm(back - pixels, axis=1) <= criteria.pixels
    turn = camera.cam_from_world.rotation @ other.cam_from_world.rotation.T
    cosine = np.einsum("ni,ni->n", made.normal[at], theirs.normal[row, column] @ turn.T)
    result: NDArray[np.bool_] = close & (cosine >= np.cos(np.radians(criteria.normal_deg)))
    return result


def _depth_beside(
    camera: Camera, made: DepthMap, row: NDArray[np.int64], column: NDArray[np.int64], at: FloatArray
) -> FloatArray:
    """Depths (N,) of a map between the centres of its pixels, at coordinates (N, 2): on the plane of the pixel."""
    k = camera.intrinsics
    depth, normal = made.depth[row, column].astype(np.float64), made.normal[row, column]
    centre = k.directions(np.stack([column + 0.5, row + 0.5], axis=1))
    with np.errstate(divide="ignore", invalid="ignore"):
        slope = np.einsum("ni,ni->n", normal, centre) / np.einsum("ni,ni->n", normal, k.directions(at))
    steep = ~((slope < _MAX_SLOPE) & (slope > 1 / _MAX_SLOPE))
    found: FloatArray = depth * np.where(steep, 1.0, slope)
    return found


def world_points(camera: Camera, pixels: FloatArray, depth: NDArray[np.float32] | FloatArray) -> FloatArray:
    """Points (N, 3) in the world at pixel coordinates (N, 2) of a camera and z-depths (N,)."""
    local = camera.intrinsics.directions(pixels) * np.asarray(depth, dtype=np.float64)[:, None]
    points: FloatArray = (local - camera.cam_from_world.translation) @ camera.cam_from_world.rotation
    return points
