"""The parts of a training step beside the rasterizer on CUDA: image loss, Adam, and the Morton order of Gaussians."""

from __future__ import annotations

import ctypes
import math
from typing import TYPE_CHECKING

from reconstructors.splat.cuda import kernels
from reconstructors.splat.cuda.device import kernel_input, launch_over, launcher_for
from reconstructors.splat.cuda.kernels import Launcher
from reconstructors.splat.interface import ImageLoss

if TYPE_CHECKING:
    from torch import Tensor

_TILE = 16
_MORTON_CELLS = 2.0**21  # cells of the Z-order curve along an axis


def image_loss(image: Tensor, target: Tensor, ssim_weight: float, launcher: Launcher | None = None) -> ImageLoss:
    """Compute (1 - w) mean |x - y| + w (1 - SSIM) of images (H, W, 3) and its gradient with respect to x.

    SSIM (Wang et al. 2004) is computed per channel with a Gaussian window of 11 pixels and standard deviation 1.5,
    zeros beyond the border, C1 = 0.01^2 and C2 = 0.03^2. Memory: four images beside the two. Nothing synchronises with
    the GPU: l1 and ssim are tensors.

    Args:
        image: (H, W, 3) rendered image x.
        target: (H, W, 3) photograph y.
        ssim_weight: weight w.
        launcher: runs the kernels; the GPU that holds the tensors if None.

    Raises:
        InputError: the tensors are not on a CUDA device.
        MissingExtra: cuda-core or NVRTC is not installed.
    """
    import torch

    launch = (launcher or launcher_for(image)).launch
    image, target = kernel_input(image), kernel_input(target)
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
    """Apply one step of Adam (Kingma and Ba 2015), in place, to the rows `ids` of parameters and their moments.

    Args:
        parameters: (N, D) parameters.
        first: (N, D) first moments.
        second: (N, D) second moments.
        gradient: (V, D) gradient of the rows.
        ids: (V,) int64 indices of the rows, without duplicates. Other rows keep their parameters and moments.
        learning_rate: one for all columns, or one per column (D,).
        step: number of steps from 1, for all rows together.
        betas: decay rates of the two moments.
        eps: added to the denominator.
        launcher: runs the kernels; the GPU that holds the tensors if None.

    Raises:
        InputError: the tensors are not on a CUDA device.
        MissingExtra: cuda-core or NVRTC is not installed.
    """
    import torch

    launcher = launcher or launcher_for(parameters)
    columns, count = parameters.shape[1], gradient.numel()
    unbias = math.sqrt(1.0 - betas[1] ** step)
    correction = unbias / (1.0 - betas[0] ** step)
    if isinstance(learning_rate, torch.Tensor):
        scaled = (learning_rate.float().double() * correction).float()
        rates = scaled.to(parameters.device, non_blocking=True).contiguous()
    else:  # creating a tensor from host data would synchronise with the GPU; this does not
        rate = ctypes.c_float(learning_rate).value * correction
        rates = torch.full((columns,), rate, dtype=torch.float32, device=parameters.device)
    complements = (1.0 - ctypes.c_float(beta).value for beta in betas)  # of the float32 values in the kernel
    constants = (eps * unbias, *betas, *complements)
    launch_over(
        launcher, kernels.adam(), count,
        ctypes.c_int64(count), ctypes.c_int32(columns), parameters, first, second, kernel_input(gradient), ids, rates,
        *map(ctypes.c_float, constants),
    )  # fmt: skip


def morton_order(means: Tensor, launcher: Launcher | None = None) -> Tensor:
    """Return the order (N,), int64, of points (N, 3) along a Z-order curve (Morton 1966).

    The curve keeps neighbors close together, so the threads of a warp read and write Gaussians next to each other.
    Training sorts the Gaussians into this order every few thousand steps.

    Args:
        means: (N, 3) points.
        launcher: runs the kernels; the GPU that holds the tensors if None.

    Raises:
        InputError: the tensors are not on a CUDA device.
        MissingExtra: cuda-core or NVRTC is not installed.
    """
    import torch

    launcher, means = launcher or launcher_for(means), kernel_input(means)
    codes = torch.empty(len(means), dtype=torch.int64, device=means.device)
    if len(means) == 0:
        return codes
    lower, upper = means.amin(dim=0), means.amax(dim=0)
    cells = _MORTON_CELLS / (upper - lower).amax().clamp(min=torch.finfo(torch.float32).tiny)
    box = torch.cat([lower, cells[None]])
    launch_over(launcher, kernels.morton(), len(means), ctypes.c_int32(len(means)), means, box, codes)
    return torch.sort(codes, stable=True).indices
