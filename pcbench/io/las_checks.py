"""Check the points of a LAS file against its header, since neither LAS nor LAZ has a checksum."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pcbench.io.files import Warn
from pcbench.io.las_header import LasHeader

_ROUNDING_SHARE = 1e-12  # relative rounding difference between writers


def check_points(
    records: NDArray[Any],
    return_numbers: NDArray[np.uint8],
    return_counts: NDArray[np.uint8],
    header: LasHeader,
    warn: Warn,
) -> None:
    """Warn if points lie outside the header's bounds, or if the return counts differ from the header's.

    Some programs edit files without updating the header, so a difference is a warning, not an error.

    Args:
        records: all point records (N,).
        return_numbers: return number of each point (N,).
        return_counts: number of returns of each point's pulse (N,).
        header: header of the file.
        warn: callback for warnings.
    """
    cause = "the header was not updated, or points are damaged"
    if header.bounds is not None:
        for axis, scale, offset, low, high in zip("XYZ", header.scales, header.offsets, *header.bounds, strict=True):
            ends = [float(end) * scale + offset for end in (records[axis].min(), records[axis].max())]
            beyond = max(low - min(ends), max(ends) - high)
            if beyond > abs(scale) + _ROUNDING_SHARE * max(abs(low), abs(high)):
                warn(f"points lie up to {beyond:.6g} units outside the header's bounds in {axis.lower()}: {cause}")
    if wrong := int(np.count_nonzero(return_numbers > return_counts)):
        warn(f"{wrong} of {len(records)} points have a return number above the returns of their pulse: damaged returns")
    counts = np.bincount(return_numbers, minlength=16)[1 : len(header.by_return) + 1].tolist()
    if header.by_return and counts != list(header.by_return):
        k = next(k for k, pair in enumerate(zip(counts, header.by_return, strict=True)) if pair[0] != pair[1])
        warn(f"{counts[k]} points are return {k + 1}, the header states {header.by_return[k]}: {cause}")
