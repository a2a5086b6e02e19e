"""Which way is up in a model whose frame is arbitrary, as far as its cameras tell.

People and most rigs hold a camera so that the rows of its images are horizontal, however it is pitched: up is
orthogonal to the x axes of all cameras. A consensus finds it where fewer than half of the images are rolled.
Photographs that were all turned by a quarter have horizontal columns instead. In a survey whose images all look the
same way neither says anything. There up is against the mean viewing direction, if the cameras stand in a plane across
it, as they do above the ground.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.cameras import Camera
from pcbench.geometry.transform import Similarity

_MAX_ROLL_DEG = 12.0  # of an image whose rows count as horizontal: hand-held ones are off by a few
_MIN_YAW_DEG = 5.0  # RMS of the axes off their main direction: below, they hardly span the horizontal plane
_MIN_SPREAD_RATIO = 2.0  # of that RMS to the RMS roll: below, the axes lie in no plane
_MAX_STANDARD_ERROR_DEG = 5.0  # of up, predicted from rolls and yaws
_MIN_CAMERAS = 3  # two always have a direction orthogonal to both
_MAX_PAIRED = 48  # cameras whose pairs are tried: 1,128 directions
_MIN_SIGN = 0.1  # mean cosine to up, of the images' upper sides or against the views, that decides which end is up
_MAX_NADIR_DEG = 20.0  # between a view and the mean view of a survey, and between that and the cameras' plane
_MIN_WIDTH_RATIO = 0.1  # of a survey's block to its length: of a single strip the plane is not known


class _Horizon(NamedTuple):
    """A direction orthogonal to the axes of most cameras, which of them these are, and their RMS roll in degrees."""

    normal: FloatArray
    agrees: NDArray[np.bool_]
    roll_deg: float


def level(cameras: Mapping[str, Camera]) -> tuple[Similarity | None, str]:
    """The rotation about the origin that makes +z up, and a note that says how up was found.

    Returns:
        None and the reason where the cameras do not tell what is up.
    """
    up, how = _find_up(cameras)
    if up is None:
        return None, f"not levelled, z is not up: {how}"
    turn = Similarity(_rotation_to_z(up), np.zeros(3))
    return turn, f"levelled, +z is up: {how}; origin and scale are as they were solved"


def _find_up(cameras: Mapping[str, Camera]) -> tuple[FloatArray | None, str]:
    if len(cameras) < _MIN_CAMERAS:
        return None, f"{len(cameras)} cameras are too few to tell what is"
    axes = np.stack([camera.cam_from_world.rotation for camera in cameras.values()])
    right, down, forward = axes[:, 0], axes[:, 1], axes[:, 2]
    if (rows := _horizon(right)) is not None:
        # Of images that look straight down no side is the upper one.
        sign = _sign(-down[rows.agrees], rows.normal) or _sign(-forward[rows.agrees], rows.normal)
        if sign:
            return sign * rows.normal, _words("rows", rows)
        return None, "as many photographs are upside down as are upright"
    if (columns := _horizon(down)) is not None:
        if sign := _sign(-forward[columns.agrees], columns.normal):
            return sign * columns.normal, f"{_words('columns', columns)}, as of turned photographs that look down"
        return None, "most photographs are turned by a quarter, and it is not known to which side"
    return _against_view(forward, np.stack([camera.position for camera in cameras.values()]))


def _horizon(axes: FloatArray) -> _Horizon | None:
    """The direction orthogonal to most unit axes (N, 3); None where there is none, or many."""
    normal = _consensus(axes)
    if normal is None:
        return None
    limit = np.sin(np.radians(_MAX_ROLL_DEG))
    for _ in range(10):
        agrees = np.abs(_dots(axes, normal)) < limit
        if agrees.sum() < max(_MIN_CAMERAS, len(axes) // 2 + 1):
            return None
        scatter = np.einsum("ni,nj->ij", axes[agrees], axes[agrees]) / agrees.sum()
        squares, directions = np.linalg.eigh(scatter)
        normal = directions[:, 0]
    roll, yaw = np.sqrt(np.maximum(squares[:2], 0))
    error = roll / (yaw * np.sqrt(agrees.sum())) if yaw > 0 else np.inf
    if yaw < max(np.sin(np.radians(_MIN_YAW_DEG)), _MIN_SPREAD_RATIO * roll):
        return None
    if error > np.tan(np.radians(_MAX_STANDARD_ERROR_DEG)):
        return None
    return _Horizon(normal, agrees, float(np.degrees(roll)))


def _consensus(axes: FloatArray) -> FloatArray | None:
    """Of the directions orthogonal to two of the axes (N, 3), the one that is nearest to orthogonal to all; an axis
    that is off by more than the limit counts as off by the limit.
    """
    some = axes[np.unique(np.linspace(0, len(axes) - 1, min(len(axes), _MAX_PAIRED)).round().astype(int))]
    first, second = np.triu_indices(len(some), 1)
    normals = np.cross(some[first], some[second])
    lengths = np.linalg.norm(normals, axis=1)
    usable = lengths > np.sin(np.radians(_MIN_YAW_DEG))
    if not usable.any():
        return None
    normals = normals[usable] / lengths[usable, None]
    limit = np.sin(np.radians(_MAX_ROLL_DEG)) ** 2
    costs = [float(np.minimum(np.square(_dots(axes, normal)), limit).sum()) for normal in normals]
    best: FloatArray = normals[int(np.argmin(costs))]
    return best


def _against_view(forward: FloatArray, positions: FloatArray) -> tuple[FloatArray | None, str]:
    """Up of images that all look straight down, as far as their positions (N, 3) agree."""
    mean = forward.mean(axis=0)
    mean /= max(float(np.linalg.norm(mean)), 1e-12)
    limit = np.cos(np.radians(_MAX_NADIR_DEG))
    if np.median(_dots(forward, mean)) < limit:
        return None, "the photographs are rolled and look every way"
    offsets = positions - positions.mean(axis=0)
    squares, directions = np.linalg.eigh(np.einsum("ni,nj->ij", offsets, offsets))
    if squares[1] < _MIN_WIDTH_RATIO**2 * squares[2]:
        return None, "the photographs all look one way from along a line: this may be a strip from above or a facade"
    apart = float(np.degrees(np.arccos(min(abs(float(_dots(mean[None], directions[:, 0])[0])), 1.0))))
    if apart > _MAX_NADIR_DEG:
        return None, "the photographs all look one way, and their places do not tell whether it is down"
    return -mean, (
        f"against the mean viewing direction of {len(forward)} cameras, taken to look straight down (the plane of their"
        f" places is across it within {apart:.1f} degrees)"
    )


def _sign(ups: FloatArray, normal: FloatArray) -> int:
    """Which end of a direction is up by the mean of some directions (N, 3) that are: 1, -1, or 0 for neither."""
    mean = float(_dots(ups, normal).mean())
    return 0 if abs(mean) < _MIN_SIGN else 1 if mean > 0 else -1


def _words(what: str, horizon: _Horizon) -> str:
    return (
        f"the image {what} of {int(horizon.agrees.sum())} of {len(horizon.agrees)} cameras are horizontal within"
        f" {horizon.roll_deg:.1f} degrees RMS"
    )


def _dots(vectors: FloatArray, direction: FloatArray) -> FloatArray:
    dots: FloatArray = np.einsum("ni,i->n", vectors, direction)
    return dots


def _rotation_to_z(up: FloatArray) -> FloatArray:
    """The smallest rotation (3, 3) that turns a unit vector to +z (Rodrigues)."""
    x, y, z = up
    if z < -1 + 1e-12:
        return np.diag([1.0, -1.0, -1.0])
    cross = np.array([[0.0, 0.0, -x], [0.0, 0.0, -y], [x, y, 0.0]])
    rotation: FloatArray = np.eye(3) + cross + cross @ cross / (1 + z)
    return rotation
