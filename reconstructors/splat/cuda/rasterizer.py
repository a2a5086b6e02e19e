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
from reconstructors.splat.cuda.device import blocks_of, launcher_of, plain
from reconstructors.splat.cuda.kernels import Kernel, Launcher, Scalar
from reconstructors.splat.interface import Drawn, Pulled
from reconstructors.splat.view import View

if TYPE_CHECKING:
    from torch import Tensor

_TILE = 16  # pixels across and down
_PIXELS = _TILE * _TILE
_BUCKET = 32  # splats of a tile whose derivative one warp finds
_MOST_SHORT, _MOST_INT = 2**15 - 1, 2**31 - 1


@dataclass
class _Pass:
    """What `backward` needs of the forward pass."""

    given: tuple[Tensor, Tensor, Tensor, Tensor, Tensor]
    geometry: bool
    camera: Tensor
    background: Tensor
    splats: Tensor  # (N, 16)
    tiles: Tensor  # (N,) how many each Gaussian touches
    ids: Tensor  # (V,) of the drawn
    firsts: Tensor  # (V,) where their instances begin, as they were written
    starts: Tensor  # (T + 1,) where the tiles' instances begin, sorted
    bucket_ends: Tensor  # (T,)
    buckets: int  # at most
    gaussians: Tensor  # (I,) of the sorted instances
    emission: Tensor  # (I,) where they were written
    borders: Tensor
    ends: Tensor
    reached: Tensor


