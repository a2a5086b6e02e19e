"""A cloud cut to a region."""

from __future__ import annotations

from pcbench.geometry.cloud import Cloud
from pcbench.geometry.crop import points_inside
from pcbench.geometry.region_text import as_region
from pcbench.geometry.regions import Region
from pcbench.io import CloudLike, to_cloud


def crop(cloud: CloudLike, region: Region | str) -> Cloud:
    """The points of a cloud inside a region, with their normals, colours and attributes.

    Args:
        cloud: the cloud, its points (N, 3), or the path of its file.
        region: in the cloud's coordinates; or its text, see `pcbench.geometry.region_text.parse_region`, where
            `reference` and `quantile:q` speak of this cloud.

    Raises:
        InputError: the text names no region, or no point of the cloud lies inside.
    """
    cloud = to_cloud(cloud)
    found = as_region(region, cloud)
    return cloud if found is None else cloud.select(points_inside(cloud.points, found, region, "the cloud's"))
