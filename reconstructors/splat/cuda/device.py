"""Launching kernels on the GPU of a tensor."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pcbench.errors import InputError
from reconstructors.splat.cuda.kernels import Kernel, Launcher, Scalar

if TYPE_CHECKING:
    from torch import Tensor


def launcher_for(tensor: Tensor) -> Launcher:
    """Return the launcher of the GPU that a tensor is on.

    Raises:
        InputError: the tensor is not on a GPU.
        MissingExtra: cuda-core or NVRTC is not installed.
    """
    if not tensor.is_cuda:
        raise InputError(
            f"expected tensors on a CUDA device, got {tensor.device}: use reconstructors.splat.cpu for them"
        )
    from reconstructors.splat.cuda.nvrtc import gpu

    return gpu(tensor.get_device())


def kernel_input(tensor: Tensor) -> Tensor:
    """Return a tensor as the kernels read it: float32, contiguous and without autograd history."""
    import torch

    assert tensor.dtype == torch.float32, f"expected a tensor of float32, got {tensor.dtype}"
    return tensor.detach().contiguous()


def launch_over(launcher: Launcher, kernel: Kernel, count: int, *arguments: Tensor | Scalar | None) -> None:
    """Launch a kernel with at least `count` threads, one per element; nothing is launched for none."""
    if count:
        launcher.launch(kernel, -(-count // kernel.threads), *arguments)