class Rasterizer:
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
        means: Tensor,
        quats: Tensor,
        scales: Tensor,
        opacities: Tensor,
        sh: Tensor,
        view: View,
        background: Tensor,
        *,
        geometry: bool,
        gradient: bool = True,
    ) -> Drawn:
        """Draw the Gaussians; see `reconstructors.splat.interface.Rasterizer`. It waits for the GPU once.

        Args:
            gradient: whether `backward` is to follow.

        Raises:
            InputError: tensors that are not on a CUDA device, or more than 2^31 - 1 instances.
            MissingExtra: cuda-core or NVRTC is not installed.
        """
        import torch

        self._pass = None
        means, quats, scales, opacities, sh = map(plain, (means, quats, scales, opacities, sh))
        given = (means, quats, scales, opacities, sh)
        device, count, harmonics = means.device, len(means), sh.shape[1]
        launch = (self._launcher or launcher_of(means)).launch
        int32, int64 = torch.int32, torch.int64

        def new(*shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
            return torch.empty(shape, dtype=dtype, device=device)

        def each(kernel: Kernel, number: int, *arguments: Tensor | Scalar) -> None:
            if number:
                launch(kernel, blocks_of(number, kernel), *arguments)

        camera = torch.from_numpy(_pinhole(view)).to(device, non_blocking=True)
        background = plain(background.to(device, non_blocking=True))
        splats, depths = new(count, 16), new(count)
        boxes, tiles = new(count, 4, dtype=torch.int16), new(count, dtype=int32)
        number = ctypes.c_int32(count)
        each(kernels.project_gaussians(harmonics), count, camera, number, *given, splats, boxes, depths, tiles)
        slots = torch.cumsum(tiles > 0, 0, dtype=int32)
        totals = [slots[-1:].sum(), tiles.sum()]
        drawn, instances = torch.stack(totals).tolist()  # the one wait
        if instances > _MOST_INT:
            raise InputError(
                f"expected at most {_MOST_INT} pairs of a Gaussian and a tile of 16 x 16 pixels, got {instances}: "
                "draw a smaller image"
            )

        ids, drawn_depths = new(drawn, dtype=int64), new(drawn)
        each(kernels.compact(), count, number, tiles, slots, depths, ids, drawn_depths)
        order = torch.sort(drawn_depths, stable=True).indices
        counts = tiles[ids[order]]
        begins = torch.cumsum(counts, 0, dtype=int64) - counts
        firsts = new(drawn, dtype=int32)
        tile_of, gaussian_of = new(instances, dtype=int32), new(instances, dtype=int32)
        each(
            kernels.instances(), drawn,
            camera, ctypes.c_int32(drawn), order, begins, ids, splats, boxes, firsts, tile_of, gaussian_of,
        )  # fmt: skip
        tile_count = -(-view.width // _TILE) * -(-view.height // _TILE)
        key = torch.int16 if tile_count <= _MOST_SHORT else int32
        tile_of, emission = torch.sort(tile_of.to(key), stable=True)
        gaussians = gaussian_of[emission]
        numbers = torch.arange(tile_count + 1, dtype=key, device=device)
        starts = torch.searchsorted(tile_of, numbers, out_int32=True)
        bucket_ends = torch.cumsum((starts.diff() + (_BUCKET - 1)) // _BUCKET, 0, dtype=int32)
        buckets = instances // _BUCKET + min(tile_count, instances)

        size = (view.height, view.width)
        color, transmittance = new(*size, 3), new(*size)
        depth, normal, median_depth = (new(*size), new(*size, 3), new(*size)) if geometry else (None, None, None)
        floats = 8 if geometry else 4
        borders, ends, reached = None, None, None
        if gradient:
            borders, ends = new(buckets, floats, _PIXELS), new(tile_count, floats, _PIXELS)
            reached = new(tile_count, _PIXELS, dtype=int32)
        launch(
            kernels.blend(geometry, gradient), tile_count,
            camera, background, starts, bucket_ends, gaussians, splats,
            color, transmittance, depth, normal, median_depth, borders, ends, reached,
        )  # fmt: skip
        if borders is not None and ends is not None and reached is not None:
            self._pass = _Pass(
                given, geometry, camera, background, splats, tiles, ids, firsts, starts, bucket_ends, buckets,
                gaussians, emission, borders, ends, reached,
            )  # fmt: skip
        return Drawn(color, transmittance, depth, normal, median_depth)

    def backward(
        self,
        color: Tensor,
        transmittance: Tensor | None,
        depth: Tensor | None,
        normal: Tensor | None,
        error: Tensor | None,
    ) -> Pulled:
        """The derivatives by the Gaussians; see `reconstructors.splat.interface.Rasterizer`. It waits for nothing."""
        import torch

        held = self._pass
        assert held is not None, "there is no forward pass with a gradient to go back through"
        means, sh = held.given[0], held.given[-1]
        drawn, harmonics, instances = len(held.ids), sh.shape[1], len(held.emission)
        launch = (self._launcher or launcher_of(means)).launch

        def new(*shape: int) -> Tensor:
            return torch.empty(shape, device=means.device)

        pulled = Pulled(
            held.ids, new(drawn, 3), new(drawn, 4), new(drawn, 3), new(drawn), new(drawn, harmonics, 3), new(drawn, 2),
            new(drawn), new(drawn),
        )  # fmt: skip
        if drawn == 0:
            return pulled
        records = new(instances, 17 if held.geometry else 11)
        given = [None if image is None else plain(image) for image in (color, transmittance, depth, normal, error)]
        kernel = kernels.blend_backward(held.geometry)
        launch(
            kernel, blocks_of(held.buckets * _BUCKET, kernel),
            held.camera, held.background, held.starts, held.bucket_ends, ctypes.c_int32(len(held.bucket_ends)),
            held.gaussians, held.emission, held.splats, held.borders, held.ends, held.reached, *given, records,
        )  # fmt: skip
        kernel = kernels.project_backward(harmonics, held.geometry)
        launch(
            kernel, blocks_of(drawn, kernel),
            held.camera, ctypes.c_int32(drawn), held.ids, held.firsts, held.tiles, *held.given, held.splats, records,
            *pulled[1:],
        )  # fmt: skip
        return pulled


def _pinhole(view: View) -> np.ndarray[tuple[int], np.dtype[np.float32]]:
    """`struct Pinhole` of pinhole.h."""
    k = (view.fx, view.fy, view.cx, view.cy)
    numbers = np.array([*view.rotation.ravel(), *view.position, *k, *view.limits, view.near], np.float32)
    return np.concatenate([numbers, np.array([view.width, view.height], np.int32).view(np.float32)])
