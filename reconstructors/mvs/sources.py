"""Choice of the source images and the depth range of each reference image."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from pcbench.errors import ReconstructionError
from pcbench.geometry.arrays import FloatArray, IntArray
from pcbench.geometry.cameras import Camera
from pcbench.geometry.visibility import in_frame
from reconstructors.mvs.frusta import MIN_ANGLE_DEG, ROUNDING, angle_weights, angles_deg, sample_common_volume
from reconstructors.mvs.sparse import SparseModel

# Points that an image observes; with fewer, all points in its frame count. Models with fewer points are not used.
MIN_POINTS = 30
_MIN_SHARED_POINTS = 5  # points that two images must share at a useful angle
_MAX_ANGLE_SOURCES = 4  # sources whose angles are reported
_DEPTH_MARGIN = 0.25  # share added beyond the nearest and the farthest depth, as COLMAP does
_DEPTH_TAIL_SHARE = 0.01  # share of the depths ignored at each end, because some are wrong


class MatchedImage(NamedTuple):
    """A reference image with its sources and its depth range.

    Args:
        name: name of the reference image.
        sources: names of the source images, the best first.
        depths: smallest and largest depth.
        median_depth: median depth of its points.
        angle_deg: median triangulation angle of its points with the best four sources.
    """

    name: str
    sources: tuple[str, ...]
    depths: tuple[float, float]
    median_depth: float
    angle_deg: float


def choose_references(sparse: SparseModel, max_sources: int) -> tuple[list[MatchedImage], list[str]]:
    """Choose the sources of each image; return the references and the names of the images without sources.

    Sources are chosen greedily: each gains most for points that it observes at a good angle and that the sources before
    it leave uncertain. Otherwise all sources could lie on one side, where the same surface is hidden from all of them.
    Images that share features come first, then images whose frames only contain the points. Without points, the
    viewing volumes of neighbouring cameras determine the sources and the depth range.

    Args:
        sparse: cameras and sparse points.
        max_sources: maximum number of sources per image.

    Raises:
        ReconstructionError: no image has a source.
    """
    references, isolated = [], []
    for name in sparse.names:
        reference = _choose_sources(sparse, name, max_sources)
        if reference is None:
            isolated.append(name)
        else:
            references.append(reference)
    if not references:
        raise ReconstructionError(_explain_no_sources(sparse))
    return references, isolated


def _choose_sources(sparse: SparseModel, name: str, max_sources: int) -> MatchedImage | None:
    camera = sparse.cameras[name]
    indices = sparse.observed_points(name)
    by_frame = len(indices) < MIN_POINTS
    if by_frame:
        indices = np.flatnonzero(in_frame(camera, sparse.points)).astype(np.int64)
    points = sparse.points[indices]
    others = [other for other in sparse.names if other != name]
    if len(sparse.points) < MIN_POINTS:
        points = sample_common_volume(camera, [sparse.cameras[other] for other in others])
    depths = camera.cam_from_world.apply(points)[:, 2]
    in_front = depths > 0
    points, depths = points[in_front], depths[in_front]
    if not len(points):
        return None
    angles = np.stack([angles_deg(camera, sparse.cameras[other], points) for other in others])
    weights = angle_weights(angles) * _relative_resolution(camera, [sparse.cameras[other] for other in others], points)
    chosen = list[int]()
    if not by_frame:
        chosen = _choose_greedily(weights * _observations(sparse, others, indices[in_front]), max_sources, chosen)
    # A surface is visible from more images than those in which its features are matched.
    weights *= np.stack([in_frame(sparse.cameras[other], points) for other in others])
    chosen = _choose_greedily(weights, max_sources, chosen)
    if not chosen:
        return None
    best = chosen[:_MAX_ANGLE_SOURCES]
    source_angles = np.where(weights[best] > 0, angles[best], np.nan)
    # "higher" and "lower" ignore at least one point at each end.
    near = np.quantile(depths, _DEPTH_TAIL_SHARE, method="higher")
    far = np.quantile(depths, 1 - _DEPTH_TAIL_SHARE, method="lower")
    return MatchedImage(
        name,
        tuple(others[k] for k in chosen),
        (float((1 - _DEPTH_MARGIN) * near), float((1 + _DEPTH_MARGIN) * far)),
        float(np.median(depths)),
        float(np.nanmedian(source_angles)),
    )


def _relative_resolution(camera: Camera, others: Sequence[Camera], points: FloatArray) -> FloatArray:
    """Return (others, N), at most 1: the reference's pixel size at the points over the other image's."""
    sizes = [c.cam_from_world.apply(points)[:, 2] / c.intrinsics.fx for c in (camera, *others)]
    other_sizes = np.stack(sizes[1:])
    with np.errstate(divide="ignore"):
        ratio: FloatArray = np.where(other_sizes > 0, np.minimum(1.0, sizes[0] / other_sizes), 0.0)
    return ratio


def _observations(sparse: SparseModel, others: Sequence[str], indices: IntArray) -> FloatArray:
    """Return (others, N): 1 if another image has a feature of the point."""
    columns = [sparse.names.index(other) for other in others]
    observed: FloatArray = sparse.visibility[indices][:, columns].toarray().T.astype(np.float64)
    return observed


def _choose_greedily(weights: FloatArray, max_count: int, initial: Sequence[int]) -> list[int]:
    """Extend the `initial` rows of `weights` (others, N) one by one, up to `max_count` rows.

    A row's gain is the sum over the points of its weight, divided by one plus the weights of the rows before it.
    """
    chosen = list(initial)
    covered = 1 + weights[chosen].sum(axis=0)
    enough = (weights > 0).sum(axis=1) >= min(_MIN_SHARED_POINTS, weights.shape[1])
    while len(chosen) < max_count:
        gains = (weights / covered).sum(axis=1)
        gains[~enough] = 0
        gains[chosen] = 0
        best = int(np.argmax(gains))
        if not gains[best] > 0:
            break
        chosen.append(best)
        covered += weights[best]
    return chosen


def _explain_no_sources(sparse: SparseModel) -> str:
    """Explain why no image has a source."""
    positions = np.stack([camera.position for camera in sparse.cameras.values()])
    spread = float(np.linalg.norm(positions - positions.mean(axis=0), axis=1).max())
    if not len(sparse.points):
        if spread <= ROUNDING * float(np.linalg.norm(positions, axis=1).max()):
            return "degenerate baselines: all cameras are at one position; take images from different positions"
        return (
            "no overlap: no two images share features, and the viewing volumes of no two cameras meet at an angle of"
            f" {MIN_ANGLE_DEG:g} degree or more; check the cameras, or take images with more overlap"
        )
    distance = float(np.median(np.linalg.norm(sparse.points - positions.mean(axis=0), axis=1)))
    if spread < np.radians(MIN_ANGLE_DEG) * distance:
        return (
            f"degenerate baselines: the cameras lie within {spread:.3g} of one position, and the scene is"
            f" {distance:.3g} away; take images from more distant positions"
        )
    return "no overlap: no two images share points at a sufficient angle; take images with more overlap"
