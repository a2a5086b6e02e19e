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
    """The CPU or torch's current CUDA device; `auto` is the latter where there is one on which a kernel runs.

    Raises:
        InputError: there is no CUDA device, or none on which a kernel runs, and nothing else would do.
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
    device = torch.device("cuda", torch.cuda.current_device())
    name = torch.cuda.get_device_name(device)
    try:
        _run_smallest_kernel(device)
    except Exception as error:  # drivers and libraries have many types of their own
        why = (str(error).splitlines() or [type(error).__name__])[0]
        if wanted == "auto":
            return Computing(cpu, f"trained on the CPU, not on {name}: {why}")
        if isinstance(error, MissingExtra):
            raise
        raise InputError(f"no kernel runs on {name}: {why}: set device=cpu") from error
    return Computing(device, f"trained on {name}; device=cpu would take the CPU")


def _run_smallest_kernel(device: torch.device) -> None:
    """It is compiled, loaded and launched as all of them are."""
    import torch

    from reconstructors.splat import cuda

    cuda.morton_order(torch.zeros(1, 3, device=device)).tolist()


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
