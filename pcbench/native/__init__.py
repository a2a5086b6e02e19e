"""Compiled kernels. A missing or broken build raises ImportError at the first import; there is no silent fallback."""

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

__all__ = ["_core"]
