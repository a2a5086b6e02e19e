"""Colour maps and colour ranges of distances, for files and pictures; they need no plotting library."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pcbench.geometry.arrays import FloatArray

MAX_SHARED_RATIO = 5.0
"""Largest ratio of the 95th percentiles of candidates that share a colour range."""

# The colour-blind safe palette of Okabe and Ito.
BLUE, VERMILION, GREEN, PURPLE, ORANGE, SKY = "#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9"
SERIES = (BLUE, VERMILION, GREEN, PURPLE, ORANGE, SKY, "#7f7f7f")
"""Colours of curves and markers."""

# viridis (van der Walt and Smith 2015), sampled evenly over its upper 87 %, which contrasts with a dark background. Its
# lightness grows evenly, so it is readable in grey and with any colour blindness.
SEQUENTIAL = np.array(
    [
        [71, 46, 124],
        [64, 70, 136],
        [54, 92, 141],
        [45, 113, 142],
        [37, 131, 142],
        [31, 150, 139],
        [35, 169, 131],
        [61, 188, 116],
        [101, 203, 94],
        [149, 216, 64],
        [202, 225, 31],
        [253, 231, 37],
    ],
    dtype=np.float64,
)
# Moreland 2009, "Diverging color maps for scientific visualization", from blue through grey to red.
DIVERGING = np.array(
    [
        [59, 76, 192],
        [98, 130, 234],
        [141, 176, 254],
        [185, 208, 249],
        [221, 220, 220],
        [245, 196, 172],
        [244, 152, 122],
        [221, 95, 75],
        [180, 4, 38],
    ],
    dtype=np.float64,
)


@dataclass(frozen=True)
class Range:
    """A colour range.

    Attributes:
        low: value of the first colour.
        high: value of the last colour.
        note: how the range was chosen, and which candidates share it.
        signed: whether the range is symmetric about zero, with a diverging colour map.
        is_closed: whether no value is beyond the range; else its bar ends in arrows.
    """

    low: float
    high: float
    note: str = ""
    signed: bool = False
    is_closed: bool = False

    @property
    def table(self) -> FloatArray:
        """Colours (K, 3), 0 to 255, at even steps from `low` to `high`."""
        return DIVERGING if self.signed else SEQUENTIAL

    def colors(self, values: FloatArray) -> NDArray[np.uint8]:
        """Return the RGB colours (N, 3) of values (N,), clipped to the range."""
        position = np.clip((values - self.low) / (self.high - self.low), 0, 1) * (len(self.table) - 1)
        anchors = np.arange(len(self.table))
        channels = [np.interp(position, anchors, channel) for channel in self.table.T]
        colors: NDArray[np.uint8] = np.rint(np.stack(channels, axis=1)).astype(np.uint8)
        return colors


@dataclass(frozen=True, eq=False)
class Classes:
    """Colours of the few values of an integer attribute.

    Attributes:
        values: (K,) values, ascending.
        names: names of the values, for a legend.
        table: (K, 3) colours, 0 to 255.
    """

    values: FloatArray
    names: tuple[str, ...]
    table: FloatArray

    def colors(self, values: FloatArray) -> NDArray[np.uint8]:
        """Return the RGB colours (N, 3) of values (N,), each of which is one of `self.values`."""
        colors: NDArray[np.uint8] = self.table.astype(np.uint8)[np.searchsorted(self.values, values)]
        return colors


def robust_maximum(values: FloatArray) -> float:
    """Return the 95th percentile of |values|, which is robust against outliers; 0 without values."""
    return float(np.percentile(np.abs(values), 95)) if len(values) else 0.0


def ranges(
    highest: Mapping[str, float], *, spacing: float = 0.0, signed: bool = False, end: float | None = None
) -> dict[str, Range]:
    """Return the colour range of each candidate; candidates with similar maxima share one.

    A candidate with much larger distances gets a separate range and does not affect those of the others.

    Args:
        highest: robust maximum of each candidate's values.
        spacing: spacing of the reference. A maximum below a millionth of it is rounding; its range ends at the spacing.
        signed: whether values can be negative.
        end: the end of all ranges, if the user sets it.
    """
    if end is not None:
        return {name: _range(end, signed, "range set by the user") for name in highest}
    rounding = 1e-6 * spacing
    result: dict[str, Range] = {}
    remaining = sorted(highest, key=lambda name: highest[name])
    while remaining:
        limit = MAX_SHARED_RATIO * max(highest[remaining[0]], rounding)
        group = [name for name in remaining if highest[name] <= limit]
        remaining = remaining[len(group) :]
        high = highest[group[-1]]
        if high > rounding:
            note = f"up to the {'largest ' if len(group) > 1 else ''}95th percentile"
            if len(group) > 1:
                sharing = "both candidates" if len(group) == 2 else f"all {len(group)} candidates"
                if len(group) < len(highest):
                    sharing = f"{len(group)} of {len(highest)} candidates"
                note += f", shared by {sharing}"
            elif len(highest) > 1:
                note += ", of this candidate only"
        else:
            high, note = spacing or 1.0, "all distances are within rounding"
        result |= dict.fromkeys(group, _range(high, signed, note))
    return {name: result[name] for name in highest}


def ranges_of(values: Mapping[str, FloatArray], *, spacing: float = 0.0, end: float | None = None) -> dict[str, Range]:
    """Return the colour range of each candidate's values, which are signed if any of them is negative.

    Args:
        values: values of each candidate, NaN if unknown; at least one is known.
        spacing: as in `ranges`.
        end: as in `ranges`.
    """
    finite = {name: scalars[np.isfinite(scalars)] for name, scalars in values.items()}
    signed = any(bool((scalars < 0).any()) for scalars in finite.values())
    highest = {name: robust_maximum(scalars) for name, scalars in finite.items()}
    return ranges(highest, spacing=spacing, signed=signed, end=end)


def has_colors(colors: NDArray[np.uint8] | None) -> bool:
    """Return whether a cloud has colours (N, 3); those of many LAS files are all zero."""
    return colors is not None and bool(colors.any())


def height_range(heights: FloatArray) -> Range:
    """Return the range of colours that show heights (N,): their inner 99 %."""
    low, high = (float(height) for height in np.percentile(heights, [0.5, 99.5]))
    return Range(low, max(high, low + max(1e-12, 1e-9 * abs(low))))


def _range(high: float, signed: bool, note: str) -> Range:
    return Range(-high if signed else 0.0, high, note, signed)
