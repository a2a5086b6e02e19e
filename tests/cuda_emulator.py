"""A launcher that runs CUDA kernels on the CPU; `cuda_emulation/machine.h` describes the method and its limits."""

from __future__ import annotations

import ctypes
import hashlib
import os
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path

import torch

from reconstructors.splat import cuda
from reconstructors.splat.cuda.kernels import Kernel, Scalar
from reconstructors.splat.interface import ImageLoss

ORDERS = (("forward", 0), ("reverse", 0), ("random", 1), ("random", 2))
_ORDER_CODES = {"forward": 0, "reverse": 1, "random": 2}
_HEADERS = Path(__file__).with_name("cuda_emulation")
_BUILD = Path(__file__).parents[1] / "build" / "cuda_emulator"
_FLAGS = ("-std=c++17", "-O1", "-ffp-contract=off", "-shared", "-fPIC", "-fno-gnu-unique", "-w")
_LETTERS = {torch.float32: "f", torch.int32: "i", torch.int64: "l", torch.int16: "s"}
_SCALARS = {ctypes.c_int32: "I", ctypes.c_int64: "L", ctypes.c_float: "F"}


class EmulationError(Exception):
    """A kernel did something undefined on a GPU."""


class Emulator:
    """Replaces a GPU for tensors on the CPU.

    Args:
        order: order of threads and blocks: forward, reverse or random.
        seed: seed of the random order.
    """

    def __init__(self, order: str = "forward", seed: int = 0) -> None:
        self._order = _ORDER_CODES[order]
        self._seed = seed
        self.launched: list[str] = []  # names of all launched kernels, in order

    def launch(self, kernel: Kernel, blocks: int, *arguments: torch.Tensor | Scalar | None) -> None:
        signature = _library(kernel).emulated_signature().decode()
        assert len(signature) == len(arguments), f"{kernel.name} takes {len(signature)} arguments, not {len(arguments)}"
        holders = [_holder(kernel, letter, argument) for letter, argument in zip(signature, arguments, strict=True)]
        pointers = (ctypes.c_void_p * len(holders))(*(ctypes.addressof(holder) for holder in holders))
        self.run(kernel, blocks, ctypes.addressof(pointers))

    def run(self, kernel: Kernel, blocks: int, pointers: int) -> None:
        """Run a kernel as the driver does: `pointers` is the address of an array of pointers to the arguments."""
        self.launched.append(kernel.name)
        assert blocks > 0, f"{kernel.name}: a GPU refuses {blocks} blocks"
        message = ctypes.create_string_buffer(500)
        if _library(kernel).emulated_run(
            pointers, blocks, kernel.threads, self._order, self._seed, message, len(message)
        ):
            raise EmulationError(f"{kernel.name}: {message.value.decode()}")


class EmulatedCuda:
    """The module of kernels `reconstructors.splat.cuda` on an emulator.

    Args:
        order, seed: as for `Emulator`.
    """

    def __init__(self, order: str = "forward", seed: int = 0, emulator: type[Emulator] = Emulator) -> None:
        self.emulator = emulator(order, seed)

    def Rasterizer(self) -> cuda.Rasterizer:
        return cuda.Rasterizer(self.emulator)

    def image_loss(self, *arguments) -> ImageLoss:
        return cuda.image_loss(*arguments, launcher=self.emulator)

    def adam(self, *arguments) -> None:
        cuda.adam(*arguments, launcher=self.emulator)

    def morton_order(self, means: torch.Tensor) -> torch.Tensor:
        return cuda.morton_order(means, self.emulator)


def _holder(kernel: Kernel, letter: str, argument: torch.Tensor | Scalar | None) -> ctypes._SimpleCData:
    """Return the argument as a ctypes object, after checking its type against the kernel's signature."""
    if argument is None:
        assert letter.islower(), kernel.name
        return ctypes.c_void_p(None)
    if isinstance(argument, torch.Tensor):
        assert argument.is_contiguous(), kernel.name
        assert _LETTERS[argument.dtype] == letter, f"{kernel.name}: {argument.dtype} for {letter}"
        return ctypes.c_void_p(argument.data_ptr())
    assert _SCALARS[type(argument)] == letter, f"{kernel.name}: {type(argument)} for {letter}"
    return argument


@cache
def _library(kernel: Kernel) -> ctypes.CDLL:
    library = ctypes.CDLL(str(build(kernel)))
    library.emulated_signature.restype = ctypes.c_char_p
    uint32 = ctypes.c_uint32
    library.emulated_run.argtypes = [
        ctypes.c_void_p, uint32, uint32, ctypes.c_int, ctypes.c_uint64, ctypes.c_char_p, ctypes.c_size_t
    ]  # fmt: skip
    return library


def build(kernel: Kernel) -> Path:
    """Compile a kernel to a library for this machine, in build/cuda_emulator; its name has a hash of all inputs.

    The environment variable EMULATOR_FLAGS adds flags of the compiler.
    """
    flags = (*_FLAGS, *os.environ.get("EMULATOR_FLAGS", "").split())
    lines = (
        f'#include "{_HEADERS}/cuda.h"',
        f'#line 1 "{kernel.name}"',
        kernel.source,
        f"EMULATED_KERNEL({kernel.name})",
    )
    text = "\n".join((*lines, ""))
    headers = [file.read_text() for file in sorted(_HEADERS.glob("*.h"))]
    digest = hashlib.sha256(repr((text, headers, flags)).encode()).hexdigest()[:24]
    library = _BUILD / f"{kernel.name}-{digest}.so"
    if not library.exists():
        _BUILD.mkdir(parents=True, exist_ok=True)
        temporary_file = library.with_suffix(f".{os.getpid()}.tmp")
        process = subprocess.run(
            ["g++", *flags, "-x", "c++", "-", "-o", temporary_file], input=text, text=True, capture_output=True
        )
        assert process.returncode == 0, process.stderr
        temporary_file.replace(library)
    return library


@contextmanager
def nan_filled_memory() -> Iterator[None]:
    """Fill new tensors with NaN in this context, so that a read before the first write is visible."""
    was_deterministic = torch.are_deterministic_algorithms_enabled()
    torch.use_deterministic_algorithms(True)
    try:
        yield
    finally:
        torch.use_deterministic_algorithms(was_deterministic)
