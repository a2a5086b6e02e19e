"""Where Gaussians are drawn and trained, and which kernels do it: those of the device that the tensors are on."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal, NamedTuple

from pcbench.errors import InputError, MissingExtra
from reconstructors.splat.interface import Kernels

if TYPE_CHECKING:
    import torch


class Computing(NamedTuple):
    """Where to compute, and a sentence on it where it is not what anybody would expect."""

    device: torch.device
    note: str | None


def computing_on(wanted: Literal["auto", "cpu", "cuda"]) -> Computing:
    """The CPU or torch's current CUDA device; `auto` is the latter where there is one that can be used.

    Raises:
        InputError: there is no CUDA device, and nothing else would do.
        MissingExtra: what CUDA needs is not installed, and nothing else would do.
    """
    import torch

    cpu = torch.device("cpu")
    if wanted == "cpu":
        return Computing(cpu, None)
    if not torch.cuda.is_available():
        if wanted == "auto":
            return Computing(cpu, None)
        raise InputError(
            "expected a CUDA device for device=cuda, torch finds none: check the driver, take a torch that is built for"
            " CUDA, or set device=cpu"
        )
    from reconstructors.splat.cuda.nvrtc import gpu

    index = torch.cuda.current_device()
    try:
        gpu(index)
    except MissingExtra as error:
        if wanted == "auto":
            return Computing(cpu, f"trained on the CPU, not on {torch.cuda.get_device_name(index)}: {error}")
        raise
    return Computing(
        torch.device("cuda", index), f"trained on {torch.cuda.get_device_name(index)}; device=cpu would take the CPU"
    )


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
