"""The rasterizer on a GPU: the sequence of kernels and the data that they pass on.

Forward: each Gaussian is projected and its tiles are counted. The Gaussians that touch a tile are compacted and sorted
by depth. Each writes an instance for each of its tiles, and a stable sort by tile keeps the instances of a tile in
depth order. The two sorts replace one sort by a 64-bit key of tile and depth: the first one sorts Gaussians, of which
there are several times fewer than instances, and the second one needs only as many bits as there are tiles, mostly 16.
The time of a radix sort is the number of keys times their bits.

Backward (Mallick et al. 2024, Taming 3DGS): a warp takes 32 splats of a tile, one per lane, and passes the tile's
pixels through its lanes, so that one lane accumulates the sums of each splat. It starts from the state of the rays at
its first splat, which the forward pass stored. Each instance is written once and each Gaussian adds its instances in a
fixed order: without atomic additions the same input gives the same bits.
"""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pcbench.errors import InputError
from reconstructors.splat.cuda import kernels
from reconstructors.splat.cuda.device import kernel_input, launch_over, launcher_for
from reconstructors.splat.cuda.kernels import Launcher
from reconstructors.splat.interface import GaussianTensors, Gradients, RasterOutput
from reconstructors.splat.view import View

if TYPE_CHECKING:
    from torch import Tensor

_TILE = 16  # pixels across and down
_PIXELS = _TILE * _TILE
_BUCKET = 32  # splats of a tile per warp: one per lane
_MOMENTS = {kernels.NO_GEOMETRY: 9, kernels.DEPTH: 12, kernels.NORMALS: 15}  # summed for each instance
_RAY_FLOATS = {kernels.NO_GEOMETRY: 4, kernels.DEPTH: 5, kernels.NORMALS: 8}  # stored for each ray
_MAX_INT16, _MAX_INT32 = 2**15 - 1, 2**31 - 1


@dataclass(frozen=True)
class _Projection:
    """N Gaussians, of which V touch a tile, with I instances: pairs of a Gaussian and a tile that it touches."""

    gaussians: GaussianTensors
    camera: Tensor  # struct Pinhole
    splats: Tensor  # (N, 16), not written for Gaussians that touch no tile
    boxes: Tensor  # (N, 4) tiles, inclusive
    tiles: Tensor  # (N,) number of tiles that each Gaussian touches
    ids: Tensor  # (V,) indices of the Gaussians, ascending
    depths: Tensor  # (V,)
    instances: int


@dataclass(frozen=True)
class _SortedInstances:
    """Instances sorted by tile and depth, and the buckets of 32 splats of each tile for the backward pass."""

    gaussians: Tensor  # (I,)
    emission: Tensor  # (I,) index at which each was written; those of one Gaussian are contiguous
    firsts: Tensor  # (V,) first emission of each Gaussian
    starts: Tensor  # (T + 1,) first sorted instance of each tile
    bucket_ends: Tensor  # (T,)
    buckets: int  # upper bound of their number


@dataclass(frozen=True)
class _Rays:
    """State of the rays of the forward pass."""

    borders: Tensor  # at the start of each bucket
    ends: Tensor
    reached: Tensor  # (T, 256) number of instances of the tile up to the last that contributes to each pixel


@dataclass(frozen=True)
class _ForwardPass:
    """The data of the forward pass that `backward` needs."""

    projected: _Projection
    sorted: _SortedInstances
    rays: _Rays
    background: Tensor
    geometry: int  # one of `kernels.GEOMETRIES`


