"""The rasterizer on a GPU: which kernels run one after the other, and what they hand on.

Forward: each Gaussian is projected and its tiles are counted; those that touch a tile are numbered on and sorted by
depth; each writes an instance for each of its tiles, and the instances are sorted by tile, stably, so that within a
tile they lie by depth. Two sorts instead of one by a 64-bit key of tile and depth: the first sorts Gaussians, of which
there are several times fewer than instances, and the second needs only as many bits as there are tiles, mostly 16. A
radix sort's time is the number of keys times their bits.

Backward (Mallick et al. 2024, Taming 3DGS): a warp takes 32 splats of a tile and lets the tile's pixels go through its
lanes, so that each splat's sums are held by one lane. It starts from how far the rays had come where its splats begin,
which the forward pass stored. Each instance is written once, each Gaussian adds its own in a fixed order: nothing is
added atomically, and the same input gives the same bits.
"""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pcbench.errors import InputError
from reconstructors.splat.cuda import kernels
from reconstructors.splat.cuda.device import each, launcher_of, plain
from reconstructors.splat.cuda.kernels import Launcher
from reconstructors.splat.interface import Drawn, GaussianTensors, Pulled
from reconstructors.splat.view import View

if TYPE_CHECKING:
    from torch import Tensor

_TILE = 16  # pixels across and down
_PIXELS = _TILE * _TILE
_BUCKET = 32  # splats of a tile: as many as a warp has lanes
_MOMENTS, _GEOMETRY_MOMENTS = 11, 17  # numbers that blend_backward sums for each instance
_MOST_SHORT, _MOST_INT = 2**15 - 1, 2**31 - 1


@dataclass(frozen=True)
class _Projected:
    """N Gaussians, of which V touch a tile, in I pairs of a Gaussian and a tile: the instances."""

    given: GaussianTensors
    camera: Tensor  # struct Pinhole
    splats: Tensor  # (N, 16), not written where nothing is touched
    boxes: Tensor  # (N, 4)
    tiles: Tensor  # (N,) how many each touches
    ids: Tensor  # (V,) rising
    depths: Tensor  # (V,)
    instances: int


@dataclass(frozen=True)
class _Sorted:
    """Instances by tile and depth; and of each tile buckets of 32 splats, whose derivative one warp finds."""

    gaussians: Tensor  # (I,)
    emission: Tensor  # (I,) where they were written: those of a Gaussian side by side
    firsts: Tensor  # (V,) where those of a Gaussian begin
    starts: Tensor  # (T + 1,) where those of a tile begin, sorted
    bucket_ends: Tensor  # (T,)
    buckets: int  # at most


@dataclass(frozen=True)
class _Rays:
    """How far the rays have come."""

    borders: Tensor  # where each bucket begins
    ends: Tensor
    reached: Tensor  # (T, 256) how many of its tile's instances each pixel sees, up to the last


@dataclass(frozen=True)
class _Pass:
    """What `backward` needs of the forward pass."""

    projected: _Projected
    sorted: _Sorted
    rays: _Rays
    background: Tensor
    geometry: bool


class CudaRasterizer:
    """Draws a view of Gaussians and goes back from the image's derivative to theirs.

    Beside its results a pass holds some 100 bytes a Gaussian and 12 an instance (a Gaussian in a tile of 16 x 16
    pixels), and for the derivative 128 more an instance (256 with geometry) and 9 KB a tile (17 KB). While they are
    sorted instances take some 40 bytes, while the derivative is taken 44 (68).

    Args:
        launcher: what runs the kernels; the GPU that holds the tensors where it is None.
    """

    def __init__(self, launcher: Launcher | None = None) -> None:
        self._launcher = launcher
        self._pass: _Pass | None = None

    def forward(
        self,
        gaussians: GaussianTensors,
        view: View,
        background: Tensor,
        *,
        geometry: bool,
        gradient: bool = True,
    ) -> Drawn:
        """Draw the Gaussians; see `reconstructors.splat.interface.Rasterizer`. It waits for the GPU once.

        Raises:
            InputError: tensors that are not on a CUDA device, or more than 2^31 - 1 instances.
            MissingExtra: cuda-core or NVRTC is not installed.
        """
        self._pass = None
        given = GaussianTensors(*map(plain, gaussians))
        launcher = self._launcher or launcher_of(gaussians.means)
        background = plain(background.to(gaussians.means.device, non_blocking=True))
        projected = _project(launcher, given, view)
        ordered = _sort(launcher, projected, view)
        drawn, rays = _blend(launcher, projected, ordered, view, background, geometry, gradient)
        if rays is not None:
            self._pass = _Pass(projected, ordered, rays, background, geometry)
        return drawn

    def backward(
        self,
        color: Tensor,
        transmittance: Tensor | None,
        depth: Tensor | None,
        normal: Tensor | None,
        error: Tensor | None,
    ) -> Pulled:
        """The derivatives by the Gaussians; see `reconstructors.splat.interface.Rasterizer`. It waits for nothing."""
        assert self._pass is not None, "there is no forward pass with a gradient to go back through"
        projected, ordered, rays = self._pass.projected, self._pass.sorted, self._pass.rays
        geometry, drawn, harmonics = self._pass.geometry, len(projected.ids), projected.given.sh.shape[1]
        launcher = self._launcher or launcher_of(projected.splats)
        shapes = [(drawn, 3), (drawn, 4), (drawn, 3), (drawn,), (drawn, harmonics, 3), (drawn, 2), (drawn,), (drawn,)]
        pulled = Pulled(projected.ids, *(projected.splats.new_empty(shape) for shape in shapes))
        records = projected.splats.new_empty(projected.instances, _GEOMETRY_MOMENTS if geometry else _MOMENTS)
        images = [None if image is None else plain(image) for image in (color, transmittance, depth, normal, error)]
        each(
            launcher, kernels.blend_backward(geometry), ordered.buckets * _BUCKET,
            projected.camera, self._pass.background, ordered.starts, ordered.bucket_ends,
            ctypes.c_int32(len(ordered.bucket_ends)), ordered.gaussians, ordered.emission, projected.splats,
            rays.borders, rays.ends, rays.reached, *images, records,
        )  # fmt: skip
        each(
            launcher, kernels.project_backward(harmonics, geometry), drawn,
            projected.camera, ctypes.c_int32(drawn), projected.ids, ordered.firsts, projected.tiles, *projected.given,
            projected.splats, records, *pulled[1:],
        )  # fmt: skip
        return pulled


