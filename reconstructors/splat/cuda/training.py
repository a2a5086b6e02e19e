"""What a training step needs beside the rasterizer: the loss of an image, Adam, and an order of the Gaussians."""

from __future__ import annotations

import ctypes
import math
from typing import TYPE_CHECKING

from reconstructors.splat.cuda import kernels
from reconstructors.splat.cuda.device import blocks_of, launcher_of, plain
from reconstructors.splat.cuda.kernels import Launcher
from reconstructors.splat.interface import ImageLoss

if TYPE_CHECKING:
    from torch import Tensor

_TILE = 16
_CELLS = 2.0**21  # of the Z-order curve along an axis


def image_loss(image: Tensor, target: Tensor, ssim_weight: float, launcher: Launcher | None = None) -> ImageLoss:
    """(1 - w) mean |x - y| + w (1 - SSIM) of images (H, W, 3), with its derivative by the first (Wang et al. 2004).

    SSIM has a Gaussian window of 11 pixels and standard deviation 1.5, zeros beyond the border, C1 = 0.01^2 and
    C2 = 0.03^2, and is taken by channels. Memory: four images beside the two. Nothing waits for the GPU: l1 and ssim
    are tensors.

    Raises:
        InputError: tensors that are not on a CUDA device.
        MissingExtra: cuda-core or NVRTC is not installed.
    """
    import torch

    launch = (launcher or launcher_of(image)).launch
    image, target = plain(image), plain(target)
    height, width = image.shape[:2]
    blocks = 3 * -(-height // _TILE) * -(-width // _TILE)
    maps = [torch.empty_like(image) for _ in range(3)]
    gradient = torch.empty_like(image)
    sums = torch.empty(blocks, 2, device=image.device)
    size = (ctypes.c_int32(width), ctypes.c_int32(height))
    count = image.numel()
    launch(kernels.image_loss(), blocks, *size, image, target, *maps, sums)
    weights = (ctypes.c_float(-ssim_weight / count), ctypes.c_float((1.0 - ssim_weight) / count))
    launch(kernels.image_loss_backward(), blocks, *size, *weights, image, target, *maps, gradient)
    l1, ssim = (sums.sum(dim=0, dtype=torch.float64) / count).to(torch.float32).unbind()
    return ImageLoss(l1, ssim, gradient)


def adam(
    parameters: Tensor,
    first: Tensor,
    second: Tensor,
    gradient: Tensor,
    ids: Tensor,
    learning_rate: float | Tensor,
    step: int,
    betas: tuple[float, float] = (0.9, 0.999),
    eps: float = 1e-15,
    launcher: Launcher | None = None,
) -> None:
    """One step of Adam (Kingma and Ba 2015), in place, on the rows `ids` of parameters (N, D) and their moments.

    Args:
        gradient: (V, D) of those rows.
        ids: (V,) int64, none twice. Other rows keep their parameters and their moments.
        learning_rate: of all columns, or of each (D,).
        step: from 1, of all rows alike.

    Raises:
        InputError: tensors that are not on a CUDA device.
        MissingExtra: cuda-core or NVRTC is not installed.
    """
    import torch

    launch = (launcher or launcher_of(parameters)).launch
    columns, count = parameters.shape[1], gradient.numel()
    if count == 0:
        return
    unbias = math.sqrt(1.0 - betas[1] ** step)
    correction = unbias / (1.0 - betas[0] ** step)
    if isinstance(learning_rate, torch.Tensor):
        scaled = (learning_rate.float().double() * correction).float()
        rates = scaled.to(parameters.device, non_blocking=True).contiguous()
    else:  # a tensor made of a number of the host would wait for the GPU; this does not
        rate = ctypes.c_float(learning_rate).value * correction
        rates = torch.full((columns,), rate, dtype=torch.float32, device=parameters.device)
    rests = (1.0 - ctypes.c_float(beta).value for beta in betas)  # of what the kernel multiplies by
    numbers = (eps * unbias, *betas, *rests)
    kernel = kernels.adam()
    launch(
        kernel, blocks_of(count, kernel),
        ctypes.c_int64(count), ctypes.c_int32(columns), parameters, first, second, plain(gradient), ids, rates,
        *map(ctypes.c_float, numbers),
    )  # fmt: skip


def morton_order(means: Tensor, launcher: Launcher | None = None) -> Tensor:
    """(N,) int64: the order of points (N, 3) along a Z-order curve (Morton 1966), which keeps neighbours together.

    Gaussians in this order are read and written side by side by the threads of a warp. A trainer applies it to all that
    belongs to its Gaussians every few thousand steps.

    Raises:
        InputError: tensors that are not on a CUDA device.
        MissingExtra: cuda-core or NVRTC is not installed.
    """
    import torch

    launch = (launcher or launcher_of(means)).launch
    means = plain(means)
    codes = torch.empty(len(means), dtype=torch.int64, device=means.device)
    if len(means) == 0:
        return codes
    least, most = means.amin(dim=0), means.amax(dim=0)
    cells = _CELLS / (most - least).amax().clamp(min=torch.finfo(torch.float32).tiny)
    kernel = kernels.morton()
    box = torch.cat([least, cells[None]])
    launch(kernel, blocks_of(len(means), kernel), ctypes.c_int32(len(means)), means, box, codes)
    return torch.sort(codes, stable=True).indices
