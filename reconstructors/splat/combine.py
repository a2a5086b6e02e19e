"""The surface of the Gaussians combined with the points of dense stereo, weighted by how well depth maps agree.

Stereo compares photographs at each pixel, so its depths are the more accurate ones; the depths of Gaussians are
smoother, and come from all images together. Each point of both clouds is therefore compared with both kinds of depth
maps, those of `mvs` and those rendered from the Gaussians. The more maps have their surface at a point, the smaller its
error: on synthetic cities the mean error is inversely proportional to their number.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pcbench.errors import ReconstructionError
from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.cameras import Camera
from pcbench.geometry.cloud import Cloud
from pcbench.io.colmap_model import read_colmap_cameras
from pcbench.plugins.progress import with_time_left
from reconstructors.mvs.filter import Criteria, depths_on_planes
from reconstructors.mvs.flatten import flatten
from reconstructors.mvs.maps import DepthMap, read_map
from reconstructors.splat.depths import RenderedMaps
from reconstructors.splat.model import Gaussians, LocalFrame
from reconstructors.splat.voxels import Points, Voxels

_AGREEMENT_PX = 0.4  # distance from a point to the surface of a map, in pixel footprints, up to which the map agrees
# Mean error, in footprints, of a point on which one map agrees; fitted to synthetic cities.
_STEREO_ERROR_PX, _RENDERED_ERROR_PX = 2.0, 4.0
_MAX_ERROR_PX = 4.0  # footprints; points with a larger expected error are left out
_VOXEL_PX = 0.5  # edge of the smallest voxels, in median footprints
_BLOCK_POINTS = 1 << 18  # points compared with a map at a time
_LIMITS = Criteria()  # limits of `mvs` on the differences of depths and normals


class DepthAgreement(NamedTuple):
    """The number of depth maps that agree on each of N points.

    Attributes:
        maps: (N,) number of maps that agree. A map whose surface is d footprints from the point counts
            (1 - (d / 0.4)^2)^2, and 0 beyond 0.4 footprints.
        footprint: (N,) smallest footprint of a pixel at the point; infinite if no map has a surface near it.
    """

    maps: FloatArray
    footprint: FloatArray


def combine(
    surface: Cloud,
    stereo: Cloud,
    gaussians: Gaussians,
    frame: LocalFrame,
    cameras: Mapping[str, Camera],
    stereo_maps: Path,
) -> Cloud:
    """Return a cloud of the surface of the Gaussians and of the points of dense stereo, each weighted by its error.

    The expected error of a point is two footprints of a pixel, or four for the surface of the Gaussians, divided by the
    number of maps that agree. Points with an expected error above four footprints are left out. The others are averaged
    in voxels of the size of their error, weighted by its inverse square, and moved onto planes where the surface is
    flat, as those of `mvs` are.

    The cloud has normals, colors, and the attributes `confidence`, which is n / (n + 1) if n maps agree, `views`, the
    number of images that agree, and `stereo`, the share of a point that comes from dense stereo: 0 for a point of the
    Gaussians alone, 1 for one of `mvs` alone.

    Args:
        surface: surface of the Gaussians in the world, with normals, colors and `views`.
        stereo: points of `mvs` in the world, with normals, colors and `views`.
        gaussians: the model.
        frame: its frame.
        cameras: pinholes in the world by image name, for which depths are rendered.
        stereo_maps: folder of the depth maps of `mvs`.

    Raises:
        ReconstructionError: no map agrees on any point closely enough.
    """
    clouds = (surface, stereo)
    points = [frame.to_local(cloud.points) for cloud in clouds]
    agreements = [DepthAgreement(np.zeros(len(cloud)), np.full(len(cloud), np.inf)) for cloud in clouds]
    for camera, depth_map in _all_maps(gaussians, frame, cameras, stereo_maps):
        for cloud, local_points, agreement in zip(clouds, points, agreements, strict=True):
            assert cloud.normals is not None
            for start in range(0, len(cloud), _BLOCK_POINTS):
                block = slice(start, start + _BLOCK_POINTS)
                part = DepthAgreement(agreement.maps[block], agreement.footprint[block])
                add_map(part, local_points[block], cloud.normals[block], camera, depth_map)
    errors_px = (_RENDERED_ERROR_PX, _STEREO_ERROR_PX)
    selections = [a.maps >= error_px / _MAX_ERROR_PX for a, error_px in zip(agreements, errors_px, strict=True)]
    if not any(kept.any() for kept in selections):
        raise ReconstructionError("no depth map has a surface near the points: check that the cameras are the same")
    footprints = np.concatenate([a.footprint for a in agreements])
    voxels = Voxels(_VOXEL_PX * float(np.median(footprints[np.isfinite(footprints)])))
    for cloud, local_points, agreement, kept, error_px in zip(
        clouds, points, agreements, selections, errors_px, strict=True
    ):
        maps = agreement.maps[kept]
        error = error_px * agreement.footprint[kept] / maps
        assert cloud.normals is not None and cloud.colors is not None
        is_stereo = np.full(len(maps), float(cloud is stereo))
        selected = Points(
            local_points[kept],
            cloud.normals[kept],
            cloud.colors[kept].astype(np.float64),
            maps / (1 + maps),
            cloud.attributes["views"][kept].astype(np.int64),
            is_stereo,
        )
        voxels.add(selected, error**-2, error)
    fused = voxels.fuse()
    attributes = {
        "confidence": fused.confidence.astype(np.float32),
        "views": fused.views.astype(np.int32),
        "stereo": fused.stereo.astype(np.float32),
    }
    colors = fused.colors.round().astype(np.uint8)
    cloud = flatten(Cloud(fused.points, fused.normals, colors, attributes))
    return replace(cloud, points=frame.to_world(cloud.points))


def _all_maps(
    gaussians: Gaussians, frame: LocalFrame, cameras: Mapping[str, Camera], stereo_maps: Path
) -> Iterator[tuple[Camera, DepthMap]]:
    """Yield the rendered maps and those of dense stereo, with their pinholes, in the local frame."""
    rendered = RenderedMaps(gaussians, frame, cameras, max_confirming_views=0)
    stereo_cameras = {camera.name: camera for camera in read_colmap_cameras(stereo_maps)}
    for name in with_time_left(list(cameras), "combining"):
        yield rendered.cameras[name], rendered.of(name).depth_map
        if name in stereo_cameras:
            depth_map = read_map(stereo_maps / name)
            local = DepthMap(depth_map.depth / np.float32(frame.unit), depth_map.normal, depth_map.confidence)
            yield frame.camera(stereo_cameras[name]), local


def add_map(
    agreement: DepthAgreement, points: FloatArray, normals: FloatArray, camera: Camera, depth_map: DepthMap
) -> None:
    """Add a map to the agreement on points (N, 3) with unit normals (N, 3), in the frame of the camera's pose."""
    height, width = depth_map.depth.shape
    pixels, z = camera.project(points)
    u, v = pixels.T
    rows = np.flatnonzero((z > 0) & (u >= 0) & (u < width) & (v >= 0) & (v < height))
    u, v, z = u[rows], v[rows], z[rows]
    row, column = v.astype(np.int64), u.astype(np.int64)
    depths = depths_on_planes(camera, depth_map, row, column, u, v)
    map_normals = depth_map.normal[row, column].astype(np.float64)
    cosines = np.einsum("ni,ni->n", normals[rows] @ camera.cam_from_world.rotation.T, map_normals)
    near = (depths > 0) & (np.abs(depths - z) <= _LIMITS.depth * z)
    near &= cosines >= np.cos(np.radians(_LIMITS.normal_deg))
    rows, z, depths, map_normals = rows[near], z[near], depths[near], map_normals[near]
    footprint = z / camera.intrinsics.fx
    rays = camera.intrinsics.directions(pixels[rows])
    distance_px = np.einsum("ni,ni->n", rays, map_normals) * (depths - z) / footprint
    agreement.maps[rows] += np.maximum(0, 1 - (distance_px / _AGREEMENT_PX) ** 2) ** 2
    agreement.footprint[rows] = np.minimum(agreement.footprint[rows], footprint)