def _project(launcher: Launcher, given: GaussianTensors, view: View) -> _Projected:
    """Splats, and which Gaussians have one that touches a tile. It waits for the GPU, to know how many there are."""
    import torch

    means, sh = given.means, given.sh
    camera = torch.from_numpy(_pinhole(view)).to(means.device, non_blocking=True)
    number, count = ctypes.c_int32(len(means)), len(means)
    splats, depths = means.new_empty(count, 16), means.new_empty(count)
    boxes, tiles = means.new_empty(count, 4, dtype=torch.int16), means.new_empty(count, dtype=torch.int32)
    kernel = kernels.project_gaussians(sh.shape[1])
    each(launcher, kernel, count, camera, number, *given, splats, boxes, depths, tiles)
    slots = torch.cumsum(tiles > 0, 0, dtype=torch.int32)
    drawn, instances = torch.stack([slots[-1:].sum(), tiles.sum()]).tolist()
    if instances > _MOST_INT:
        raise InputError(
            f"expected at most {_MOST_INT} pairs of a Gaussian and a tile of 16 x 16 pixels, got {instances}: "
            "draw a smaller image"
        )
    ids, drawn_depths = means.new_empty(drawn, dtype=torch.int64), means.new_empty(drawn)
    each(launcher, kernels.compact(), count, number, tiles, slots, depths, ids, drawn_depths)
    return _Projected(given, camera, splats, boxes, tiles, ids, drawn_depths, instances)


def _sort(launcher: Launcher, projected: _Projected, view: View) -> _Sorted:
    """By depth, and then stably by tile."""
    import torch

    ids, instances, int32 = projected.ids, projected.instances, torch.int32
    order = torch.sort(projected.depths, stable=True).indices
    counts = projected.tiles[ids[order]]
    begins = torch.cumsum(counts, 0, dtype=torch.int64) - counts
    firsts = ids.new_empty(len(ids), dtype=int32)
    tiles, gaussians = ids.new_empty(instances, dtype=int32), ids.new_empty(instances, dtype=int32)
    each(
        launcher, kernels.instances(), len(ids),
        projected.camera, ctypes.c_int32(len(ids)), order, begins, ids, projected.splats, projected.boxes, firsts,
        tiles, gaussians,
    )  # fmt: skip
    count = _tiles_of(view)
    key = torch.int16 if count <= _MOST_SHORT else int32
    tiles, emission = torch.sort(tiles.to(key), stable=True)
    starts = torch.searchsorted(tiles, torch.arange(count + 1, dtype=key, device=tiles.device), out_int32=True)
    bucket_ends = torch.cumsum((starts.diff() + (_BUCKET - 1)) // _BUCKET, 0, dtype=int32)
    buckets = instances // _BUCKET + min(count, instances)
    return _Sorted(gaussians[emission], emission, firsts, starts, bucket_ends, buckets)


def _blend(
    launcher: Launcher,
    projected: _Projected,
    ordered: _Sorted,
    view: View,
    background: Tensor,
    geometry: bool,
    gradient: bool,
) -> tuple[Drawn, _Rays | None]:
    """The image; and how far the rays have come, where a derivative is to follow."""
    import torch

    new, size = projected.splats.new_empty, (view.height, view.width)
    maps = (new(size), new((*size, 3)), new(size)) if geometry else (None, None, None)
    drawn = Drawn(new((*size, 3)), new(size), *maps)
    count, floats = _tiles_of(view), 8 if geometry else 4
    rays = None
    if gradient:
        reached = new(count, _PIXELS, dtype=torch.int32)
        rays = _Rays(new(ordered.buckets, floats, _PIXELS), new(count, floats, _PIXELS), reached)
    kept = (rays.borders, rays.ends, rays.reached) if rays is not None else (None, None, None)
    launcher.launch(
        kernels.blend(geometry, gradient), count,
        projected.camera, background, ordered.starts, ordered.bucket_ends, ordered.gaussians, projected.splats, *drawn,
        *kept,
    )  # fmt: skip
    return drawn, rays


def _tiles_of(view: View) -> int:
    return -(-view.width // _TILE) * -(-view.height // _TILE)


def _pinhole(view: View) -> np.ndarray[tuple[int], np.dtype[np.float32]]:
    """`struct Pinhole` of pinhole.h."""
    k = (view.fx, view.fy, view.cx, view.cy)
    numbers = np.array([*view.rotation.ravel(), *view.position, *k, *view.limits, view.near], np.float32)
    return np.concatenate([numbers, np.array([view.width, view.height], np.int32).view(np.float32)])
