"""Selection of the points inside a region."""

from __future__ import annotations

import numpy as np

from pcbench.errors import InputError
from pcbench.geometry.arrays import FloatArray, bounds
from pcbench.geometry.regions import Mask, Region


def points_inside(
    points: FloatArray, region: Region | None, requested: Region | str, owner: str, origin: FloatArray | None = None
) -> Mask:
    """Return the mask (N,) of the points inside a region, or of all points if `region` is None.

    Args:
        points: (N, 3) coordinates.
        region: region in the coordinates of the points, or None.
        requested: the region as the user wrote it, for the error message.
        owner: owner of the points in the error message, such as "the reference's".
        origin: (3,) origin of the coordinates of the points, for the error message; default: 0.

    Raises:
        InputError: no point lies inside.
    """
    if region is None:
        return np.broadcast_to(np.True_, len(points))  # takes no memory
    inside = region.contains(points)
    if not inside.any():
        text = requested if isinstance(requested, str) else requested.text
        corners = bounds(points) if origin is None else [corner + origin for corner in bounds(points)]
        extent = ", ".join(f"{axis} {low:,.6g} to {high:,.6g}" for axis, low, high in zip("xyz", *corners, strict=True))
        raise InputError(
            f"the crop {text!r} leaves none of {owner} {len(points):,} points ({extent}): check its numbers, the"
            " coordinate system and the unit"
        )
    return inside
