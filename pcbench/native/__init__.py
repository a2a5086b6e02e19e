"""Compiled kernels. A missing or broken build is said at the first import, never silently replaced."""

from pcbench.errors import InputError
from pcbench.threads import fit_threads

fit_threads()
try:
    from pcbench.native import _core
except ImportError as error:  # pragma: no cover - only on a broken installation
    raise ImportError(
        f"pcbench's compiled module does not load ({error}). Reinstall with `pip install --force-reinstall pcbench`,"
        " or run `make` in a source tree."
    ) from error
try:
    _core.isa()
except RuntimeError as error:  # PCBENCH_ISA names a set that is unknown, or that this processor lacks
    raise InputError(str(error)) from None

__all__ = ["_core"]
