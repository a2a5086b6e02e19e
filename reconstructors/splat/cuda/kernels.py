"""The kernels as source: what NVRTC compiles for a GPU, and what tests compile for the CPU to emulate one."""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from torch import Tensor

_HERE = Path(__file__).parent
_MATHS = (_HERE.parent / "pinhole.h", _HERE.parent / "maths.h", _HERE / "tiles.cu")
_WINDOW = (_HERE / "window.cu",)

Scalar = ctypes.c_int32 | ctypes.c_int64 | ctypes.c_float


@dataclass(frozen=True)
class Kernel:
    """One function on the GPU.

    Attributes:
        name: of the function and of its file.
        threads: of a block; `kThreads` in the source.
        before: files that the source wants read before its own.
        constants: further numbers that are fixed when it is compiled.
    """

    name: str
    threads: int
    before: tuple[Path, ...] = ()
    constants: tuple[tuple[str, int], ...] = ()

    @property
    def source(self) -> str:
        """The whole text: it includes nothing."""
        constants = (("kThreads", self.threads), *self.constants)
        files = (_HERE / "prelude.cu", *self.before, _HERE / f"{self.name}.cu")
        numbers = "".join(f"constexpr int {name} = {value};\n" for name, value in constants)
        return numbers + "\n".join(_text(file) for file in files)


class Launcher(Protocol):
    """What runs a kernel: a GPU, or what stands in for one."""

    def launch(self, kernel: Kernel, blocks: int, *arguments: Tensor | Scalar | None) -> None:
        """Queue `blocks` blocks of a kernel behind what was queued before.

        Args:
            arguments: as the kernel takes them; tensors are contiguous, None is a null pointer.
        """
        ...


def project_gaussians(harmonics: int) -> Kernel:
    return Kernel("project_gaussians", 128, _MATHS, (("kHarmonics", harmonics),))


def compact() -> Kernel:
    return Kernel("compact", 256)


def instances() -> Kernel:
    return Kernel("instances", 128, _MATHS)


def blend(geometry: bool, borders: bool) -> Kernel:
    return Kernel("blend", 256, _MATHS, (("kGeometry", int(geometry)), ("kBorders", int(borders))))


def blend_backward(geometry: bool) -> Kernel:
    return Kernel("blend_backward", 128, _MATHS, (("kGeometry", int(geometry)),))


def project_backward(harmonics: int, geometry: bool) -> Kernel:
    return Kernel("project_backward", 128, _MATHS, (("kHarmonics", harmonics), ("kGeometry", int(geometry))))


def image_loss() -> Kernel:
    return Kernel("image_loss", 256, _WINDOW)


def image_loss_backward() -> Kernel:
    return Kernel("image_loss_backward", 256, _WINDOW)


def adam() -> Kernel:
    return Kernel("adam", 256)


def morton() -> Kernel:
    return Kernel("morton", 256)


def every_kernel() -> list[Kernel]:
    """All of them, with each set of constants that can come up."""
    flags = (False, True)
    return [
        *(project_gaussians(count) for count in HARMONICS),
        compact(),
        instances(),
        *(blend(geometry, borders) for geometry in flags for borders in flags),
        *(blend_backward(geometry) for geometry in flags),
        *(project_backward(count, geometry) for count in HARMONICS for geometry in flags),
        image_loss(),
        image_loss_backward(),
        adam(),
        morton(),
    ]


HARMONICS = (1, 4, 9, 16)  # of degrees 0 to 3


@cache
def _text(file: Path) -> str:
    return file.read_text(encoding="utf-8").replace("#pragma once\n", "")
