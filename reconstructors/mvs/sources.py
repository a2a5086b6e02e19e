"""Which images a reference is matched with, and between which depths."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from pcbench.errors import ReconstructionError
from pcbench.geometry.arrays import FloatArray, IntArray
from pcbench.geometry.cameras import Camera
from pcbench.geometry.visibility import in_frame
from reconstructors.mvs.sparse import Sparse

_MIN_POINTS = 30  # of an image; with fewer, those count too that lie in its frame and other images show
_MIN_SHARED = 5  # points that two images have to share at an angle that tells depths
# Degrees between the lines of sight. Below the first depths are uncertain, below the least a map would be noise; above
# the last the images look too different to be matched.
_LEAST_DEG, _GOOD_DEG, _WIDE_DEG, _FALL_DEG = 1.0, 10.0, 30.0, 15.0
_BEST = 4  # sources whose angles are told
_MARGIN = 0.25  # of the nearest and the farthest depth, as COLMAP's
_TAIL = 0.01  # of the points at each end: some are wrong


class MatchedImage(NamedTuple):
    """What one image is matched with.

    Args:
        name: of the image.
        sources: names of the others, the best first.
        depths: nearest and farthest.
        median_depth: of its points.
        angle_deg: median over its points of the angle at which the best four sources see them.
    """

    name: str
    sources: tuple[str, ...]
    depths: tuple[float, float]
    median_depth: float
    angle_deg: float


def choose_references(sparse: Sparse, most: int) -> tuple[list[MatchedImage], list[str]]:
    """What each image is matched with, at most `most` sources; and the names of the images that share too little.

    The sources are chosen one after the other, each for the points that it shows at a good angle and that those before
    it leave uncertain: from one side alone, what is hidden there would be hidden from all. Those that share features
    come first, those whose frames alone have the points after them.

    Raises:
        ReconstructionError: no image has a source.
    """
    found, alone = [], []
    for name in sparse.names:
        reference = _choose(sparse, name, most)
        if reference is None:
            alone.append(name)
        else:
            found.append(reference)
    if not found:
        raise ReconstructionError(_why_alone(sparse))
    return found, alone


def _choose(sparse: Sparse, name: str, most: int) -> MatchedImage | None:
    camera = sparse.cameras[name]
    numbers = sparse.shown(name)
    by_frame = len(numbers) < _MIN_POINTS
    if by_frame:
        numbers = np.flatnonzero(in_frame(camera, sparse.points)).astype(np.int64)
    points = sparse.points[numbers]
    depths = camera.cam_from_world.apply(points)[:, 2]
    numbers, points, depths = numbers[depths > 0], points[depths > 0], depths[depths > 0]
    others = [other for other in sparse.names if other != name]
    if not len(points) or not others:
        return None
    angles = np.stack([angles_deg(camera, sparse.cameras[other], points) for other in others])
    weights = angle_weights(angles) * _sharpness(camera, [sparse.cameras[other] for other in others], points)
    chosen = list[int]()
    if not by_frame:
        chosen = _greedy(weights * _shown_by(sparse, others, numbers), most, chosen)
    # Features are not found again from everywhere a surface is seen from.
    weights *= np.stack([in_frame(sparse.cameras[other], points) for other in others])
    chosen = _greedy(weights, most, chosen)
    if not chosen:
        return None
    best = chosen[:_BEST]
    seen = np.where(weights[best] > 0, angles[best], np.nan)
    # One point at each end at least is left out.
    near = np.quantile(depths, _TAIL, method="higher")
    far = np.quantile(depths, 1 - _TAIL, method="lower")
    return MatchedImage(
        name,
        tuple(others[k] for k in chosen),
        (float((1 - _MARGIN) * near), float((1 + _MARGIN) * far)),
        float(np.median(depths)),
        float(np.nanmedian(seen)),
    )


def angles_deg(a: Camera, b: Camera, points: FloatArray) -> FloatArray:
    """Between the lines of sight of two cameras at points (N, 3), in degrees (N,)."""
    u, v = a.position - points, b.position - points
    across = np.linalg.norm(np.cross(u, v), axis=1)
    angles: FloatArray = np.degrees(np.arctan2(across, np.einsum("ni,ni->n", u, v)))
    return angles


def angle_weights(degrees: FloatArray) -> FloatArray:
    """From 0 to 1, how well images at such angles tell depths and can still be matched."""
    narrow = np.clip(degrees / _GOOD_DEG, 0, 1) ** 2
    wide = np.exp(-0.5 * (np.maximum(degrees - _WIDE_DEG, 0) / _FALL_DEG) ** 2)
    weights: FloatArray = np.where(degrees < _LEAST_DEG, 0.0, narrow * wide)
    return weights


def _sharpness(camera: Camera, others: Sequence[Camera], points: FloatArray) -> FloatArray:
    """(others, N): the pixel of the reference over that of another at points, at most 1: one that stands further off
    shows less.
    """
    sizes = [c.cam_from_world.apply(points)[:, 2] / c.intrinsics.fx for c in (camera, *others)]
    own = np.stack(sizes[1:])
    with np.errstate(divide="ignore"):
        ratio: FloatArray = np.where(own > 0, np.minimum(1.0, sizes[0] / own), 0.0)
    return ratio


def _shown_by(sparse: Sparse, others: Sequence[str], numbers: IntArray) -> FloatArray:
    """(others, N): 1 where a feature of another image is of the point."""
    columns = [sparse.names.index(other) for other in others]
    shown: FloatArray = sparse.shows[numbers][:, columns].toarray().T.astype(np.float64)
    return shown


def _greedy(weights: FloatArray, most: int, before: Sequence[int]) -> list[int]:
    """Rows of `weights` (others, N) after those `before`, one after the other: each gains a point's weight over what
    the rows before it gave to that point.
    """
    chosen = list(before)
    covered = 1 + weights[chosen].sum(axis=0)
    enough = (weights > 0).sum(axis=1) >= min(_MIN_SHARED, weights.shape[1])
    while len(chosen) < most:
        gains = (weights / covered).sum(axis=1)
        gains[~enough] = 0
        gains[chosen] = 0
        best = int(np.argmax(gains))
        if not gains[best] > 0:
            break
        chosen.append(best)
        covered += weights[best]
    return chosen


def _why_alone(sparse: Sparse) -> str:
    """Why no image has a source."""
    if not len(sparse.points):
        return "no overlap: no point is shown by three images: take more images with more overlap, or give cameras"
    positions = np.stack([camera.position for camera in sparse.cameras.values()])
    spread = float(np.linalg.norm(positions - positions.mean(axis=0), axis=1).max())
    distance = float(np.median(np.linalg.norm(sparse.points - positions.mean(axis=0), axis=1)))
    if spread < np.radians(_LEAST_DEG) * distance:
        return (
            f"degenerate baselines: the cameras stand within {spread:.3g} of one place, and what they look at is"
            f" {distance:.3g} away: depths need images from different places"
        )
    return "no overlap: no two images share points at an angle that tells depths: take images closer to each other"
