"""Choice of the device for rendering and training, and of the kernels for the device of a tensor."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal, NamedTuple

from pcbench.errors import InputError, MissingExtra
from reconstructors.splat.interface import Kernels

if TYPE_CHECKING:
    import torch


class DeviceChoice(NamedTuple):
    """The device to compute on, and a note for the user if it is not the CPU as requested."""

    device: torch.device
    note: str | None


def choose_device(wanted: Literal["auto", "cpu", "cuda"]) -> DeviceChoice:
    """Return the CPU or torch's current CUDA device; `auto` returns CUDA if there is a device that runs a kernel.

    Raises:
        InputError: CUDA is requested, and there is no CUDA device or it runs no kernel.
        MissingExtra: CUDA is requested, and a package that it needs is not installed.
    """
    import torch

    cpu = torch.device("cpu")
    if wanted == "cpu":
        return DeviceChoice(cpu, None)
    if not torch.cuda.is_available():
        if wanted == "auto":
            return DeviceChoice(cpu, None)
        raise InputError(
            "expected a CUDA device for device=cuda, torch finds none: check the driver, install a torch built for"
            " CUDA, or set device=cpu"
        )
    device = torch.device("cuda", torch.cuda.current_device())
    name = torch.cuda.get_device_name(device)
    try:
        _run_smallest_kernel(device)
    except Exception as error:  # drivers and libraries raise many types
        why = (str(error).splitlines() or [type(error).__name__])[0]
        if wanted == "auto":
            return DeviceChoice(cpu, f"trained on the CPU, not on {name}: {why}")
        if isinstance(error, MissingExtra):
            raise
        raise InputError(f"no kernel runs on {name}: {why}; set device=cpu") from error
    return DeviceChoice(device, f"trained on {name}; set device=cpu to train on the CPU")


def _run_smallest_kernel(device: torch.device) -> None:
    """Compile, load and launch one small kernel."""
    import torch

    from reconstructors.splat import cuda

    cuda.morton_order(torch.zeros(1, 3, device=device)).tolist()


def kernels_of(device: torch.device) -> Kernels:
    """Return the module with the rasterizer, the loss and the optimizer step of a device.

    Raises:
        InputError: the device is neither the CPU nor CUDA.
        MissingExtra: a package that CUDA needs is not installed.
    """
    if device.type == "cpu":
        from reconstructors.splat import cpu

        return cpu
    if device.type == "cuda":
        from reconstructors.splat import cuda

        return cuda
    raise InputError(f"expected tensors on the CPU or on a CUDA device, got {device}: move them with .cpu() or .cuda()")
