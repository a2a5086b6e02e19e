"""Where the kernels of a tensor run."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pcbench.errors import InputError
from reconstructors.splat.cuda.kernels import Kernel, Launcher

if TYPE_CHECKING:
    from torch import Tensor


def launcher_of(tensor: Tensor) -> Launcher:
    """The GPU that holds a tensor.

    Raises:
        InputError: none does.
        MissingExtra: cuda-core or NVRTC is not installed.
    """
    if not tensor.is_cuda:
        raise InputError(
            f"expected tensors on a CUDA device, got {tensor.device}: use reconstructors.splat.cpu for them"
        )
    from reconstructors.splat.cuda.nvrtc import gpu

    return gpu(tensor.get_device())


def plain(tensor: Tensor) -> Tensor:
    """As the kernels read it: float32, side by side, and without a history of derivatives."""
    import torch

    assert tensor.dtype == torch.float32, f"expected a tensor of float32, got {tensor.dtype}"
    return tensor.detach().contiguous()


def blocks_of(number: int, kernel: Kernel) -> int:
    """How many blocks have a thread for each of a number of things."""
    return -(-number // kernel.threads)
