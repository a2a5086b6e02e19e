"""Point clouds of a model of Gaussians: the means, and the surface that its images show.

Gao et al. use the means as a densified cloud. The means are not on the surface: only the images constrain them, and an
image hardly distinguishes a Gaussian on the surface from one behind or before it. The surface is the median depth along
the ray (Huang et al. 2024, 2DGS; plane depth of Zhang et al. 2024, RaDe-GS), kept where the depth maps of several
cameras agree (the filter of COLMAP, Schonberger et al. 2016).
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
from reconstructors.mvs.cells import SPACE, SpaceCell
from reconstructors.mvs.filter import Criteria, confirm, world_points
from reconstructors.mvs.sources import MatchedImage
from reconstructors.splat.depths import RenderedMaps, SurfaceModel, find_overlap
from reconstructors.splat.model import SH_DC, Gaussians, LocalFrame
from reconstructors.splat.rotations import rotate
from reconstructors.splat.voxels import Points, Voxels, concatenate_points

_MAX_CONFIRMING_VIEWS = 12  # images whose maps may confirm a depth
_BLOCK_PIXELS = 1 << 18  # pixels processed at a time
# If this many images agree (or all that may see the point, if fewer), the uncertainty of a depth is that of its pixel.
# With fewer, chance agreement on wrong depths is more frequent: errors on synthetic cities grow with about this power
# of the ratio.
_FULL_CONFIRMATION_VIEWS, _UNCERTAINTY_POWER = 6, 3
_NORMAL_NEIGHBORS = 30  # points through which the plane of a normal is fitted
# Depths of low confidence are kept: they count where there are no others.
SURFACE_CRITERIA = Criteria(confidence=0.0, views=3, pixels=1.5, depth=0.01, normal_deg=60.0)


def means(
    gaussians: Gaussians, frame: LocalFrame, *, min_opacity: float | None = None, max_axis: float | None = None
) -> Cloud:
    """Return the means of the Gaussians as a cloud.

    Colors are those of the spherical harmonics of degree 0, normals the shortest axes, turned upwards. The cloud has
    the attributes `opacity` and `largest_axis`.

    Args:
        gaussians: the model.
        frame: its frame.
        min_opacity: least opacity, 0 to 1.
        max_axis: maximum of the largest standard deviation, in the world's unit.

    Raises:
        InputError: a limit is out of range, or no Gaussian is left.
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
            f" {spread(largest)}; relax the limits"
        )
    axis = torch.zeros_like(scales).scatter_(1, scales.argmin(dim=1, keepdim=True), 1.0)
    normals = rotate(gaussians.quats.detach().cpu(), axis).numpy().astype(np.float64)[keep]
    colors = (255 * (0.5 + SH_DC * gaussians.sh[:, 0].detach().cpu().numpy()[keep]).clip(0, 1)).round()
    return Cloud(
        frame.to_world(gaussians.means.detach().cpu().numpy()[keep]),
        np.where(normals[:, 2:] < 0, -normals, normals),
        colors.astype(np.uint8),
        {"opacity": opacities[keep], "largest_axis": largest[keep].astype(np.float32)},
    )


def surface(
    model: SurfaceModel,
    frame: LocalFrame,
    cameras: Mapping[str, Camera],
    *,
    criteria: Criteria = SURFACE_CRITERIA,
    voxel: float | None = None,
    cell: SpaceCell = SPACE,
) -> Cloud:
    """Return the surface that the cameras see, as a cloud with normals, colors, `confidence` and `views`.

    Each camera's depth map is rendered. A depth that enough other maps confirm becomes a point, at the median of the
    depths that agree, in float64. Its uncertainty combines the footprint of the pixel and the difference of mean and
    median depth along the ray, and grows if fewer than six images agree (fewer than all, if fewer than six may see the
    point). The points of all cameras are averaged in voxels of the size of their uncertainty, weighted by its inverse
    square.

    `confidence` is between 0 and 1, `views` is the number of images that agree on a point.

    Args:
        model: the model.
        frame: its frame.
        cameras: pinholes in the world by image name.
        criteria: criteria by which depths are kept and confirmed.
        voxel: edge of the smallest voxels, in the world's unit; by default the median footprint of a pixel.
        cell: part of the world; depths of points outside are left out.

    Raises:
        InputError: a camera has distortion, there are too few cameras, or the voxel is not a positive length.
        ReconstructionError: no depth is confirmed.
    """
    if len(cameras) < criteria.views:
        raise InputError(f"expected at least {criteria.views} cameras to confirm depths, got {len(cameras)}")
    if voxel is not None and not (np.isfinite(voxel) and voxel > 0):
        raise InputError(f"expected a positive edge length of the voxels, got {voxel}")
    depths = RenderedMaps(model, frame, cameras, _MAX_CONFIRMING_VIEWS)
    overlap = find_overlap(model, depths, _MAX_CONFIRMING_VIEWS)
    voxels = Voxels(overlap.footprint if voxel is None else voxel / frame.unit)
    point_count = 0
    for reference in with_time_left(overlap.references, "surface"):
        points, uncertainty = _confirmed_points(depths, reference, criteria, frame, cell)
        point_count += len(points.views)
        if len(points.views):
            voxels.add(points, uncertainty**-2, uncertainty)
    if not point_count:
        raise ReconstructionError(
            f"no surface: no {criteria.views} images agree on any depth: train with more steps, and check the cameras"
        )
    points = voxels.fuse()
    return Cloud(
        frame.to_world(points.points),
        _smooth_normals(points),
        points.colors.round().astype(np.uint8),
        {"confidence": points.confidence.astype(np.float32), "views": points.views.astype(np.int32)},
    )