class CudaRasterizer:
    """Renders views of Gaussians and computes the gradients with respect to the Gaussians.

    Beside its results, a pass takes about 100 bytes per Gaussian and 12 bytes per instance (a Gaussian in a tile of 16
    x 16 pixels); for the gradients it takes 128 more bytes per instance (160 with depth, 256 with normals too) and 9
    KB per tile (11, 17 KB). Sorting takes about 40 bytes per instance temporarily, the backward pass 36 (48, 60).

    Args:
        launcher: runs the kernels; the GPU that holds the tensors if None.
    """

    def __init__(self, launcher: Launcher | None = None) -> None:
        self._launcher = launcher
        self._pass: _ForwardPass | None = None

    def forward(
        self,
        gaussians: GaussianTensors,
        view: View,
        background: Tensor,
        *,
        geometry: bool,
        normals: bool = True,
        gradient: bool = True,
    ) -> RasterOutput:
        """Render the Gaussians; see `reconstructors.splat.interface.Rasterizer`. Synchronises with the GPU once.

        Raises:
            InputError: the tensors are not on a CUDA device, or there are more than 2^31 - 1 instances.
            MissingExtra: cuda-core or NVRTC is not installed.
        """
        self._pass = None
        gaussians = GaussianTensors(*map(kernel_input, gaussians))
        launcher = self._launcher or launcher_for(gaussians.means)
        background = kernel_input(background.to(gaussians.means.device, non_blocking=True))
        projected = _project(launcher, gaussians, view)
        ordered = _sort(launcher, projected, view)
        rendered = kernels.NO_GEOMETRY if not geometry else kernels.NORMALS if normals else kernels.DEPTH
        output, rays = _blend(launcher, projected, ordered, view, background, rendered, gradient)
        if rays is not None:
            self._pass = _ForwardPass(projected, ordered, rays, background, rendered)
        return output

    def backward(
        self,
        color: Tensor,
        transmittance: Tensor | None,
        depth: Tensor | None,
        normal: Tensor | None,
    ) -> Gradients:
        """Return the gradients; see `reconstructors.splat.interface.Rasterizer`. It does not synchronise."""
        assert self._pass is not None, "expected a forward pass with gradient=True before backward"
        projected, ordered, rays = self._pass.projected, self._pass.sorted, self._pass.rays
        geometry, drawn, harmonics = self._pass.geometry, len(projected.ids), projected.gaussians.sh.shape[1]
        launcher = self._launcher or launcher_for(projected.splats)
        shapes = [(drawn, 3), (drawn, 4), (drawn, 3), (drawn,), (drawn, harmonics, 3), (drawn, 2)]
        gradients = Gradients(projected.ids, *(projected.splats.new_empty(shape) for shape in shapes))
        records = projected.splats.new_empty(projected.instances, _MOMENTS[geometry])
        images = (color, transmittance, depth, normal)
        grad_images = [None if image is None else kernel_input(image) for image in images]
        launch_over(
            launcher, kernels.blend_backward(geometry), ordered.buckets * _BUCKET,
            projected.camera, self._pass.background, ordered.starts, ordered.bucket_ends,
            ctypes.c_int32(len(ordered.bucket_ends)), ordered.gaussians, ordered.emission, projected.splats,
            rays.borders, rays.ends, rays.reached, *grad_images, records,
        )  # fmt: skip
        launch_over(
            launcher, kernels.project_backward(harmonics, geometry), drawn,
            projected.camera, ctypes.c_int32(drawn), projected.ids, ordered.firsts, projected.tiles,
            *projected.gaussians, projected.splats, records, *gradients[1:],
        )  # fmt: skip
        return gradients


def _project(launcher: Launcher, gaussians: GaussianTensors, view: View) -> _Projection:
    """Project the Gaussians and find those that touch a tile. Reading their number synchronises with the GPU."""
    import torch

    means, sh = gaussians.means, gaussians.sh
    camera = torch.from_numpy(_pinhole(view)).to(means.device, non_blocking=True)
    count_value, count = ctypes.c_int32(len(means)), len(means)
    splats, depths = means.new_empty(count, 16), means.new_empty(count)
    boxes, tiles = means.new_empty(count, 4, dtype=torch.int16), means.new_empty(count, dtype=torch.int32)
    kernel = kernels.project_gaussians(sh.shape[1])
    launch_over(launcher, kernel, count, camera, count_value, *gaussians, splats, boxes, depths, tiles)
    slots = torch.cumsum(tiles > 0, 0, dtype=torch.int32)
    drawn, instances = torch.stack([slots[-1:].sum(), tiles.sum()]).tolist()
    if instances > _MAX_INT32:
        raise InputError(
            f"expected at most {_MAX_INT32} pairs of a Gaussian and a tile of 16 x 16 pixels, got {instances}: "
            "render a smaller image"
        )
    ids, drawn_depths = means.new_empty(drawn, dtype=torch.int64), means.new_empty(drawn)
    launch_over(launcher, kernels.compact(), count, count_value, tiles, slots, depths, ids, drawn_depths)
    return _Projection(gaussians, camera, splats, boxes, tiles, ids, drawn_depths, instances)


