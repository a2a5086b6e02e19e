"""Remove points that a scanner or an export added to a cloud."""

from __future__ import annotations

import numpy as np

from pcbench.errors import InputError
from pcbench.geometry.closure import merged_positions
from pcbench.geometry.cloud import Cloud


def without_zeros(cloud: Cloud) -> Cloud:
    """Return the cloud without points at exactly (0, 0, 0), which scanners write for rays without a return.

    Raises:
        InputError: no point remains.
    """
    measured = np.flatnonzero(cloud.points.any(axis=1))
    if not len(measured):
        raise InputError("expected points besides those at x = y = z = 0, got none: leave out --drop-zero")
    return cloud.select(measured)


def without_duplicates(cloud: Cloud) -> Cloud:
    """Return the first of the points at each exact position, in the order of the cloud, with its attributes."""
    firsts = np.unique(merged_positions(cloud.points))
    return cloud.select(firsts)
