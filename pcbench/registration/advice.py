"""What to try where a registration fails: only what can run on this machine, or how to install it."""

from __future__ import annotations

from importlib.util import find_spec

_BY_HAND = "--register points:FILE or matrix:FILE"
_INSTALL = "pip install 'pcbench[global]'"


def align_coarsely() -> str:
    """What helps where a pose is far from the right one."""
    if has_global():
        return (
            "align them from any pose (--register global, or global-similarity where the scale may differ) or coarsely"
            f" first ({_BY_HAND})"
        )
    return f"align them coarsely first ({_BY_HAND}), or from any pose (--register global, after {_INSTALL})"


def find_any_scale() -> str:
    """What finds a pose where units may differ."""
    after = "" if has_global() else f", after {_INSTALL}"
    return f"use --register global-similarity, which finds any pose and scale{after}"


def has_global() -> bool:
    """Whether registration from any pose can run: KISS-Matcher is installed."""
    return find_spec("kiss_matcher") is not None
