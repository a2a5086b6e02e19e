"""Clouds cut to a region."""

from __future__ import annotations

from numpy.typing import ArrayLike

from pcbench.errors import InputError
from pcbench.geometry.cloud import Cloud, as_cloud
from pcbench.geometry.region_text import as_region
from pcbench.geometry.regions import Region


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
    if found is None:
        return cloud
    inside = found.contains(cloud.points)
    if not inside.any():
        text = region if isinstance(region, str) else region.text
        raise InputError(f"the crop {text!r} leaves none of the cloud's {len(cloud)} points")
    return cloud.select(inside)
