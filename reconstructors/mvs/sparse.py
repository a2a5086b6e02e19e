"""What is known before any depth: pinhole cameras about a local origin, and sparse points with the images that show
them.
"""

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


@dataclass(frozen=True, eq=False)
class Sparse:
    """Cameras and points of one frame.

    Args:
        cameras: by image name; the order is that of `names`.
        points: (P, 3).
        shows: (P, images), sparse, 1 where an image shows a point.
    """

    cameras: Mapping[str, Camera]
    points: FloatArray
    shows: csc_matrix

    @cached_property
    def names(self) -> tuple[str, ...]:
        return tuple(self.cameras)

    def shown(self, name: str) -> IntArray:
        """The numbers of the points (N,) that an image shows."""
        k = self.names.index(name)
        rows = self.shows.indices[self.shows.indptr[k] : self.shows.indptr[k + 1]]
        return np.asarray(rows, dtype=np.int64)

    def about(self, origin: FloatArray) -> Sparse:
        """The same about an origin (3,): coordinates are small then, and float32 holds them."""
        moved = {name: shifted(camera, origin) for name, camera in self.cameras.items()}
        return replace(self, cameras=moved, points=self.points - origin)


def shifted(camera: Camera, origin: FloatArray) -> Camera:
    """A camera in the frame whose origin is at `origin` (3,) of its own."""
    pose = camera.cam_from_world
    return replace(camera, cam_from_world=Similarity(pose.rotation, pose.translation + pose.rotation @ origin))


def sparse_of(model: Any, cameras: Mapping[str, Camera], least: int = 3) -> Sparse:
    """The points of a model of COLMAP that at least so many images show, in the order of their numbers."""
    from scipy.sparse import csc_matrix

    column = {name: k for k, name in enumerate(cameras)}
    column_of = {int(number): column[image.name] for number, image in model.images.items() if image.name in column}
    points, rows, columns = list[FloatArray](), list[int](), list[int]()
    for _, point in sorted(model.points3D.items()):
        seen = {column_of[e.image_id] for e in point.track.elements if e.image_id in column_of}
        if len(seen) >= least:
            rows += [len(points)] * len(seen)
            columns += sorted(seen)
            points.append(point.xyz)
    shape = (len(points), len(cameras))
    shows = csc_matrix((np.ones(len(rows), np.int8), (rows, columns)), shape=shape)
    return Sparse(cameras, np.array(points, dtype=np.float64).reshape(-1, 3), shows)
