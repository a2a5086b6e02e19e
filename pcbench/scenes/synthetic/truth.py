"""What is true of a photographed city: depths at the pixels, and its surface as a cloud that knows what was seen."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.cameras import Camera
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.mesh import MeshIndex
from pcbench.geometry.visibility import SEEN_BY, views
from pcbench.scenes.synthetic.plan import CityPlan


def depth_map(index: MeshIndex, camera: Camera) -> NDArray[np.float32]:
    """z-depth (rows, columns) in metres along the rays of the pixels' centres, cast in float64; 0 is sky."""
    k = camera.intrinsics
    u, v = np.meshgrid(np.arange(k.width) + 0.5, np.arange(k.height) + 0.5)
    directions = k.directions(np.stack([u.ravel(), v.ravel()], axis=1)) @ camera.cam_from_world.rotation
    hits = index.cast(camera.position, directions)
    depth = np.where(hits.faces < 0, 0.0, hits.distances)  # directions have depth 1
    return depth.reshape(k.height, k.width).astype(np.float32)


def surface_cloud(plan: CityPlan, index: MeshIndex, cameras: Sequence[Camera], count: int, seed: int = 0) -> Cloud:
    """Points of the exposed surface, uniform by area, with normals and the attribute `visible`.

    What stands in the ground, and the ground under buildings, is part of the mesh but not of the cloud. `visible` is 1
    where at least three cameras see the point.

    Args:
        count: of points.
    """
    # A tenth of the area is buried at most; drawing it and leaving it out keeps the rest uniform.
    drawn = index.mesh.sample(round(1.3 * count) + 1000, seed)
    exposed = drawn.select(np.flatnonzero(~_buried(plan, drawn.points))[:count])
    assert exposed.normals is not None
    seen = views(index, cameras, exposed.points, exposed.normals, enough=SEEN_BY) >= SEEN_BY
    return Cloud(exposed.points, normals=exposed.normals, attributes={"visible": seen.astype(np.uint8)}, unit="m")


def _buried(plan: CityPlan, points: FloatArray) -> NDArray[np.bool_]:
    """Which points (N, 3) of the mesh are under the ground or inside a solid."""
    skin = 1e-6  # m: points of a surface are not inside it
    buried: NDArray[np.bool_] = points[:, 2] < plan.terrain.at(points[:, 0], points[:, 1]) - skin
    order = np.argsort(points[:, 0], kind="stable")
    x = points[order, 0]
    for solid in plan.solids:
        reach = 0.5 * np.hypot(solid.width, solid.depth)
        near = order[slice(*np.searchsorted(x, [solid.x - reach, solid.x + reach]))]
        buried[near] |= solid.contains(points[near], skin)
    return buried