def _sort(launcher: Launcher, projected: _Projection, view: View) -> _SortedInstances:
    """Sort the Gaussians by depth, then their instances stably by tile."""
    import torch

    ids, instances, int32 = projected.ids, projected.instances, torch.int32
    order = torch.sort(projected.depths, stable=True).indices
    counts = projected.tiles[ids[order]]
    offsets = torch.cumsum(counts, 0, dtype=torch.int64) - counts
    firsts = ids.new_empty(len(ids), dtype=int32)
    tiles, gaussians = ids.new_empty(instances, dtype=int32), ids.new_empty(instances, dtype=int32)
    launch_over(
        launcher, kernels.instances(), len(ids),
        projected.camera, ctypes.c_int32(len(ids)), order, offsets, ids, projected.splats, projected.boxes, firsts,
        tiles, gaussians,
    )  # fmt: skip
    count = _tiles_of(view)
    key = torch.int16 if count <= _MAX_INT16 else int32
    tiles, emission = torch.sort(tiles.to(key), stable=True)
    starts = torch.searchsorted(tiles, torch.arange(count + 1, dtype=key, device=tiles.device), out_int32=True)
    bucket_ends = torch.cumsum((starts.diff() + (_BUCKET - 1)) // _BUCKET, 0, dtype=int32)
    buckets = instances // _BUCKET + min(count, instances)
    return _SortedInstances(gaussians[emission], emission, firsts, starts, bucket_ends, buckets)


def _blend(
    launcher: Launcher,
    projected: _Projection,
    ordered: _SortedInstances,
    view: View,
    background: Tensor,
    geometry: int,
    gradient: bool,
) -> tuple[RasterOutput, _Rays | None]:
    """Return the images, and the state of the rays if a backward pass may follow."""
    import torch

    new, size = projected.splats.new_empty, (view.height, view.width)
    depth = new(size) if geometry >= kernels.DEPTH else None
    normal, median_depth = (new((*size, 3)), new(size)) if geometry >= kernels.NORMALS else (None, None)
    output = RasterOutput(new((*size, 3)), new(size), depth, normal, median_depth)
    count, floats = _tiles_of(view), _RAY_FLOATS[geometry]
    rays = None
    if gradient:
        reached = new(count, _PIXELS, dtype=torch.int32)
        rays = _Rays(new(ordered.buckets, floats, _PIXELS), new(count, floats, _PIXELS), reached)
    ray_buffers = (rays.borders, rays.ends, rays.reached) if rays is not None else (None, None, None)
    launcher.launch(
        kernels.blend(geometry, gradient), count,
        projected.camera, background, ordered.starts, ordered.bucket_ends, ordered.gaussians, projected.splats,
        *output, *ray_buffers,
    )  # fmt: skip
    return output, rays


def _tiles_of(view: View) -> int:
    """Number of tiles of an image."""
    return -(-view.width // _TILE) * -(-view.height // _TILE)


def _pinhole(view: View) -> np.ndarray[tuple[int], np.dtype[np.float32]]:
    """Return `struct Pinhole` of pinhole.h as float32 words."""
    k = (view.fx, view.fy, view.cx, view.cy)
    floats = np.array([*view.rotation.ravel(), *view.position, *k, *view.limits, view.near, *view.cutoffs], np.float32)
    return np.concatenate([floats, np.array([view.width, view.height], np.int32).view(np.float32)])
