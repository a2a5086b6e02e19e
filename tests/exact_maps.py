"""Exact depth and normal maps, as an ideal matcher would return them."""

from dataclasses import replace

import numpy as np
import textured_corner as corner

from reconstructors.mvs.maps import DepthMap


def rays(camera):
    """Return world directions (H, W, 3) of unit depth through the pixel centres."""
    k = camera.intrinsics
    x, y = np.meshgrid(np.arange(k.width) + 0.5, np.arange(k.height) + 0.5)
    return np.stack([(x - k.cx) / k.fx, (y - k.cy) / k.fy, np.ones_like(x)], axis=-1) @ camera.cam_from_world.rotation


def plane_map(camera, normal, offset):
    """Return the map of the plane normal . x = offset (unit normal)."""
    normal = np.asarray(normal, dtype=float)
    with np.errstate(divide="ignore"):
        depth = (offset - normal @ camera.position) / (rays(camera) @ normal)
    return _map(camera, np.where(depth > 0, depth, 0), np.broadcast_to(normal, (*depth.shape, 3)))


def corner_map(camera):
    """Return the map of the three planes of `textured_corner`."""
    directions = rays(camera)
    nearest, normals = np.full(directions.shape[:2], np.inf), np.zeros(directions.shape)
    for axis in range(3):
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = -camera.position[axis] / directions[..., axis]
        points = camera.position + depth[..., None] * directions
        in_plane = points[..., [other_axis for other_axis in range(3) if other_axis != axis]]
        is_nearest = (depth > 0) & (depth < nearest) & ((in_plane >= 0) & (in_plane <= corner.SIDE)).all(axis=-1)
        nearest[is_nearest], normals[is_nearest] = depth[is_nearest], np.eye(3)[axis]
    return _map(camera, np.where(np.isfinite(nearest), nearest, 0), normals)


def mesh_map(camera, index):
    """Return the map of a mesh from its index."""
    directions = rays(camera).reshape(-1, 3)
    hits = index.cast(camera.position, directions)
    shape = (camera.intrinsics.height, camera.intrinsics.width)
    normals = index.mesh.normals()[np.maximum(hits.faces, 0)]
    depth = np.where(hits.faces < 0, 0.0, hits.distances)
    return _map(camera, depth.reshape(shape), normals.reshape(*shape, 3))


def _map(camera, depth, normals):
    local = normals @ camera.cam_from_world.rotation.T
    is_facing_camera = np.einsum("hwi,hwi->hw", local, rays(camera) @ camera.cam_from_world.rotation.T) < 0
    local = np.where(is_facing_camera[..., None], local, -local) * (depth > 0)[..., None]
    return DepthMap(depth.astype(np.float32), local.astype(np.float32), (depth > 0).astype(np.float32))


class ExactMatcher:
    """Replaces the matcher by exact maps `make_map(camera)` of the true cameras, in any frame of the views."""

    def __init__(self, cameras, make_map):
        self.cameras, self.make_map, self.matched, self.refined = cameras, make_map, [], []

    def _true_map(self, view):
        return self.make_map(replace(self.cameras[view.camera.name], intrinsics=view.camera.intrinsics))

    def match(self, reference, sources, depth_range, *, levels=3, iterations=3, seed=0):
        self.matched.append((reference, list(sources), depth_range))
        return self._true_map(reference)

    def refine(self, reference, sources, source_depths, initial, depth_range, *, iterations=2, seed=0):
        assert len(sources) == len(source_depths)
        self.refined.append(reference.camera.name)
        return initial

    def install(self, monkeypatch):
        monkeypatch.setattr("reconstructors.mvs.patchmatch.match", self.match)
        monkeypatch.setattr("reconstructors.mvs.patchmatch.refine", self.refine)
        return self
