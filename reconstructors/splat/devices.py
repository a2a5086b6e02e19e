"""Which kernels draw: those of the device that the tensors are on."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pcbench.errors import InputError
from reconstructors.splat.interface import Kernels

if TYPE_CHECKING:
    import torch


def kernels_of(device: torch.device) -> Kernels:
    """The rasterizer, the loss and the optimizer's step of a device.

    Raises:
        InputError: there are none for it.
        MissingExtra: what CUDA needs is not installed.
    """
    if device.type == "cpu":
        from reconstructors.splat import cpu

        return cpu
    if device.type == "cuda":
        from reconstructors.splat import cuda

        return cuda
    raise InputError(f"expected tensors on the CPU or on a CUDA device, got {device}: move them with .cpu() or .cuda()")
