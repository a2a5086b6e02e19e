"""Kernels on the GPU, without nvcc: NVRTC compiles them at their first use, and the disk keeps what it gives."""

from __future__ import annotations

import hashlib
import os
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pcbench import scratch
from pcbench.errors import MissingExtra
from pcbench.extras import require
from pcbench.systems import rename_open
from reconstructors.splat.cuda.kernels import Kernel, Scalar

if TYPE_CHECKING:
    from torch import Tensor

# No contraction: only what is written as one operation is rounded once, so that the sums are those of the CPU and a
# tile that one kernel counts is a tile that the next one writes.
# 177: a constant of maths.h that this kernel does not use.
_OPTIONS = {"std": "c++17", "fma": False, "diag_suppress": 177}
_LEGACY_STREAM = 1  # the driver's name for the default stream, which torch calls 0


class Gpu:
    """The launcher of one CUDA device: it queues on torch's current stream and waits for nothing.

    Raises:
        MissingExtra: torch, cuda-core or NVRTC is not installed.
    """

    def __init__(self, index: int) -> None:
        self._core = _core()
        self._index = index
        major, minor = self._core.Device(index).compute_capability
        self._architecture = f"sm_{major}{minor}"
        self._loaded: dict[Kernel, Any] = {}

    def launch(self, kernel: Kernel, blocks: int, *arguments: Tensor | Scalar | None) -> None:
        import torch

        with torch.cuda.device(self._index):
            self._core.Device(self._index).set_current()  # of this thread: derivatives are taken on one of torch's
            if kernel not in self._loaded:
                module = self._core.ObjectCode.from_cubin(compiled(kernel, self._architecture))
                self._loaded[kernel] = module.get_kernel(kernel.name)
            stream = self._core.Stream.from_handle(torch.cuda.current_stream().cuda_stream or _LEGACY_STREAM)
            shape = self._core.LaunchConfig(grid=blocks, block=kernel.threads)
            self._core.launch(stream, shape, self._loaded[kernel], *map(self._passed, arguments))

    def _passed(self, argument: Tensor | Scalar | None) -> int | Scalar:
        """As the driver takes it: a pointer is a number."""
        import torch

        if argument is None:
            return 0
        if not isinstance(argument, torch.Tensor):
            return argument
        assert argument.is_contiguous() and argument.get_device() == self._index
        return int(argument.data_ptr())


@cache
def gpu(index: int) -> Gpu:
    """The launcher of a CUDA device, one for all of its users.

    Raises:
        MissingExtra: as `Gpu`.
    """
    return Gpu(index)


def compiled(kernel: Kernel, architecture: str) -> bytes:
    """The cubin of a kernel for an architecture such as sm_90, from the disk where it is known; no GPU is needed.

    It is kept in `pcbench` in XDG_CACHE_HOME (~/.cache), under a name made of all that it depends on. Where nothing can
    be written there it is compiled anew by every process.

    Raises:
        MissingExtra: cuda-core or NVRTC is not installed.
        RuntimeError: it does not compile; the message is NVRTC's log.
    """
    core = _core()
    source = kernel.source
    versions = (core.__version__, *_nvrtc_version())
    name = hashlib.sha256(repr((source, architecture, versions, sorted(_OPTIONS.items()))).encode()).hexdigest()
    file = _cache_folder() / f"{kernel.name}-{name}.cubin"
    with suppress(OSError):
        return file.read_bytes()
    options = core.ProgramOptions(name=f"{kernel.name}.cu", arch=architecture, **_OPTIONS)
    try:
        cubin = bytes(core.Program(source, "c++", options).compile("cubin").code)
    except Exception as error:  # cuda.core has no public name for what NVRTC says
        raise RuntimeError(f"NVRTC does not compile the kernel {kernel.name} for {architecture}: {error}") from error
    with suppress(OSError):
        file.parent.mkdir(parents=True, exist_ok=True)
        with scratch.scratch_file(file) as (path, stream):
            stream.write(cubin)
            rename_open(stream, path, file)
    return cubin


def _cache_folder() -> Path:
    base = os.environ.get("XDG_CACHE_HOME", "")
    return (Path(base) if Path(base).is_absolute() else Path.home() / ".cache") / "pcbench"


@cache
def _core() -> Any:
    require("cuda.bindings.nvrtc")
    return require("cuda.core")


@cache
def _nvrtc_version() -> tuple[int, int]:
    from cuda.bindings import nvrtc

    try:
        status, major, minor = nvrtc.nvrtcVersion()
    except RuntimeError as error:  # the library itself is not there
        raise MissingExtra("NVRTC", "cuda", str(error).splitlines()[0]) from error
    assert status == nvrtc.nvrtcResult.NVRTC_SUCCESS
    return major, minor
