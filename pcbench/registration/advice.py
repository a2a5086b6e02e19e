"""Advice for failed registrations: methods that can run on this machine, or how to install them."""

from __future__ import annotations

from pcbench.extras import import_problem

_COARSE_ALIGNMENT = "--register points:FILE or matrix:FILE"
_INSTALL = "pip install 'pcbench[global]'"


def align_coarsely() -> str:
    """Return advice for a pose that is far from the right one."""
    if has_global():
        return (
            "align them from any pose (--register global, or global-similarity if the scale may differ) or coarsely"
            f" first ({_COARSE_ALIGNMENT})"
        )
    return f"align them coarsely first ({_COARSE_ALIGNMENT}), or from any pose (--register global, after {_INSTALL})"


def find_any_scale() -> str:
    """Return advice for clouds whose units may differ."""
    after = "" if has_global() else f", after {_INSTALL}"
    return f"use --register global-similarity (any pose and scale){after}"


def has_global() -> bool:
    """Return whether registration from any pose can run: KISS-Matcher is installed and loads."""
    return import_problem("kiss_matcher") is None
