"""Compare the points of a LAS file with its header, since neither LAS nor LAZ has a checksum.

Some programs edit files without updating the header, so a difference is a warning, not an error.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pcbench.io.files import Warn
from pcbench.io.las_header import LasHeader
from pcbench.io.las_records import AXES, returns_of

_CAUSE = "the header was not updated, or points are damaged"
_ROUNDING_SHARE = 1e-12  # relative rounding difference between writers
_MAX_RETURNS = 15


@dataclass(frozen=True)
class LasCounts:
    """Counts over point records, before filters. Those of two parts of a file can be added with `merge`.

    Attributes:
        count: number of points.
        withheld: points that are marked as withheld.
        wrong_returns: points with a return number above the number of returns of their pulse.
        by_return: points per return number from 0 to 15.
        outside: largest distance by which points exceed the bounds in the header, in x, y and z; negative if inside.
    """

    count: int
    withheld: int
    wrong_returns: int
    by_return: tuple[int, ...]
    outside: tuple[float, ...]

    def merge(self, other: LasCounts) -> LasCounts:
        """Return the counts over the points of both."""
        return LasCounts(
            self.count + other.count,
            self.withheld + other.withheld,
            self.wrong_returns + other.wrong_returns,
            tuple(a + b for a, b in zip(self.by_return, other.by_return, strict=True)),
            tuple(map(max, self.outside, other.outside)),
        )

    def warnings(self, header: LasHeader | None = None) -> list[str]:
        """Return one line for each way in which the points differ from the header, and for withheld points.

        The counts of returns are only compared if these are all points of the file. Without a header, only what the
        points alone show is returned.
        """
        lines = self._differences(header) if header is not None else []
        if self.wrong_returns:
            lines.append(
                f"{self.wrong_returns} of {self.count} points have a return number above the returns of their pulse:"
                " damaged returns"
            )
        if self.withheld:
            lines.append(f"kept {self.withheld} of {self.count} points that are marked as withheld")
        return lines

    def bounds_warnings(self, header: LasHeader) -> list[str]:
        """Return one line for each axis along which points lie outside the bounds in the header."""
        lines = []
        limits = np.abs(header.bounds or np.zeros((2, 3))).max(axis=0)
        for axis, scale, limit, beyond in zip(AXES, header.scales, limits, self.outside, strict=True):
            if beyond > abs(scale) + _ROUNDING_SHARE * limit:
                lines.append(
                    f"points lie up to {beyond:.6g} units outside the header's bounds in {axis.lower()}: {_CAUSE}"
                )
        return lines

    def _differences(self, header: LasHeader) -> list[str]:
        lines = self.bounds_warnings(header)
        counts = self.by_return[1 : len(header.by_return) + 1]
        if self.count == header.count and header.by_return and counts != header.by_return:
            k = next(k for k, pair in enumerate(zip(counts, header.by_return, strict=True)) if pair[0] != pair[1])
            lines.append(f"{counts[k]} points are return {k + 1}, the header states {header.by_return[k]}: {_CAUSE}")
        return lines


def count_records(records: NDArray[Any], header: LasHeader) -> LasCounts:
    """Count what `LasCounts.warnings` compares with the header.

    Args:
        records: point records (N,) of the file, before filters.
        header: header of the file.
    """
    return_numbers, return_counts = returns_of(records, header)
    withheld = records["flags"] & 4 if header.is_extended else records["class_flags"] & 128
    return LasCounts(
        len(records),
        int(np.count_nonzero(withheld)),
        int(np.count_nonzero(return_numbers > return_counts)),
        tuple(np.bincount(return_numbers, minlength=_MAX_RETURNS + 1).tolist()),
        _outside(records, header),
    )


def _outside(records: NDArray[Any], header: LasHeader) -> tuple[float, ...]:
    if header.bounds is None or not len(records):
        return (-np.inf,) * 3
    beyond = []
    for axis, scale, offset, low, high in zip(AXES, header.scales, header.offsets, *header.bounds, strict=True):
        ends = [float(end) * scale + offset for end in (records[axis].min(), records[axis].max())]
        beyond.append(max(low - min(ends), max(ends) - high))
    return tuple(beyond)


def warn_of_rest(header: LasHeader, warn: Warn) -> None:
    """Warn if an uncompressed file has space for more points than its header states."""
    complete = (header.end - header.start) // header.record_bytes
    if complete > header.count:
        warn(f"the header states {header.count} points, the file has space for {complete}: left out the rest")
