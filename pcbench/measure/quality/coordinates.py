"""Points that are copies or stand for missing data, and the steps in which coordinates are stored."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcbench.geometry.arrays import FloatArray, bounds
from pcbench.geometry.quantisation import Quantisation
from pcbench.io.nodata import CoordinateCounts, Nodata

_MIX = (1.0, 0.7548776662466927, 0.5698402909980532)  # points that differ rarely share a sum with these weights


class CoordinateFaults(NamedTuple):
    """Points that are copies or stand for missing data, and rounding.

    Attributes:
        points: number of points of the cloud.
        missing: points that stand for missing data, such as those with z = -9999; see `pcbench.io.nodata`.
        missing_text: which values they have; empty if there are none.
        at_origin: points that are exactly (0, 0, 0), whether they stand for missing data or not.
        copies: points at the exact position of an earlier one.
        steps: steps in which x, y and z are rounded; 0 where none is visible.
        float32_step: largest step that coordinates of this size have in 32-bit floats.
    """

    points: int
    missing: int
    missing_text: str
    at_origin: int
    copies: int
    steps: tuple[float, float, float]
    float32_step: float


def coordinate_faults(points: FloatArray) -> tuple[CoordinateFaults, NDArray[np.bool_]]:
    """Return the faults of points (N, 3), and the mask (N,) of those that stand for missing data."""
    counts = CoordinateCounts.of(points)
    nodata = Nodata.of(counts)
    missing = nodata.mask(points)
    kept = points[~missing]
    steps = Quantisation.of(kept).steps if len(kept) else np.zeros(3)
    largest = max(float(np.abs(corner).max()) for corner in bounds(kept)) if len(kept) else 0.0
    faults = CoordinateFaults(
        points=len(points),
        missing=int(np.count_nonzero(missing)),
        missing_text=nodata.text() if nodata else "",
        at_origin=counts.at_origin,
        copies=_copies(kept),
        steps=(float(steps[0]), float(steps[1]), float(steps[2])),
        float32_step=float(np.spacing(np.float32(min(largest, float(np.finfo(np.float32).max) / 2)))),
    )
    return faults, missing


def _copies(points: FloatArray) -> int:
    """Return the number of points (N, 3) at the exact position of an earlier one."""
    keys = points[:, 0] * _MIX[0] + points[:, 1] * _MIX[1] + points[:, 2] * _MIX[2]
    ordered = np.sort(keys)
    shared = np.unique(ordered[1:][ordered[1:] == ordered[:-1]])  # keys of copies, and of few other points
    possible = points[np.isin(keys, shared)] if len(shared) else points[:0]
    possible = possible[np.lexsort(possible.T)]
    return int(np.count_nonzero((possible[1:] == possible[:-1]).all(axis=1)))
