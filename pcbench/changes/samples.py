"""Even samples of two aligned clouds, and what each point sees of the other cloud."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pcbench.geometry.arrays import FloatArray, IntArray
from pcbench.geometry.neighbors import Index, Matches
from pcbench.geometry.normals import Surface
from pcbench.geometry.order_statistics import medians_of_rows
from pcbench.geometry.voxels import voxel_downsample

MAX_SAMPLE = 60_000
SIDE_VOXELS = 1.5
_COUNTED_POINTS = 240_000  # even sample that fills nearly all of `MAX_SAMPLE` voxels
_SMOOTHED_POINTS = 8  # nearest points over which distances are smoothed
BALL_POINTS = (8, 12, 24)  # other points in the balls around a point, in which its counterparts are counted
NEIGHBORS = BALL_POINTS[-1]
_BLOCK_POINTS = 8_192  # whose neighbours are searched at a time, to limit memory


@dataclass(frozen=True, eq=False)
class Sample:
    """Even sample of one cloud, N points.

    Attributes:
        rows: (N,) rows in the cloud.
        index: search index over the sample.
        side: length scale of the sample: one and a half sides of the voxels that hold one point each.
    """

    rows: IntArray
    index: Index
    side: float

    @classmethod
    def of(cls, surface: Surface, rows: IntArray, side: float) -> Sample:
        """Return the sample of these points of a cloud, at a length scale."""
        return cls(rows, Index(surface.points[rows]), side)

    def __len__(self) -> int:
        return len(self.rows)

    @property
    def points(self) -> FloatArray:
        """Sampled points (N, 3)."""
        return self.index.points

    @cached_property
    def near(self) -> Matches:
        """Radii (N, B) of the balls that contain `BALL_POINTS` other points of the sample, and some indices.

        The indices (N, 9) are those over which distances are smoothed: the point itself and the nearest others.
        """
        ranks = np.minimum(BALL_POINTS, len(self) - 1)
        smoothed = 1 + min(_SMOOTHED_POINTS, len(self) - 1)
        near = Matches(np.empty((len(self), len(ranks))), np.empty((len(self), smoothed), np.int64))
        for start in range(0, len(self), _BLOCK_POINTS):
            block = slice(start, start + _BLOCK_POINTS)
            distances, indices = self.index.query(self.points[block], int(ranks[-1]) + 1)
            near.distances[block], near.indices[block] = distances[:, ranks], indices[:, :smoothed]
        near.indices[:, 0] = np.arange(len(self))  # copies of a point may come before it
        return near

    @property
    def reach(self) -> FloatArray:
        """Radius (N,) of the largest ball around each point."""
        return self.near.distances[:, -1]

    def smooth(self, values: FloatArray) -> FloatArray:
        """Return the median (N,) of values (N,) over each point and its nearest ones."""
        return medians_of_rows(values, self.near.indices)

    @cached_property
    def areas(self) -> FloatArray:
        """Area (N,) of the surface that each point represents."""
        discs: FloatArray = np.pi * np.square(self.reach) / min(NEIGHBORS, len(self) - 1)
        return discs


def finest_side(reference: Surface, candidate: Surface, noise: float) -> float:
    """Return the length scale at which a sample holds nearly all points, but two standard deviations of the noise.

    At scales beyond the noise, the points around a point lie along the surface rather than across it.
    """
    return max(2 * noise, SIDE_VOXELS * max(reference.spacing, candidate.spacing))


def common_side(reference: Surface, candidate: Surface, finest: float) -> float:
    """Return the length scale at which samples of both clouds have at most `MAX_SAMPLE` points, from the finest one."""
    side = finest
    for surface in (reference, candidate):
        points = surface.index.every(max(1, len(surface) // _COUNTED_POINTS))
        points = points[voxel_downsample(points, side / SIDE_VOXELS)]
        while len(points) > MAX_SAMPLE:
            side *= max(1.05, float(np.sqrt(len(points) / MAX_SAMPLE)))
            points = points[voxel_downsample(points, side / SIDE_VOXELS)]
    return side