def _smooth_normals(points: Points) -> FloatArray:
    """Return normals of planes through the neighbors, on the side from which the surface is seen.

    On synthetic cities their error is half of that of the averaged axes of the Gaussians, which no term of the loss
    constrains.
    """
    if len(points.points) < _NORMAL_NEIGHBORS:
        return points.normals
    normals = estimate_normals(Index(points.points), _NORMAL_NEIGHBORS).directions
    opposite = np.einsum("ni,ni->n", normals, points.normals) < 0
    oriented: FloatArray = np.where(opposite[:, None], -normals, normals)
    return oriented


def _confirmed_points(
    depths: RenderedMaps, reference: MatchedImage, criteria: Criteria, frame: LocalFrame, cell: SpaceCell
) -> tuple[Points, FloatArray]:
    """Return the confirmed points of a camera in a cell, in the local frame, and their uncertainties (N,)."""
    camera, rendered = depths.cameras[reference.name], depths.of(reference.name)
    depth_map = rendered.depth_map
    rows, columns = np.nonzero(depth_map.known & (depth_map.confidence >= criteria.confidence))
    if cell is not SPACE:
        pixels = np.stack([columns + 0.5, rows + 0.5], axis=1)
        inside = cell.contains(frame.to_world(world_points(camera, pixels, depth_map.depth[rows, columns])))
        rows, columns = rows[inside], columns[inside]
    others = [(depths.cameras[name], depths.of(name).depth_map) for name in reference.sources]
    parts: list[Points] = []
    uncertainties: list[FloatArray] = []
    for start in range(0, len(rows), _BLOCK_PIXELS):
        block = (rows[start : start + _BLOCK_PIXELS], columns[start : start + _BLOCK_PIXELS])
        ray_depths = np.empty((1 + len(others), len(block[0])))
        ray_depths[0] = depth_map.depth[block]
        for k, (other, other_map) in enumerate(others, start=1):
            ray_depths[k] = confirm(camera, depth_map, block, other, other_map, criteria).depths
        views = np.isfinite(ray_depths).sum(axis=0)
        enough = views >= criteria.views
        block = (block[0][enough], block[1][enough])
        pixels = np.stack([block[1] + 0.5, block[0] + 0.5], axis=1)
        footprint = depth_map.depth[block].astype(np.float64) / camera.intrinsics.fx
        disagreement = rendered.depth_disagreement[block].astype(np.float64)
        uncertainties.append(_uncertainty(footprint, disagreement, views[enough], len(ray_depths)))
        parts.append(
            Points(
                world_points(camera, pixels, _medians(ray_depths[:, enough])),
                depth_map.normal[block].astype(np.float64) @ camera.cam_from_world.rotation,
                rendered.colors[block].astype(np.float64),
                depth_map.confidence[block].astype(np.float64),
                views[enough],
                np.zeros(len(footprint)),
            )
        )
    return concatenate_points(parts), np.concatenate(uncertainties) if uncertainties else np.empty(0)


def _uncertainty(footprint: FloatArray, disagreement: FloatArray, views: IntArray, max_views: int) -> FloatArray:
    """Return the uncertainty (N,) of depths, a length.

    Args:
        footprint: (N,) footprints of the pixels.
        disagreement: (N,) differences of mean and median depth.
        views: (N,) numbers of images that agree.
        max_views: number of images that might agree.
    """
    missing = np.maximum(1, min(_FULL_CONFIRMATION_VIEWS, max_views) / views)
    uncertainty: FloatArray = np.hypot(footprint, disagreement) * missing**_UNCERTAINTY_POWER
    return uncertainty


def _medians(ray_depths: FloatArray) -> FloatArray:
    """Return the median of the finite values of each column (K, N)."""
    ordered, count = np.sort(ray_depths, axis=0), np.isfinite(ray_depths).sum(axis=0)  # NaN comes last
    columns = np.arange(ray_depths.shape[1])
    medians: FloatArray = (ordered[(count - 1) // 2, columns] + ordered[count // 2, columns]) / 2
    return medians
