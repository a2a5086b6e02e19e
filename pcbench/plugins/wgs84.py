"""A reconstruction in metres of Earth Studio's sphere, brought to those of WGS84."""

from __future__ import annotations

from dataclasses import replace

from pcbench.geometry.geodesy import Gps
from pcbench.io.earth_studio import wgs84_from_sphere
from pcbench.plugins.plugin import Reconstruction
from pcbench.scenes.scene import cameras_in_wgs84


def in_wgs84(made: Reconstruction, origin: Gps) -> Reconstruction:
    """A reconstruction in the world of Earth Studio's cameras, with its points and cameras in metres of WGS84 about the
    same origin. Normals stay as they are: they turn by less than 0.2 degrees.
    """
    cloud = replace(made.cloud, points=wgs84_from_sphere(made.cloud.points, origin), unit="m")
    return replace(made, cloud=cloud, cameras=cameras_in_wgs84(made.cameras, origin))
