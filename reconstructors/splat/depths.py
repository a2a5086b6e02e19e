"""What cameras see of Gaussians as depth and normal maps, and which cameras see the same."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcbench.errors import ReconstructionError
from pcbench.geometry.cameras import Camera
from reconstructors.mvs.maps import DepthMap
from reconstructors.mvs.sources import MatchedImage, choose_references
from reconstructors.mvs.sparse import Sparse
from reconstructors.splat.devices import kernels_of
from reconstructors.splat.model import Gaussians, LocalFrame
from reconstructors.splat.photographs import NEAREST
from reconstructors.splat.view import View

_MEMORY = 512 * 2**20  # of the maps that are kept
_BYTES = 4 + 12 + 4 + 3 + 4  # a pixel
_UNSURE = 2.0  # footprints of a pixel between two opinions on its depth, at which confidence is half
_SAMPLES = 3000  # Gaussians that tell which images show the same
_OPAQUE = 0.5  # that these are at least
_SAME_DEPTH = 0.05  # relative: of a Gaussian that an image shows and of the image's surface


class Seen(NamedTuple):
    """What one camera sees.

    Attributes:
        made: its map, in the local frame.
        colors: (H, W, 3) as drawn.
        apart: (H, W) between the median and the mean depth along a ray, in the local frame.
    """

    made: DepthMap
    colors: NDArray[np.uint8]
    apart: NDArray[np.float32]


class Depths:
    """The maps of all cameras in the local frame, drawn when they are asked for; the last ones are kept, as far as
    512 MiB hold them, so that memory does not grow with the number of images.

    The depth of a pixel is the median along its ray: of the plane of the Gaussian behind which less than half of the
    light is left. An edge then lies before or behind, and not between. Its confidence is what the Gaussians hide of the
    background, less where the mean depth along the ray is another: 1 / (1 + (difference / two footprints)^2) of it.

    Args:
        cameras: pinholes in the world by image name.
        confirming: maps that are needed at a time.
    """

    def __init__(self, gaussians: Gaussians, frame: LocalFrame, cameras: Mapping[str, Camera], confirming: int) -> None:
        self.cameras = {name: frame.camera(camera) for name, camera in cameras.items()}
        kernels = kernels_of(gaussians.means.device)
        self._rasterizer = kernels.Rasterizer()
        self._gaussians = gaussians.drawn_from
        largest = max(camera.intrinsics.width * camera.intrinsics.height for camera in cameras.values())
        self.of = lru_cache(max(confirming + 1, _MEMORY // (_BYTES * largest)))(self._drawn)

    def _drawn(self, name: str) -> Seen:
        camera = self.cameras[name]
        background = self._gaussians.means.new_zeros(3)
        drawn = self._rasterizer.forward(
            self._gaussians, View.of(camera, NEAREST), background, geometry=True, gradient=False
        )
        assert drawn.depth is not None and drawn.normal is not None and drawn.median_depth is not None
        color, transmittance = drawn.color.cpu().numpy(), drawn.transmittance.cpu().numpy()
        depth, median = drawn.depth.cpu().numpy(), drawn.median_depth.cpu().numpy()
        normal = drawn.normal.cpu().numpy()
        alpha = 1 - transmittance
        known = median > 0
        apart = np.abs(depth / np.where(known, alpha, 1) - median)
        opinion = apart / np.where(known, median, 1) * np.float32(camera.intrinsics.fx)
        length = np.linalg.norm(normal, axis=2)
        known &= length > 0
        made = DepthMap(
            np.where(known, median, 0).astype(np.float32),
            np.where(known[..., None], normal / np.where(known, length, 1)[..., None], 0).astype(np.float32),
            np.where(known, alpha / (1 + (opinion / _UNSURE) ** 2), 0).astype(np.float32),
        )
        return Seen(made, (255 * color.clip(0, 1)).round().astype(np.uint8), apart)


class Overlap(NamedTuple):
    """Which images show the same.

    Attributes:
        references: what each image is to be confirmed by.
        footprint: of a pixel, in the local frame: the median over the images of the median over the pixels.
    """

    references: list[MatchedImage]
    footprint: float


def overlap(gaussians: Gaussians, depths: Depths, most: int) -> Overlap:
    """For each image at most `most` others that see the same at good angles, by Gaussians that lie on their surfaces.

    Raises:
        ReconstructionError: no image shows anything, or no two show the same.
    """
    from scipy.sparse import csc_matrix

    opacities = gaussians.opacities.detach().cpu().numpy()
    opaque = np.flatnonzero(opacities >= min(_OPAQUE, opacities.max(initial=0)))
    chosen = opaque[:: max(1, len(opaque) // _SAMPLES)]
    points = gaussians.means.detach().cpu().numpy()[chosen].astype(np.float64)
    shown, footprints = [], []
    for name, camera in depths.cameras.items():
        made = depths.of(name).made
        if made.known.any():
            footprints.append(float(np.median(made.depth[made.known])) / camera.intrinsics.fx)
        shown.append(_on_surface(camera, made, points))
    if not footprints:
        raise ReconstructionError(
            "no surface: the Gaussians hide half of the background in no image: train for longer, and check that the"
            " cameras are those of the model"
        )
    shows = csc_matrix(np.array(shown, dtype=np.int8).T.reshape(len(points), len(shown)))
    references, _ = choose_references(Sparse(depths.cameras, points, shows), most)
    return Overlap(references, float(np.median(footprints)))


def _on_surface(camera: Camera, made: DepthMap, points: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which points (N, 3) lie about as deep as what the map has at their pixels."""
    (u, v), z = camera.project(points)[0].T, camera.project(points)[1]
    height, width = made.depth.shape
    inside = np.flatnonzero((z > 0) & (u >= 0) & (u < width) & (v >= 0) & (v < height))
    there = made.depth[v[inside].astype(np.int64), u[inside].astype(np.int64)]
    on = np.zeros(len(points), dtype=np.bool_)
    on[inside] = np.abs(there - z[inside]) <= _SAME_DEPTH * z[inside]
    return on
