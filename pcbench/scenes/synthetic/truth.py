"""Truth of a photographed city: depth maps, and its surface as a cloud with visibility."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.cameras import Camera
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.mesh import MeshIndex
from pcbench.geometry.visibility import MIN_VISIBLE_VIEWS, views
from pcbench.scenes.synthetic.plan import CityPlan


def depth_map(index: MeshIndex, camera: Camera) -> NDArray[np.float32]:
    """Compute the z-depth (rows, columns) of the surface at the pixel centres in metres; 0 is sky."""
    k = camera.intrinsics
    u, v = np.meshgrid(np.arange(k.width) + 0.5, np.arange(k.height) + 0.5)
    directions = k.directions(np.stack([u.ravel(), v.ravel()], axis=1)) @ camera.cam_from_world.rotation
    hits = index.cast(camera.position, directions)
    depth = np.where(hits.faces < 0, 0.0, hits.distances)  # directions have depth 1
    return depth.reshape(k.height, k.width).astype(np.float32)


def surface_cloud(plan: CityPlan, index: MeshIndex, cameras: Sequence[Camera], count: int, seed: int = 0) -> Cloud:
    """Sample the exposed surface uniformly by area, with normals and the attribute `visible`.

    Buried parts of solids and the ground under buildings are part of the mesh but not of the cloud. `visible` is 1 if
    at least three cameras observe the point.

    Args:
        plan: layout of the city.
        index: index of its mesh.
        cameras: cameras.
        count: number of points.
        seed: random seed.
    """
    # At most a tenth of the area is buried; sampling and dropping it keeps the rest uniform.
    sampled = index.mesh.sample(round(1.3 * count) + 1000, seed)
    exposed = sampled.select(np.flatnonzero(~_is_buried(plan, sampled.points))[:count])
    assert exposed.normals is not None
    visible_mask = views(index, cameras, exposed.points, exposed.normals, enough=MIN_VISIBLE_VIEWS) >= MIN_VISIBLE_VIEWS
    return Cloud(
        exposed.points, normals=exposed.normals, attributes={"visible": visible_mask.astype(np.uint8)}, unit="m"
    )


def _is_buried(plan: CityPlan, points: FloatArray) -> NDArray[np.bool_]:
    """Return which points (N, 3) of the mesh are under the ground or inside a solid."""
    skin = 1e-6  # m: points on a surface are not inside
    buried: NDArray[np.bool_] = points[:, 2] < plan.terrain.at(points[:, 0], points[:, 1]) - skin
    order = np.argsort(points[:, 0], kind="stable")
    x = points[order, 0]
    for solid in plan.solids:
        reach = 0.5 * np.hypot(solid.width, solid.depth)
        near = order[slice(*np.searchsorted(x, [solid.x - reach, solid.x + reach]))]
        buried[near] |= solid.contains(points[near], skin)
    return buried
