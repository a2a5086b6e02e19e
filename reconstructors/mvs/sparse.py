"""Pinhole cameras about a local origin, and sparse points with the images that observe them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from pcbench.geometry.arrays import FloatArray, IntArray
from pcbench.geometry.cameras import Camera
from pcbench.geometry.transform import Similarity

if TYPE_CHECKING:
    from scipy.sparse import csc_matrix

_MIN_VIEWS = 3  # images that observe a point; a wrong match of only two images may put it anywhere along a ray


@dataclass(frozen=True, eq=False)
class SparseModel:
    """Cameras and sparse points in one frame.

    Args:
        cameras: by image name; `names` has their order.
        points: (P, 3).
        visibility: (P, images), sparse, 1 if an image observes a point.
    """

    cameras: Mapping[str, Camera]
    points: FloatArray
    visibility: csc_matrix

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the images, in the order of the columns of `visibility`."""
        return tuple(self.cameras)

    def observed_points(self, name: str) -> IntArray:
        """Return the indices (N,) of the points that an image observes."""
        k = self.names.index(name)
        rows = self.visibility.indices[self.visibility.indptr[k] : self.visibility.indptr[k + 1]]
        return np.asarray(rows, dtype=np.int64)

    def recenter(self, origin: FloatArray) -> SparseModel:
        """Return the model relative to an origin (3,); small coordinates are accurate in float32."""
        moved = {name: recenter_camera(camera, origin) for name, camera in self.cameras.items()}
        return replace(self, cameras=moved, points=self.points - origin)


def recenter_camera(camera: Camera, origin: FloatArray) -> Camera:
    """Return a camera in the frame whose origin is at `origin` (3,)."""
    pose = camera.cam_from_world
    return replace(camera, cam_from_world=Similarity(pose.rotation, pose.translation + pose.rotation @ origin))


def without_points(cameras: Mapping[str, Camera]) -> SparseModel:
    """Return a model of cameras only."""
    from scipy.sparse import csc_matrix

    return SparseModel(cameras, np.empty((0, 3)), csc_matrix((0, len(cameras)), dtype=np.int8))


def sparse_from_colmap(model: Any, cameras: Mapping[str, Camera]) -> SparseModel:
    """Return the points of a COLMAP model that three images observe, or both of two, in the order of their ids."""
    from scipy.sparse import csc_matrix

    min_views = min(_MIN_VIEWS, len(cameras))
    column = {name: k for k, name in enumerate(cameras)}
    column_of = {int(number): column[image.name] for number, image in model.images.items() if image.name in column}
    points, rows, columns = list[FloatArray](), list[int](), list[int]()
    for _, point in sorted(model.points3D.items()):
        observers = {column_of[e.image_id] for e in point.track.elements if e.image_id in column_of}
        if len(observers) >= min_views:
            rows += [len(points)] * len(observers)
            columns += sorted(observers)
            points.append(point.xyz)
    shape = (len(points), len(cameras))
    visibility = csc_matrix((np.ones(len(rows), np.int8), (rows, columns)), shape=shape)
    return SparseModel(cameras, np.array(points, dtype=np.float64).reshape(-1, 3), visibility)
