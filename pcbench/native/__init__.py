"""Compiled kernels. A missing or broken build raises ImportError at the first import; there is no silent fallback."""

import ctypes
from contextlib import suppress

from pcbench.errors import InputError
from pcbench.threads import limit_threads

limit_threads()
try:
    from pcbench.native import _core
except ImportError as error:  # pragma: no cover - only on a broken installation
    raise ImportError(
        f"pcbench's compiled module does not load ({error}). Reinstall with `pip install --force-reinstall pcbench`,"
        " or run `make` in a source tree."
    ) from error
try:
    _core.isa()
except RuntimeError as error:  # PCBENCH_ISA names an instruction set that is unknown or unsupported here
    raise InputError(str(error)) from None

__all__ = ["_core", "one_kernel_thread"]


def one_kernel_thread() -> None:
    """Give the kernels that the calling thread runs one thread each, because other threads run kernels beside it.

    It is silently omitted where the functions of the OpenMP library cannot be called.
    """
    with suppress(OSError, AttributeError):
        # Names are looked up in the module and in the libraries it is linked to, except on Windows.
        ctypes.CDLL(_core.__file__).omp_set_num_threads(1)
