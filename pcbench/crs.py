"""Coordinate reference systems as files name them: WKT or an authority code."""

from __future__ import annotations

from typing import Any


def same_crs(first: str, second: str) -> bool:
    """Whether two names mean one system; without pyproj only equal texts do."""
    if first == second:
        return True
    a, b = _parsed(first), _parsed(second)
    return a is not None and b is not None and bool(a.equals(b, ignore_axis_order=True))


def crs_name(text: str) -> str:
    """A short name for messages: the authority code or the system's own name."""
    crs = _parsed(text)
    if crs is None:
        return text if len(text) <= 40 else f"{text[:37]}..."
    authority = crs.to_authority(min_confidence=100)
    return ":".join(authority) if authority else str(crs.name)


def is_known(text: str | None) -> bool:
    """Whether pyproj is installed and knows this system."""
    return text is not None and _parsed(text) is not None


def _parsed(text: str) -> Any | None:
    try:
        from pyproj import CRS
        from pyproj.exceptions import CRSError
    except ImportError:
        return None
    try:
        return CRS.from_user_input(text)
    except CRSError:
        return None
