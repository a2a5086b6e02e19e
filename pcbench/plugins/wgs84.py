"""Conversion of a reconstruction from Earth Studio's sphere to WGS84."""

from __future__ import annotations

from dataclasses import replace

from pcbench.geometry.geodesy import Gps
from pcbench.io.earth_studio import wgs84_from_sphere
from pcbench.plugins.plugin import Reconstruction
from pcbench.scenes.scene import cameras_in_wgs84


def in_wgs84(reconstruction: Reconstruction, origin: Gps) -> Reconstruction:
    """Convert a reconstruction in the frame of Earth Studio's cameras to metres of WGS84 about the same origin.

    Normals are not converted: they would turn by less than 0.2 degrees.
    """
    cloud = replace(reconstruction.cloud, points=wgs84_from_sphere(reconstruction.cloud.points, origin), unit="m")
    return replace(reconstruction, cloud=cloud, cameras=cameras_in_wgs84(reconstruction.cameras, origin))
