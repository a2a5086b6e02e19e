"""Equivalent training steps on one image by different code: pcbench, plain torch, OpenSplat and gsplat.

Each contestant has the parameters of a trainer (logarithms of scales, logits of opacities) and four parts that are
called in turn: `forward` renders, `loss` computes the gradient of 0.8 L1 + 0.2 (1 - SSIM) with respect to the image,
`backward` the gradients with respect to the parameters, `adam` is the optimizer step. The learning rates are zero, so
that all runs render the same image.
"""

import math
import os
import sys
from collections.abc import Callable, Iterator
from functools import cached_property
from pathlib import Path
from types import ModuleType
from typing import NamedTuple, Protocol

import numpy as np
import torch
from torch import Tensor

from pcbench.geometry.cameras import Camera, Intrinsics, look_at
from reconstructors.splat.devices import kernels_of
from reconstructors.splat.interface import GaussianTensors, Gradients, RasterOutput
from reconstructors.splat.reference import Projection, project
from reconstructors.splat.view import View

SSIM_WEIGHT = 0.2
TILE = 16  # pixels, in plain torch
PAIRS_AT_ONCE = 4_000_000  # pairs of a pixel and a Gaussian


class Parameters(NamedTuple):
    """Parameters of N Gaussians: (N, 3), (N, 4), (N, 3) logarithms, (N,) logits, (N, 16, 3)."""

    means: Tensor
    quats: Tensor
    log_scales: Tensor
    logits: Tensor
    sh: Tensor

    def gaussians(self) -> GaussianTensors:
        """Return the Gaussians as a rasterizer reads them."""
        return GaussianTensors(self.means, self.quats, self.log_scales.exp(), self.logits.sigmoid(), self.sh)


class Picture(NamedTuple):
    """Gaussians, the view to render, and the target image (H, W, 3)."""

    parameters: Parameters
    view: View
    target: Tensor

    def leaves(self) -> Parameters:
        """Return copies of the parameters that require gradients."""
        return Parameters(*(tensor.clone().requires_grad_() for tensor in self.parameters))


def make_picture(count: int, width: int, height: int, device: str = "cpu", seed: int = 0) -> Picture:
    """Create random Gaussians in front of a camera; 54 % of the means are inside the image.

    Their size scales with the area per Gaussian, so the number of Gaussians behind a pixel does not depend on the
    count; most have a low opacity.
    """
    rng = np.random.default_rng(seed)
    focal = 0.9 * width
    camera = Camera(
        "view", Intrinsics(width, height, focal, focal, width / 2, height / 2), look_at((0, -4, 0), (0, 0, 0))
    )
    size = np.array([width, height])
    pixels = (rng.uniform(-0.5, 0.5, (count, 2)) / np.sqrt(0.54) + 0.5) * size
    depth = rng.uniform(2, 8, (count, 1))
    means = camera.cam_from_world.inverse().apply(np.hstack([(pixels - size / 2) / focal * depth, depth]))
    deviation = 1.76 * np.sqrt(width * height / count)  # pixels
    scales = deviation * depth / focal * np.exp(rng.normal(0, 0.5, (count, 3)))
    opacities = rng.beta(1, 6, count) * 0.9 + 0.01
    quats, sh = rng.normal(size=(count, 4)), rng.normal(size=(count, 16, 3)) * 0.1
    arrays = means, quats, np.log(scales), np.log(opacities / (1 - opacities)), sh
    *parameters, target = (
        torch.from_numpy(np.ascontiguousarray(array, dtype=np.float32)).to(device)
        for array in (*arrays, rng.random((height, width, 3)))
    )
    return Picture(Parameters(*parameters), View.of(camera), target)


class Contestant(Protocol):
    """One implementation; `image` (H, W, 3) exists after `forward`, `gradients` after `backward`."""

    image: Tensor

    def forward(self) -> None: ...
    def loss(self) -> None: ...
    def backward(self) -> None: ...
    def adam(self) -> None: ...
    def gradients(self) -> Parameters: ...


