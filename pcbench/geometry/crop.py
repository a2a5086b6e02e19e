"""Points cut to a region."""

from __future__ import annotations

import numpy as np

from pcbench.errors import InputError
from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.regions import Mask, Region


def points_inside(points: FloatArray, region: Region | None, given: Region | str, whose: str) -> Mask:
    """Mask (N,) of the points inside a region; of all where there is none.

    Args:
        points: (N, 3).
        region: in the same coordinates as the points.
        given: the region as the user gave it, for the message of a refusal.
        whose: the points, in that message: "the reference's".

    Raises:
        InputError: no point lies inside.
    """
    inside = np.ones(len(points), dtype=np.bool_) if region is None else region.contains(points)
    if not inside.any():
        text = given if isinstance(given, str) else given.text
        raise InputError(f"the crop {text!r} leaves none of {whose} {len(points)} points")
    return inside
