"""Clouds cut to a region."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from pcbench.errors import InputError
from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.cloud import Cloud, as_cloud
from pcbench.geometry.region_text import as_region
from pcbench.geometry.regions import Mask, Region


def crop(cloud: Cloud | ArrayLike, region: Region | str) -> Cloud:
    """The points of a cloud inside a region, with their normals, colours and attributes.

    Args:
        cloud: the cloud, or its points (N, 3).
        region: in the cloud's coordinates; or its text, see `pcbench.geometry.region_text.parse_region`, where
            `reference` and `quantile:q` speak of this cloud.

    Raises:
        InputError: the text names no region, or no point of the cloud lies inside.
    """
    cloud = as_cloud(cloud)
    found = as_region(region, cloud)
    return cloud if found is None else cloud.select(points_inside(cloud.points, found, region, "the cloud's"))


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