class Ours:
    """The rasterizer of this package, including the sums for densification; with or without depth and normals."""

    def __init__(self, picture: Picture, *, geometry: bool = False, normals: bool = True) -> None:
        self._picture, self._images = picture, {"geometry": geometry, "normals": normals}
        self._kernels = kernels_of(picture.target.device)
        self.rasterizer = self._kernels.Rasterizer()
        self._background = torch.zeros(3, device=picture.target.device)
        self._rows = [tensor.clone().reshape(len(tensor), -1) for tensor in picture.parameters]
        self._moments = [(torch.zeros_like(rows), torch.zeros_like(rows)) for rows in self._rows]
        pixels = picture.target.shape[0] * picture.target.shape[1]
        self._grad_depth = torch.full_like(picture.target[..., 0], 1 / pixels) if geometry else None
        self._grad_normal = torch.full_like(picture.target, 1 / pixels) if geometry and normals else None
        self._step = 0

    def forward(self) -> None:
        self._gaussians = self._picture.parameters.gaussians()
        output = self.rasterizer.forward(self._gaussians, self._picture.view, self._background, **self._images)
        self.image, self.transmittance = output.color, output.transmittance

    def loss(self) -> None:
        self._grad_image = self._kernels.image_loss(self.image, self._picture.target, SSIM_WEIGHT).gradient

    def backward(self) -> None:
        self.pulled = self.rasterizer.backward(self._grad_image, None, self._grad_depth, self._grad_normal)
        ids, opacities = self.pulled.ids, self._gaussians.opacities[self.pulled.ids]
        grad_logits = self.pulled.opacities * opacities * (1 - opacities)
        grad_log_scales = self.pulled.scales * self._gaussians.scales[ids]
        self._gradients = Parameters(
            self.pulled.means,
            self.pulled.quats,
            grad_log_scales,
            grad_logits,
            self.pulled.sh,
        )

    def adam(self) -> None:
        self._step += 1
        for rows, moments, g in zip(self._rows, self._moments, self._gradients, strict=True):
            self._kernels.adam(rows, *moments, g.reshape(len(g), -1), self.pulled.ids, 0.0, self._step)

    def gradients(self) -> Parameters:
        result = [torch.zeros_like(tensor) for tensor in self._picture.parameters]
        for tensor, rows in zip(result, self._gradients, strict=True):
            tensor[self.pulled.ids] = rows
        return Parameters(*result)


class ByAutograd:
    """The parts of a step differentiated by torch; a contestant defines `draw` and may replace `difference`."""

    def __init__(self, picture: Picture) -> None:
        self._picture = picture
        self._leaves = picture.leaves()
        self._optimizer = torch.optim.Adam(self._leaves, lr=0.0, eps=1e-15, fused=True)

    def draw(self) -> Tensor:
        raise NotImplementedError

    def difference(self, image: Tensor) -> Tensor:
        return plain_loss(image, self._picture.target, self._window)

    @cached_property
    def _window(self) -> Tensor:
        ramp = torch.arange(11, dtype=torch.float32, device=self._picture.target.device) - 5
        bell = torch.exp(-(ramp**2) / (2 * 1.5**2))
        return bell / bell.sum()

    def forward(self) -> None:
        self._rendering = self.draw()
        self.image = self._rendering.detach()

    def loss(self) -> None:
        image = self._rendering.detach().requires_grad_()
        self.difference(image).backward()
        self._grad_image = image.grad

    def backward(self) -> None:
        self._optimizer.zero_grad(set_to_none=True)
        self._rendering.backward(self._grad_image)

    def adam(self) -> None:
        self._optimizer.step()

    def gradients(self) -> Parameters:
        return Parameters(*(leaf.grad for leaf in self._leaves))


class PlainTorch(ByAutograd):
    """Float32 tensors of all pixels of a tile and all Gaussians in it, with torch's own compiled code only."""

    def draw(self) -> Tensor:
        return render_plainly(self._leaves.gaussians(), self._picture.view)


def render_plainly(gaussians: GaussianTensors, view: View) -> Tensor:
    """Render with tensor operations only."""
    return draw_in_tiles(project(gaussians, view), view)


def plain_loss(image: Tensor, target: Tensor, window: Tensor) -> Tensor:
    """Return the loss of `reference.image_loss` in float32, all channels at once, which is much faster in torch."""
    x, y = image.permute(2, 0, 1), target.permute(2, 0, 1)
    channels = torch.cat([x, y, x * x, y * y, x * y])
    windows = torch.outer(window, window).expand(len(channels), 1, 11, 11).contiguous()
    means = torch.nn.functional.conv2d(channels[None], windows, padding=5, groups=len(channels))[0]
    mean_x, mean_y, xx, yy, xy = means.split(3)
    xx, yy, xy = xx - mean_x**2, yy - mean_y**2, xy - mean_x * mean_y
    numerator = (2 * mean_x * mean_y + 0.01**2) * (2 * xy + 0.03**2)
    ssim = (numerator / ((mean_x**2 + mean_y**2 + 0.01**2) * (xx + yy + 0.03**2))).mean()
    return (1 - SSIM_WEIGHT) * (x - y).abs().mean() + SSIM_WEIGHT * (1 - ssim)


