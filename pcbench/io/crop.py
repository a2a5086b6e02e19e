"""Crop a cloud to a region."""

from __future__ import annotations

from pcbench.geometry.cloud import Cloud
from pcbench.geometry.crop import points_inside
from pcbench.geometry.region_text import as_region
from pcbench.geometry.regions import Region
from pcbench.io import CloudLike, to_cloud


def crop(cloud: CloudLike, region: Region | str) -> Cloud:
    """Return the points of a cloud inside a region, with their normals, colours and attributes.

    Args:
        cloud: cloud, points (N, 3), or path of a file.
        region: region in the cloud's coordinates, or its text, see `pcbench.geometry.region_text.parse_region`. In a
            text, `reference` and `quantile:q` refer to this cloud.

    Raises:
        InputError: the text does not describe a region, or no point of the cloud lies inside.
    """
    cloud = to_cloud(cloud)
    parsed = as_region(region, cloud)
    return cloud if parsed is None else cloud.select(points_inside(cloud.points, parsed, region, "the cloud's"))
