"""Round numbers for scale bars, ticks and local origins."""

from __future__ import annotations

import math

import numpy as np

from pcbench.geometry.arrays import FloatArray

_NARROW_RATIO, _WIDE_RATIO = 8.0, 200.0  # of the ends of an axis with even ticks, and with ticks at powers of ten
_NEAR_EXTENTS = 10.0  # coordinates this many times their extent from 0 need no local origin


def round_length(at_most: float) -> float:
    """Return the largest 1, 2 or 5 times a power of ten that is at most `at_most`."""
    power = 10.0 ** np.floor(np.log10(at_most))
    return float(max(step * power for step in (1, 2, 5) if step * power <= at_most * (1 + 1e-9)))


def log_ticks(low: float, high: float) -> list[float]:
    """Return round values from `low` to `high` for a logarithmic axis, few enough for their labels to be apart."""
    if high <= _NARROW_RATIO * low:
        step = round_length((high - low) / 3)
        return [k * step for k in range(math.ceil(low / step), math.floor(high / step) + 1)]
    decades = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    factors = (1, 2, 5) if high <= _WIDE_RATIO * low else (1,)
    values = [factor * 10.0**decade for decade in decades for factor in factors]
    return [value for value in values if low <= value <= high]


def round_origin(low: FloatArray, high: FloatArray) -> FloatArray:
    """Return round coordinates (K,) at or below a lower corner (K,); 0 on axes on which a box is near 0."""
    extent = max(float((high - low).max()), 1e-9)
    step = 10.0 ** np.floor(np.log10(extent))
    far = np.maximum(np.abs(low), np.abs(high)) > _NEAR_EXTENTS * extent
    origin: FloatArray = np.where(far, step * np.floor(low / step), 0.0)
    return origin


def axis_title(name: str, origin: float, unit: str | None) -> str:
    """Return the title of an axis whose coordinates are relative to an origin, such as "x − 637,000 [m]"."""
    offset = f" {'−' if origin > 0 else '+'} {abs(origin):,.15g}" if origin else ""
    return f"{name}{offset}" + (f" [{unit}]" if unit else "")
