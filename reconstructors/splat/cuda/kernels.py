"""The kernels as source: NVRTC compiles it for a GPU, the tests compile it for an emulator on the CPU."""

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
    """One CUDA kernel.

    Attributes:
        name: name of the function and of its file.
        threads: threads per block; `kThreads` in the source.
        headers: files that precede the kernel's own source.
        constants: names and values of further compile-time constants.
    """

    name: str
    threads: int
    headers: tuple[Path, ...] = ()
    constants: tuple[tuple[str, int], ...] = ()

    @property
    def source(self) -> str:
        """The complete source, without includes."""
        constants = (("kThreads", self.threads), *self.constants)
        files = (_HERE / "prelude.cu", *self.headers, _HERE / f"{self.name}.cu")
        definitions = "".join(f"constexpr int {name} = {value};\n" for name, value in constants)
        return definitions + "\n".join(_text(file) for file in files)


class Launcher(Protocol):
    """Runs kernels: a GPU or its emulator."""

    def launch(self, kernel: Kernel, blocks: int, *arguments: Tensor | Scalar | None) -> None:
        """Queue `blocks` blocks of a kernel after the work queued before.

        Args:
            kernel: the kernel.
            blocks: number of blocks.
            arguments: the kernel's arguments; tensors are contiguous, None is a null pointer.
        """
        ...


def project_gaussians(harmonics: int) -> Kernel:
    """Project the Gaussians to splats and count the tiles that each touches."""
    return Kernel("project_gaussians", 128, _MATHS, (("kHarmonics", harmonics),))


def compact() -> Kernel:
    """Compact the Gaussians that touch a tile."""
    return Kernel("compact", 256)


def instances() -> Kernel:
    """Write one instance for each pair of a Gaussian and a tile that it touches."""
    return Kernel("instances", 128, _MATHS)


def blend(geometry: int, borders: bool) -> Kernel:
    """Blend the tiles; with `borders` it also stores the state of the rays for the backward pass."""
    return Kernel("blend", 256, _MATHS, (("kGeometry", geometry), ("kBorders", int(borders))))


def blend_backward(geometry: int) -> Kernel:
    """Compute the gradients with respect to the splats, summed over each tile."""
    return Kernel("blend_backward", 128, _MATHS, (("kGeometry", geometry),))


def project_backward(harmonics: int, geometry: int) -> Kernel:
    """Compute the gradients with respect to the Gaussians from those of the splats."""
    return Kernel("project_backward", 128, _MATHS, (("kHarmonics", harmonics), ("kGeometry", geometry)))


def image_loss() -> Kernel:
    """Compute the SSIM and the absolute difference of two images."""
    return Kernel("image_loss", 256, _WINDOW)


def image_loss_backward() -> Kernel:
    """Compute the gradient of the loss with respect to the image."""
    return Kernel("image_loss_backward", 256, _WINDOW)


def adam() -> Kernel:
    """Apply one step of Adam."""
    return Kernel("adam", 256)


def morton() -> Kernel:
    """Compute the Morton codes of points."""
    return Kernel("morton", 256)


def all_kernels() -> list[Kernel]:
    """Return all kernels with all values of their constants."""
    return [
        *(project_gaussians(count) for count in HARMONICS),
        compact(),
        instances(),
        *(blend(geometry, borders) for geometry in GEOMETRIES for borders in (False, True)),
        *(blend_backward(geometry) for geometry in GEOMETRIES),
        *(project_backward(count, geometry) for count in HARMONICS for geometry in GEOMETRIES),
        image_loss(),
        image_loss_backward(),
        adam(),
        morton(),
    ]


HARMONICS = (1, 4, 9, 16)  # spherical harmonics of degrees 0 to 3
GEOMETRIES = NO_GEOMETRY, DEPTH, NORMALS = 0, 1, 2  # as in maths.h


@cache
def _text(file: Path) -> str:
    return file.read_text(encoding="utf-8").replace("#pragma once\n", "")
