"""Clouds of a model of Gaussians: their centres, and the surface that its images show.

Centres are what Gao et al. take for a densified cloud. They are not on the surface: nothing but the images holds them,
and those are as good with a Gaussian behind the surface or before it. The surface is where the light of a ray ends
(plane depth, Zhang et al. 2024, RaDe-GS; the median along the ray, Huang et al. 2024, 2DGS), where the maps of several
cameras agree on it (as COLMAP's are filtered, Schonberger et al. 2016).
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from pcbench.errors import InputError, ReconstructionError
from pcbench.geometry.arrays import FloatArray, IntArray
from pcbench.geometry.cameras import Camera
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.neighbors import Index
from pcbench.geometry.normals import estimate_normals
from pcbench.geometry.splats import check_limits, spread
from pcbench.plugins.progress import with_time_left
from reconstructors.mvs.filter import Criteria, confirmed, world_points
from reconstructors.mvs.sources import MatchedImage
from reconstructors.splat.depths import Depths, overlap
from reconstructors.splat.model import SH_DC, Gaussians, LocalFrame
from reconstructors.splat.rotations import rotated
from reconstructors.splat.voxels import Points, Voxels, joined

_CONFIRMING = 12  # images whose maps may confirm a depth
_BLOCK = 1 << 16  # pixels at a time
# With so many images that agree, or all that might, a depth is as sure as its pixel. The fewer, the more often they
# agree by chance on what is not there: errors on cities grow as about this power of the ratio.
_SURE, _POWER = 6, 3
_NEIGHBOURS = 30  # that a normal is of
# Uncertain depths are taken too: they count where there are no others.
AGREEMENT = Criteria(confidence=0.0, views=3, pixels=1.5, depth=0.01, normal_deg=60.0)


def means(
    gaussians: Gaussians, frame: LocalFrame, *, min_opacity: float | None = None, max_axis: float | None = None
) -> Cloud:
    """The centres of the Gaussians, with the color that they have from everywhere, their opacity and largest axis, and
    the directions of their shortest axes, upwards, as normals.

    Args:
        min_opacity: only those of at least this opacity, 0 to 1.
        max_axis: only those whose largest standard deviation is at most so long, in the world's unit.

    Raises:
        InputError: a limit cannot be, or no Gaussian is left.
    """
    import torch

    check_limits(min_opacity, max_axis)
    scales = gaussians.scales.detach().cpu()
    opacities = gaussians.opacities.detach().cpu().numpy()
    largest = scales.max(dim=1).values.numpy().astype(np.float64) * frame.unit
    keep = np.isfinite(largest)
    if min_opacity is not None:
        keep &= opacities >= min_opacity
    if max_axis is not None:
        keep &= largest <= max_axis
    if not keep.any():
        raise InputError(
            f"none of {len(gaussians)} Gaussians is left: opacities are {spread(opacities)}, largest axes"
            f" {spread(largest)}"
        )
    axis = torch.zeros_like(scales).scatter_(1, scales.argmin(dim=1, keepdim=True), 1.0)
    normals = rotated(gaussians.quats.detach().cpu(), axis).numpy().astype(np.float64)[keep]
    colors = (255 * (0.5 + SH_DC * gaussians.sh[:, 0].detach().cpu().numpy()[keep]).clip(0, 1)).round()
    return Cloud(
        frame.to_world(gaussians.means.detach().cpu().numpy()[keep]),
        np.where(normals[:, 2:] < 0, -normals, normals),
        colors.astype(np.uint8),
        {"opacity": opacities[keep], "largest_axis": largest[keep].astype(np.float32)},
    )


def surface(
    gaussians: Gaussians,
    frame: LocalFrame,
    cameras: Mapping[str, Camera],
    *,
    criteria: Criteria = AGREEMENT,
    voxel: float | None = None,
) -> Cloud:
    """The surface that cameras see, with normals, colors as drawn, `confidence` (0 to 1) and `views` (the number of
    images that agree on a point).

    Each camera's depths are drawn; those that enough others confirm become points: at the median of the depths that
    agree, in float64. Their uncertainty is the footprint of the pixel and how far the mean depth along the ray is from
    the median, together, and more where fewer than six images agree (fewer than all, where there are not six). The
    points of all cameras are averaged in voxels of that size, by its inverse square.

    Args:
        cameras: pinholes in the world by image name.
        criteria: what of a map is kept.
        voxel: edge of the smallest voxels, in the world's unit; by default the median footprint of a pixel.

    Raises:
        InputError: a camera has distortion, there are too few, or the voxel is no length.
        ReconstructionError: no depth is confirmed.
    """
    if len(cameras) < criteria.views:
        raise InputError(f"expected at least {criteria.views} cameras, which have to agree, got {len(cameras)}")
    if voxel is not None and not (np.isfinite(voxel) and voxel > 0):
        raise InputError(f"expected a positive edge of a voxel, got {voxel}")
    depths = Depths(gaussians, frame, cameras, _CONFIRMING)
    found = overlap(gaussians, depths, _CONFIRMING)
    voxels = Voxels(found.footprint if voxel is None else voxel / frame.unit)
    kept = 0
    for reference in with_time_left(found.references, "surface"):
        points, uncertainty = _confirmed_points(depths, reference, criteria)
        kept += len(points.views)
        if len(points.views):
            voxels.add(points, uncertainty**-2, uncertainty)
    if not kept:
        raise ReconstructionError(
            f"no surface: no depth is seen alike by {criteria.views} images: train for longer, check the cameras, or"
            " take the means of the Gaussians (cloud=means)"
        )
    points = voxels.fused()
    return Cloud(
        frame.to_world(points.points),
        _smooth_normals(points),
        points.colors.round().astype(np.uint8),
        {"confidence": points.confidence.astype(np.float32), "views": points.views.astype(np.int32)},
    )


def _smooth_normals(points: Points) -> FloatArray:
    """Of planes through the neighbours, on the side from which the surface is seen: half as wrong on cities as the
    mean axes of the Gaussians, which nothing holds.
    """
    if len(points.points) < _NEIGHBOURS:
        return points.normals
    normals = estimate_normals(Index(points.points), _NEIGHBOURS).directions
    away = np.einsum("ni,ni->n", normals, points.normals) < 0
    turned: FloatArray = np.where(away[:, None], -normals, normals)
    return turned


def _confirmed_points(depths: Depths, reference: MatchedImage, criteria: Criteria) -> tuple[Points, FloatArray]:
    """What a camera sees and enough others confirm, in the local frame, and how uncertain (N,) it is."""
    camera, seen = depths.cameras[reference.name], depths.of(reference.name)
    made = seen.made
    rows, columns = np.nonzero(made.known & (made.confidence >= criteria.confidence))
    others = [(depths.cameras[name], depths.of(name).made) for name in reference.sources]
    parts: list[Points] = []
    unsure: list[FloatArray] = []
    for start in range(0, len(rows), _BLOCK):
        at = (rows[start : start + _BLOCK], columns[start : start + _BLOCK])
        along = np.full((1 + len(others), len(at[0])), np.nan)
        along[0] = made.depth[at]
        for k, (other, theirs) in enumerate(others, start=1):
            which, found = confirmed(camera, made, at, other, theirs, criteria)
            along[k, which] = found
        views = np.isfinite(along).sum(axis=0)
        enough = views >= criteria.views
        at = (at[0][enough], at[1][enough])
        pixels = np.stack([at[1] + 0.5, at[0] + 0.5], axis=1)
        footprint = made.depth[at].astype(np.float64) / camera.intrinsics.fx
        unsure.append(_uncertainty(footprint, seen.apart[at].astype(np.float64), views[enough], len(along)))
        parts.append(
            Points(
                world_points(camera, pixels, _medians(along[:, enough])),
                made.normal[at].astype(np.float64) @ camera.cam_from_world.rotation,
                seen.colors[at].astype(np.float64),
                made.confidence[at].astype(np.float64),
                views[enough],
            )
        )
    return joined(parts), np.concatenate(unsure) if unsure else np.empty(0)


def _uncertainty(footprint: FloatArray, apart: FloatArray, views: IntArray, most: int) -> FloatArray:
    """Of depths (N,), a length, by the pixels' footprints, by how far mean and median depth are apart, and by how many
    images agree of those that might.
    """
    missing = np.maximum(1, min(_SURE, most) / views)
    uncertainty: FloatArray = np.hypot(footprint, apart) * missing**_POWER
    return uncertainty


def _medians(along: FloatArray) -> FloatArray:
    """Of each column's numbers (K, N) that are known."""
    ordered, count = np.sort(along, axis=0), np.isfinite(along).sum(axis=0)  # NaN comes last
    each = np.arange(along.shape[1])
    middle: FloatArray = (ordered[(count - 1) // 2, each] + ordered[count // 2, each]) / 2
    return middle
