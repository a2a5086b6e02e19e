"""Colours of distances, in files and pictures alike, without a plotting library: the maps, and the ranges they span."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pcbench.geometry.arrays import FloatArray

COMPARABLE = 5.0
"""Candidates share a range where none of their 95th percentiles is more than so many times the smallest."""

SERIES = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#7f7f7f")
"""Colours of curves and markers: those of Okabe and Ito, which colour-blind readers tell apart, and grey."""

# viridis (van der Walt and Smith 2015) at even places of its upper 87 %, which stand out from a dark ground: its
# lightness grows evenly, so it is read alike with every kind of colour blindness, and in grey.
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
    """What colours span.

    Attributes:
        note: how it was found, in words: whose it is beside the candidate's.
        signed: whether the middle, zero, is what other values are told from.
    """

    low: float
    high: float
    note: str = ""
    signed: bool = False

    @property
    def table(self) -> FloatArray:
        """Colours (K, 3) from 0 to 255 at even places from `low` to `high`."""
        return DIVERGING if self.signed else SEQUENTIAL

    def colors(self, values: FloatArray) -> NDArray[np.uint8]:
        """RGB (N, 3) of values (N,), clipped outside the range."""
        place = np.clip((values - self.low) / (self.high - self.low), 0, 1) * (len(self.table) - 1)
        anchors = np.arange(len(self.table))
        channels = [np.interp(place, anchors, channel) for channel in self.table.T]
        colors: NDArray[np.uint8] = np.rint(np.stack(channels, axis=1)).astype(np.uint8)
        return colors


def largest_but_strays(values: FloatArray) -> float:
    """The 95th percentile of |value|: what lies far off does not decide. 0 where there are no values."""
    return float(np.percentile(np.abs(values), 95)) if len(values) else 0.0


def ranges(
    highest: Mapping[str, float], *, spacing: float = 0.0, signed: bool = False, given: float | None = None
) -> dict[str, Range]:
    """The range of each candidate, shared among those that are comparable: one that is far off has its own, and the
    others' are what they would be without it.

    Args:
        highest: of each candidate's values, as `largest_but_strays` finds them.
        spacing: of the reference. Values of less than its millionth are rounding: such a range ends at the spacing.
        signed: whether there are values below zero.
        given: the end of all ranges, where a user wants that one.
    """
    if given is not None:
        return {name: _range(given, signed, "range as given") for name in highest}
    least = 1e-6 * spacing
    found: dict[str, Range] = {}
    left = sorted(highest, key=lambda name: highest[name])
    while left:
        reach = COMPARABLE * max(highest[left[0]], least)
        group = [name for name in left if highest[name] <= reach]
        left = left[len(group) :]
        high = highest[group[-1]]
        if high > least:
            note = f"up to the {'largest ' if len(group) > 1 else ''}95th percentile"
            if len(group) > 1:
                all_of_them = "both" if len(group) == 2 else f"all {len(group)}"
                note += (
                    f", shared by {all_of_them if len(group) == len(highest) else f'{len(group)} of {len(highest)}'}"
                )
            elif len(highest) > 1:
                note += f", of this one of {len(highest)} alone"
        else:
            high, note = spacing or 1.0, "no distance that is more than rounding"
        found |= dict.fromkeys(group, _range(high, signed, note))
    return {name: found[name] for name in highest}


def _range(high: float, signed: bool, note: str) -> Range:
    return Range(-high if signed else 0.0, high, note, signed)
