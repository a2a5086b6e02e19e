"""Kernels on the GPU without nvcc: NVRTC compiles them at first use, and a cache on disk keeps the result."""

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

# No contraction into fused multiply-adds: results are rounded as on the CPU, and the kernels that count and write a
# splat's tiles agree on them.
# 177: a constant of maths.h that this kernel does not use.
_OPTIONS = {"std": "c++17", "fma": False, "diag_suppress": 177}
_DIGEST_BYTES = 32  # SHA-256 before a stored cubin
_LEGACY_STREAM = 1  # the driver's handle of the default stream, for which torch has 0


class Gpu:
    """The launcher of one CUDA device: it queues on torch's current stream without synchronisation.

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
        """Queue a kernel on torch's current stream, compiling it at first use."""
        import torch

        with torch.cuda.device(self._index):
            self._core.Device(self._index).set_current()  # per thread: autograd runs backward on another thread
            if kernel not in self._loaded:
                module = self._core.ObjectCode.from_cubin(compile_kernel(kernel, self._architecture))
                self._loaded[kernel] = module.get_kernel(kernel.name)
            stream = self._core.Stream.from_handle(torch.cuda.current_stream().cuda_stream or _LEGACY_STREAM)
            shape = self._core.LaunchConfig(grid=blocks, block=kernel.threads)
            self._core.launch(stream, shape, self._loaded[kernel], *map(self._kernel_argument, arguments))

    def _kernel_argument(self, argument: Tensor | Scalar | None) -> int | Scalar:
        """Return an argument as the driver expects it, a pointer as an integer."""
        import torch

        if argument is None:
            return 0
        if not isinstance(argument, torch.Tensor):
            return argument
        assert argument.is_contiguous() and argument.get_device() == self._index
        return int(argument.data_ptr())


@cache
def gpu(index: int) -> Gpu:
    """Return the launcher of a CUDA device, shared by all users.

    Raises:
        MissingExtra: as `Gpu`.
    """
    return Gpu(index)


def compile_kernel(kernel: Kernel, architecture: str) -> bytes:
    """Return the cubin of a kernel for an architecture such as sm_90, from the cache if possible; no GPU is needed.

    The cache is the folder `pcbench` in XDG_CACHE_HOME (~/.cache); the file name is a hash of everything that the cubin
    depends on, and the file starts with the SHA-256 of the cubin. If the folder is not writable, each process compiles
    the kernel again.

    Raises:
        MissingExtra: cuda-core or NVRTC is not installed.
        RuntimeError: the kernel does not compile; the message has NVRTC's log.
    """
    core = _core()
    source = kernel.source
    versions = (core.__version__, *_nvrtc_version())
    name = hashlib.sha256(repr((source, architecture, versions, sorted(_OPTIONS.items()))).encode()).hexdigest()
    file = _cache_folder() / f"{kernel.name}-{name}.cubin"
    with suppress(OSError):
        stored = file.read_bytes()
        digest, cubin = stored[:_DIGEST_BYTES], stored[_DIGEST_BYTES:]
        if hashlib.sha256(cubin).digest() == digest:
            return cubin
    options = core.ProgramOptions(name=f"{kernel.name}.cu", arch=architecture, **_OPTIONS)
    try:
        cubin = bytes(core.Program(source, "c++", options).compile("cubin").code)
    except Exception as error:  # cuda.core has no public type for NVRTC's errors
        raise RuntimeError(f"NVRTC does not compile the kernel {kernel.name} for {architecture}: {error}") from error
    with suppress(OSError):
        file.parent.mkdir(parents=True, exist_ok=True)
        with scratch.scratch_file(file) as (path, stream):
            stream.write(hashlib.sha256(cubin).digest() + cubin)
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
    except RuntimeError as error:  # the library is not installed
        raise MissingExtra("NVRTC", "cuda", str(error).splitlines()[0]) from error
    assert status == nvrtc.nvrtcResult.NVRTC_SUCCESS
    return major, minor
