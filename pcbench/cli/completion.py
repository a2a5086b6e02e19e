"""Names that completion offers for the values of options and arguments."""

from __future__ import annotations

from collections.abc import Iterable


def method_names() -> Iterable[str]:
    """Return the methods of registration."""
    from pcbench.registration.methods import METHODS

    return METHODS


def bench_method_names() -> Iterable[str]:
    """Return the methods of registration, and `gauge` of `pcbench bench`."""
    return ("gauge", *method_names())


def metric_names() -> Iterable[str]:
    """Return the installed user-defined metrics."""
    from pcbench.measure.own_metrics import installed_metrics

    return installed_metrics()


def protocol_names() -> Iterable[str]:
    """Return the protocols of `pcbench evaluate`."""
    from pcbench.measure.protocols.registry import PROTOCOLS

    return PROTOCOLS


def reconstructor_names() -> Iterable[str]:
    """Return the installed reconstructors."""
    from pcbench.plugins import installed_reconstructors

    return installed_reconstructors()