class Lists(NamedTuple):
    """The splats of each tile, nearest first.

    Attributes:
        splats: (I,) indices of the splats, tile after tile.
        sizes: (T,) number of splats of each tile.
        across: tiles in a row.
    """

    splats: Tensor
    sizes: Tensor
    across: int


@torch.no_grad()
def list_by_tile(splats: Projection, view: View) -> Lists:
    device = splats.xy.device
    grid = torch.tensor([-(-view.width // TILE), -(-view.height // TILE)], device=device)
    variances = torch.linalg.inv(splats.inverse).diagonal(dim1=1, dim2=2)
    radius = torch.sqrt(2 * torch.log(255 * splats.opacities)[:, None] * variances)
    first_tile = ((splats.xy - radius) / TILE).floor().long().clamp(min=0)
    last_tile = torch.minimum(((splats.xy + radius) / TILE).floor().long(), grid - 1)
    extent = (last_tile - first_tile + 1).clamp(min=0)
    count = extent.prod(dim=1)
    owner = torch.repeat_interleave(count)
    rank = torch.arange(len(owner), device=device) - (count.cumsum(0) - count)[owner]
    column, row = rank % extent[owner, 0], rank.div(extent[owner, 0], rounding_mode="floor")
    tile = (first_tile[owner, 1] + row) * grid[0] + first_tile[owner, 0] + column
    order = torch.argsort(tile, stable=True)
    return Lists(owner[order], torch.bincount(tile, minlength=int(grid.prod())), int(grid[0]))


class Blend(NamedTuple):
    """Weights of t tiles with up to K splats each: tiles (t,), splats (t, K), weights (t, K, 256), transmittance (t,
    256)."""

    tiles: Tensor
    splats: Tensor
    weights: Tensor
    transmittance: Tensor


def blend_tiles(splats: Projection, lists: Lists, tiles: Tensor) -> Iterator[Blend]:
    """Blend tiles in batches of similar sizes, with the thresholds of the reference."""
    tiles = tiles[torch.argsort(lists.sizes[tiles], descending=True)]
    starts = lists.sizes.cumsum(0) - lists.sizes
    pixel = torch.arange(TILE * TILE, device=tiles.device)
    first = 0
    while first < len(tiles):
        max_splats = max(1, int(lists.sizes[tiles[first]]))
        batch = tiles[first : first + max(1, PAIRS_AT_ONCE // (max_splats * TILE * TILE))]
        first += len(batch)
        rank = torch.arange(max_splats, device=tiles.device)
        is_listed = rank < lists.sizes[batch][:, None]
        ids = lists.splats[torch.where(is_listed, starts[batch][:, None] + rank, 0)]
        u = (batch % lists.across * TILE)[:, None] + pixel % TILE + 0.5
        v = (batch // lists.across * TILE)[:, None] + pixel // TILE + 0.5
        x, y = (u[:, None] - splats.xy[:, 0][ids][..., None]), (v[:, None] - splats.xy[:, 1][ids][..., None])
        a, b, c = (splats.inverse[:, i, j][ids][..., None] for i, j in ((0, 0), (0, 1), (1, 1)))
        power = x * (a * x + 2 * b * y) + c * (y * y)
        alpha = splats.opacities[ids][..., None] * torch.exp(-power / 2)
        alpha = torch.where((alpha >= 1 / 255) & is_listed[..., None], alpha.clamp(max=0.99), 0)
        logarithm = torch.log1p(-alpha)
        log_transmittance = logarithm.cumsum(dim=1)
        is_blended = log_transmittance.detach() >= float(np.log(1e-4))
        weights = torch.where(is_blended, alpha, 0) * torch.exp(log_transmittance - logarithm)
        yield Blend(batch, ids, weights, torch.exp(torch.where(is_blended, logarithm, 0).sum(dim=1)))


def draw_in_tiles(splats: Projection, view: View) -> Tensor:
    """Return the image (H, W, 3) on a black background."""
    lists = list_by_tile(splats, view)
    tiles, colors = [], []
    for batch in blend_tiles(splats, lists, torch.arange(len(lists.sizes), device=splats.xy.device)):
        tiles.append(batch.tiles)
        colors.append(batch.weights.mT @ splats.color[batch.splats])
    tile_colors = torch.cat(colors)[torch.argsort(torch.cat(tiles))]
    row_count = len(lists.sizes) // lists.across
    image = tile_colors.reshape(row_count, lists.across, TILE, TILE, 3).transpose(1, 2).reshape(row_count * TILE, -1, 3)
    return image[: view.height, : view.width]


@torch.no_grad()
def contributors(picture: Picture, max_pairs: int = 30_000_000) -> float:
    """Return the mean number of Gaussians blended at a pixel of the complete tiles, or of a sample of them."""
    splats = project(picture.parameters.gaussians(), picture.view)
    lists = list_by_tile(splats, picture.view)
    tile_ids = torch.arange(len(lists.sizes), device=splats.xy.device)
    is_complete = (tile_ids % lists.across + 1) * TILE <= picture.view.width
    is_complete &= (tile_ids // lists.across + 1) * TILE <= picture.view.height
    stride = 1 + len(lists.splats) * TILE * TILE // max_pairs
    counts = [
        (batch.weights > 0).sum(dim=1).float().flatten()
        for batch in blend_tiles(splats, lists, tile_ids[is_complete][::stride])
    ]
    return float(torch.cat(counts).mean())


def build_opensplat(source: Path) -> ModuleType:
    """Compile OpenSplat's CPU rasterizer from its source folder with the flags of its CMakeLists.txt (Release)."""
    from torch.utils.cpp_extension import load

    os.environ["PATH"] = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"  # where pip puts ninja
    wrapper = Path(__file__).parents[1] / "benchmarks" / "opensplat.cpp"
    return load(
        "pcbench_opensplat",
        [str(wrapper), str(source / "rasterizer/gsplat-cpu/gsplat_cpu.cpp")],
        extra_cflags=["-O3", "-DNDEBUG", "-w"],
        extra_include_paths=[str(source)],
    )


class OpenSplat(ByAutograd):
    """A step of OpenSplat on the CPU during densification.

    Projection and harmonics are torch tensors in C++ with autograd, rasterizer and loss compiled loops. Torch's Adam
    updates all but the higher harmonics, which OpenSplat updates at one step of sixteen only.
    """

    def __init__(self, picture: Picture, module: ModuleType) -> None:
        super().__init__(picture)
        self._module = module
        self._base = self._leaves.sh.detach()[:, 0].clone().requires_grad_()
        self._higher = self._leaves.sh.detach()[:, 1:].clone().requires_grad_()
        parameters = [*self._leaves[:4], self._base]
        parameters[3] = self._leaves.logits.detach()[:, None].clone().requires_grad_()
        self._leaves = Parameters(*parameters)
        self._optimizer = torch.optim.Adam(parameters, lr=0.0, eps=1e-15)
        view = picture.view
        self._camera = torch.eye(4)
        self._camera[:3, :3] = torch.from_numpy(view.rotation)
        self._camera[:3, 3] = torch.from_numpy(-view.rotation @ view.position)
        near_plane, far_plane = 0.001, 1000.0
        self._clip = torch.tensor(
            [
                [2 * view.fx / view.width, 0, 0, 0],
                [0, 2 * view.fy / view.height, 0, 0],
                [
                    0,
                    0,
                    (far_plane + near_plane) / (far_plane - near_plane),
                    -far_plane * near_plane / (far_plane - near_plane),
                ],
                [0, 0, 1, 0],
            ]
        )

    def draw(self) -> Tensor:
        view, leaves = self._picture.view, self._leaves
        xy, _, conics, covariances, depths = self._module.project(
            leaves.means,
            leaves.log_scales.exp(),
            leaves.quats / leaves.quats.norm(dim=1, keepdim=True),
            self._camera,
            self._clip @ self._camera,
            *(view.fx, view.fy, view.cx, view.cy, view.height, view.width),
        )
        xy.retain_grad()
        directions = leaves.means.detach() - torch.from_numpy(view.position).float()
        directions = directions / directions.norm(dim=1, keepdim=True)
        sh = torch.cat([self._base[:, None], self._higher], dim=1)
        colors = torch.clamp_min(self._module.harmonics(directions, sh) + 0.5, 0.0)
        splats = xy, conics, colors, leaves.logits.sigmoid(), covariances, depths
        image = _OpenSplatBlend.apply(self._module, view.width, view.height, *splats)
        return torch.clamp_max(image, 1.0)

    def difference(self, image: Tensor) -> Tensor:
        return _OpenSplatLoss.apply(self._module, image, self._picture.target)

    def gradients(self) -> Parameters:
        means, quats, log_scales, logits, base = (leaf.grad for leaf in self._leaves)
        return Parameters(means, quats, log_scales, logits[:, 0], torch.cat([base[:, None], self._higher.grad], dim=1))


class _OpenSplatBlend(torch.autograd.Function):
    @staticmethod
    def forward(ctx, module, width, height, *splats):
        image, transmittance, ctx.lists = module.blend(width, height, *splats)
        ctx.module, ctx.size = module, (width, height)
        ctx.save_for_backward(*splats, transmittance)
        return image

    @staticmethod
    def backward(ctx, grad_image):
        *splats, transmittance = ctx.saved_tensors
        gradients = ctx.module.blend_backward(*ctx.size, *splats, transmittance, ctx.lists, grad_image.contiguous())
        ctx.lists = None
        return None, None, None, *gradients, None, None


class _OpenSplatLoss(torch.autograd.Function):
    @staticmethod
    def forward(ctx, module, image, target):
        stats, partials = module.loss(image, target, SSIM_WEIGHT)
        ctx.module = module
        ctx.save_for_backward(image, target, partials, stats)
        return stats[0]

    @staticmethod
    def backward(ctx, grad_loss):
        return None, ctx.module.loss_backward(*ctx.saved_tensors, grad_loss.contiguous(), SSIM_WEIGHT), None


class Gsplat(ByAutograd):
    """gsplat's rasterizer on a GPU, with the loss and the optimizer of torch."""

    def draw(self) -> Tensor:
        return draw_by_gsplat(self._leaves.gaussians(), self._picture.view)


def draw_by_gsplat(gaussians: GaussianTensors, view: View) -> Tensor:
    """Render with gsplat on the GPU."""
    from gsplat import rasterization

    device = gaussians.means.device
    camera = torch.eye(4, device=device)
    camera[:3, :3] = torch.as_tensor(view.rotation)
    camera[:3, 3] = torch.as_tensor(-view.rotation @ view.position)
    k = torch.tensor([[view.fx, 0, view.cx], [0, view.fy, view.cy], [0, 0, 1]], device=device)
    images, _, _ = rasterization(
        *(*gaussians, camera[None], k[None], view.width, view.height),
        near_plane=view.near,
        sh_degree=math.isqrt(gaussians.sh.shape[1]) - 1,
        packed=False,
    )
    return images[0]


class RasterizerByAutograd:
    """A `Rasterizer` for `Training` around another renderer that torch differentiates.

    It renders colors only, on a black background, and returns no sums for densification.
    """

    def __init__(self, draw: Callable[[GaussianTensors, View], Tensor]) -> None:
        self._draw = draw

    def forward(
        self,
        gaussians: GaussianTensors,
        view: View,
        background: Tensor,
        *,
        geometry: bool,
        normals: bool = True,
    ) -> RasterOutput:
        if geometry or background.any():
            raise NotImplementedError("expected colors only, on a black background")
        self._leaves = GaussianTensors(*(part.detach().requires_grad_() for part in gaussians))
        self._image = self._draw(self._leaves, view)
        color = self._image.detach().contiguous()
        return RasterOutput(color, torch.zeros_like(color[..., 0]), None, None, None)

    def backward(
        self,
        color: Tensor,
        transmittance: Tensor | None,
        depth: Tensor | None,
        normal: Tensor | None,
    ) -> Gradients:
        self._image.backward(color)
        gradients = [torch.zeros_like(leaf) if leaf.grad is None else leaf.grad for leaf in self._leaves]
        ids = torch.stack([g.reshape(len(g), -1).any(dim=1) for g in gradients]).any(dim=0).nonzero()[:, 0]
        return Gradients(ids, *(g[ids] for g in gradients), color.new_zeros(len(ids), 2))
