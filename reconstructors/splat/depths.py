"""Depth and normal maps rendered from a model (Gaussians or a radiance field), and the overlap between images."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from pcbench.errors import ReconstructionError
from pcbench.geometry.cameras import Camera
from reconstructors.mvs.maps import DepthMap
from reconstructors.mvs.sources import MatchedImage, choose_references
from reconstructors.mvs.sparse import SparseModel
from reconstructors.splat.interface import RasterOutput
from reconstructors.splat.model import LocalFrame
from reconstructors.splat.photographs import NEAREST
from reconstructors.splat.view import View

_CACHE_BYTES = 512 * 2**20  # maximum size of the cached maps
_BYTES_PER_PIXEL = 4 + 12 + 4 + 3 + 4
_DEPTH_DISAGREEMENT_PX = 2.0  # difference of mean and median depth, in pixel footprints, that halves the confidence
_MAX_OVERLAP_SAMPLES = 3000  # points from which the overlap of images is computed
_MAX_RELATIVE_DEPTH_DIFFERENCE = 0.05  # difference of depth between a visible point and the rendered surface


class SurfaceModel(Protocol):
    """A model in a `LocalFrame` whose renderings show a surface."""

    def render_geometry(self, view: View) -> RasterOutput:
        """Render the colors, transmittances, depths, normals and median depths of a view."""
        ...

    def surface_points(self) -> NDArray[np.float64]:
        """Return points (N, 3) on or close behind the surface."""
        ...


class RenderedMap(NamedTuple):
    """The rendering of one camera.

    Attributes:
        depth_map: depths, normals and confidence, in the local frame.
        colors: (H, W, 3) rendered colors.
        depth_disagreement: (H, W) absolute difference of the mean and the median depth along the ray, in the local
            frame.
    """

    depth_map: DepthMap
    colors: NDArray[np.uint8]
    depth_disagreement: NDArray[np.float32]


class RenderedMaps:
    """Depth maps of all cameras in the local frame, rendered on request.

    The most recent maps are cached, up to 512 MiB, so that memory does not grow with the number of images.

    The depth of a pixel is the median along its ray, behind which the transmittance is below one half; of Gaussians it
    is the depth of the plane of one. At an edge it is the depth of one side, not a mixture. The confidence is the alpha
    of the pixel, divided by 1 + (difference of mean and median depth / two footprints)^2.

    Args:
        model: the model.
        frame: its frame.
        cameras: pinholes in the world by image name.
        max_confirming_views: number of maps that are used at the same time.
    """

    def __init__(
        self, model: SurfaceModel, frame: LocalFrame, cameras: Mapping[str, Camera], max_confirming_views: int
    ) -> None:
        local = {name: frame.camera(camera) for name, camera in cameras.items()}
        self.cameras: Mapping[str, Camera] = local
        largest = max(camera.intrinsics.width * camera.intrinsics.height for camera in cameras.values())
        cache = lru_cache(max(max_confirming_views + 1, _CACHE_BYTES // (_BYTES_PER_PIXEL * largest)))
        # A cached method would keep the maps in memory until Python looks for cycles of references.
        self.of = cache(lambda name: _render(model, local[name]))


def _render(model: SurfaceModel, camera: Camera) -> RenderedMap:
    """Render the map of a camera in the local frame."""
    output = model.render_geometry(View.of(camera, NEAREST))
    assert output.depth is not None and output.normal is not None and output.median_depth is not None
    color, transmittance = output.color.cpu().numpy(), output.transmittance.cpu().numpy()
    depth, median = output.depth.cpu().numpy(), output.median_depth.cpu().numpy()
    normal = output.normal.cpu().numpy()
    alpha = 1 - transmittance
    has_depth = median > 0
    depth_disagreement = np.abs(depth / np.where(has_depth, alpha, 1) - median)
    disagreement_px = depth_disagreement / np.where(has_depth, median, 1) * np.float32(camera.intrinsics.fx)
    length = np.linalg.norm(normal, axis=2)
    has_depth &= length > 0
    depth_map = DepthMap(
        np.where(has_depth, median, 0).astype(np.float32),
        np.where(has_depth[..., None], normal / np.where(has_depth, length, 1)[..., None], 0).astype(np.float32),
        np.where(has_depth, alpha / (1 + (disagreement_px / _DEPTH_DISAGREEMENT_PX) ** 2), 0).astype(np.float32),
    )
    return RenderedMap(depth_map, (255 * color.clip(0, 1)).round().astype(np.uint8), depth_disagreement)


class Overlap(NamedTuple):
    """Groups of images that show the same surface.

    Attributes:
        references: each image with the images that may confirm its depths.
        footprint: size of a pixel on the surface, in the local frame: the median over the images of their medians.
    """

    references: list[MatchedImage]
    footprint: float


def find_overlap(model: SurfaceModel, depths: RenderedMaps, max_sources: int) -> Overlap:
    """Match each image with at most `max_sources` others that see the same points of the surface at good angles.

    Raises:
        ReconstructionError: no image shows a surface, or no two images overlap.
    """
    from scipy.sparse import csc_matrix

    points = model.surface_points()
    points = points[:: max(1, len(points) // _MAX_OVERLAP_SAMPLES)]
    visibility, footprints = [], []
    for name, camera in depths.cameras.items():
        depth_map = depths.of(name).depth_map
        if depth_map.known.any():
            footprints.append(float(np.median(depth_map.depth[depth_map.known])) / camera.intrinsics.fx)
        visibility.append(_on_surface(camera, depth_map, points))
    if not footprints:
        raise ReconstructionError(
            "no surface: alpha is below 0.5 in all images: train with more steps, and check that the cameras are those"
            " of the model"
        )
    visible = csc_matrix(np.array(visibility, dtype=np.int8).T.reshape(len(points), len(visibility)))
    references, _ = choose_references(SparseModel(depths.cameras, points, visible), max_sources)
    return Overlap(references, float(np.median(footprints)))


def _on_surface(camera: Camera, depth_map: DepthMap, points: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return a mask (N,) of the points (N, 3) whose depth is close to the depth of the map at their pixels."""
    pixels, z = camera.project(points)
    u, v = pixels.T
    height, width = depth_map.depth.shape
    inside = np.flatnonzero((z > 0) & (u >= 0) & (u < width) & (v >= 0) & (v < height))
    map_depths = depth_map.depth[v[inside].astype(np.int64), u[inside].astype(np.int64)]
    close = np.zeros(len(points), dtype=np.bool_)
    close[inside] = np.abs(map_depths - z[inside]) <= _MAX_RELATIVE_DEPTH_DIFFERENCE * z[inside]
    return close
