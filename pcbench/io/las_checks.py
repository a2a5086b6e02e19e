"""Do the points of a LAS file agree with what its header says of them? Neither LAS nor LAZ has a checksum."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pcbench.io.files import Warn
from pcbench.io.las_header import LasHeader

_ROUNDING_SHARE = 1e-12  # of a coordinate: what writers differ by in scaling


def check_points(
    records: NDArray[Any], return_numbers: NDArray[np.uint8], return_counts: NDArray[np.uint8], header: LasHeader, warn: Warn
) -> None:
    """Warn where points lie outside the header's bounds, or their returns are not those that it counts.

    Real files have been edited by programs that left the header as it was: a difference is said and not refused.

    Args:
        records: (N,) of all points.
        number, of: (N,) the number of each return, and of the returns of its pulse.
    """
    cause = "the header was not updated, or points are damaged"
    if header.bounds is not None:
        for axis, scale, offset, low, high in zip("XYZ", header.scales, header.offsets, *header.bounds, strict=True):
            ends = [float(end) * scale + offset for end in (records[axis].min(), records[axis].max())]
            beyond = max(low - min(ends), max(ends) - high)
            if beyond > abs(scale) + _ROUNDING_SHARE * max(abs(low), abs(high)):
                warn(f"points lie up to {beyond:.6g} outside the header's bounds in {axis.lower()}: {cause}")
    if wrong := int(np.count_nonzero(return_numbers > return_counts)):
        warn(f"{wrong} of {len(records)} points are a later return than their pulse has: their returns are damaged")
    counts = np.bincount(return_numbers, minlength=16)[1 : len(header.by_return) + 1].tolist()
    if header.by_return and counts != list(header.by_return):
        k = next(k for k, pair in enumerate(zip(counts, header.by_return, strict=True)) if pair[0] != pair[1])
        warn(f"{counts[k]} points are return {k + 1}, the header counts {header.by_return[k]}: {cause}")
