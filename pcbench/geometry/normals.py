"""Surface normals and surface variation from the k nearest neighbours."""

from __future__ import annotations

from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcbench.errors import InputError
from pcbench.geometry.arrays import FloatArray, IntArray, bounds
from pcbench.geometry.neighbors import Index, LocalPlanes, Matches
from pcbench.geometry.regions import Region
from pcbench.geometry.sampling import Sampling, sampling_of
from pcbench.geometry.voxels import voxel_downsample
from pcbench.native import _core

_SWEEP_SHARE = 0.7  # selected points take 1.5 times as long as those of a sweep over all, which gives the same bits
_MAX_SWEPT_POINTS = 10_000  # of a cloud whose normals are all computed at once: many small requests take longer


class Normals(NamedTuple):
    """Unit normals (M, 3), oriented upwards, and surface variation (M,), from 0 (flat) to 1/3 (isotropic)."""

    directions: FloatArray
    variation: FloatArray


def estimate_normals(index: Index, k: int = 20, rows: IntArray | None = None) -> Normals:
    """Estimate normals at the indexed points, or at those in `rows`, from planes through their k nearest points.

    A normal is the eigenvector of the smallest eigenvalue of the neighbours' covariance (Hoppe et al. 1992, section
    3.2); surface variation is the share of that eigenvalue in the sum of the eigenvalues (Pauly et al. 2002, eq. 3).

    Args:
        index: index of the points (N, 3).
        k: number of neighbours, the point itself included.
        rows: indices (M,) of the points; None for all.

    Raises:
        InputError: there are fewer than three points.
    """
    k = min(k, len(index))
    if k < 3:
        raise InputError(f"expected at least 3 points to estimate normals, got {k}")
    return Normals(*index.local_planes(k, rows)[:2])


def plane_normals(points: FloatArray, neighbors: IntArray) -> Normals:
    """Fit planes to the points (N, 3) listed in each row of `neighbors` (M, k); the signs of normals are arbitrary."""
    directions, variation = np.empty((len(neighbors), 3)), np.empty(len(neighbors))
    _core.plane_fits(points, np.ascontiguousarray(neighbors), directions, variation)
    return Normals(directions, variation)


class Surface:
    """A cloud as a surface: its index, and properties of its points that are computed on demand and cached.

    Args:
        index: index of the points.
        k: number of neighbours from which a normal is estimated.
        is_even: whether the points are spread evenly. If it is not known, normals are estimated from more neighbours
            where the points have copies or lie in lines.
        normals: normals (N, 3) supplied with the cloud; normals are estimated only for rows of zero length.
    """

    def __init__(self, index: Index, k: int = 20, normals: FloatArray | None = None, *, is_even: bool = True) -> None:
        self.index = index
        self._positions, self._is_even = k, is_even
        self._normals: FloatArray | None = None  # NaN where not yet computed
        self._is_known = np.zeros(len(index), dtype=bool)
        if normals is not None:
            self._normals, self._is_known = unit(normals)
            self._normals[~self._is_known] = np.nan
        self._is_complete = bool(self._is_known.all())
        self._variation = np.full(len(index), np.nan, dtype=np.float32)
        self._nearest_other: Matches | None = None

    def __len__(self) -> int:
        return len(self.index)

    @property
    def points(self) -> FloatArray:
        """The indexed points (N, 3)."""
        return self.index.points

    @cached_property
    def k(self) -> int:
        """Number of neighbours from which a normal is estimated, the point itself included."""
        k = self._positions if self._is_even else self.sampling.plane_neighbors(self._positions)
        return min(k, len(self))

    @property
    def is_complete(self) -> bool:
        """Return whether the normals of all points are available."""
        return self._is_complete

    @property
    def has_normals(self) -> bool:
        """Return whether the points have normals or there are enough to estimate them."""
        return len(self) >= 3 or self.is_complete

    def normals(self, rows: IntArray) -> FloatArray:
        """Return unit normals (M, 3) at the indices `rows` (M,).

        Raises:
            InputError: there are fewer than three points.
        """
        return self.compute_normals(rows)[rows]

    def plane_offsets(self, points: FloatArray, rows: IntArray) -> FloatArray:
        """Return signed distances (M,) of points (M, 3) from the tangent planes at the indices `rows` (M,).

        Raises:
            InputError: there are fewer than three points.
        """
        offsets: FloatArray = np.einsum("ni,ni->n", points - self.points[rows], self.normals(rows))
        return offsets

    def compute_normals(self, rows: IntArray | None) -> FloatArray:
        """Compute the normals at the indices `rows` (M,), or at all points if None, and return those of all points.

        The result (N, 3) is not a copy: unit normals where computed, NaN elsewhere.
        """
        if not self._is_complete:
            if rows is None or len(rows) == len(self) or 0 < len(rows) <= len(self) <= _MAX_SWEPT_POINTS:
                missing = np.flatnonzero(~self._is_known)
            else:
                is_missing = np.zeros(len(self), dtype=bool)
                is_missing[rows] = True
                missing = np.flatnonzero(is_missing & ~self._is_known)
            if len(missing) == len(self):
                self._normals, self._variation[:], self._nearest_other, _ = self._planes(None)
            elif len(missing) > _SWEEP_SHARE * len(self):
                directions, variation, self._nearest_other, _ = self._planes(None)
                self._normals_array()[missing], self._variation[missing] = directions[missing], variation[missing]
            elif len(missing):
                directions, self._variation[missing], *_ = self._planes(missing)
                self._normals_array()[missing] = directions
            self._is_known[missing] = True
            self._is_complete = bool(self._is_known.all())
        return self._normals_array()

    def _normals_array(self) -> FloatArray:
        if self._normals is None:
            self._normals = np.full((len(self), 3), np.nan)
        return self._normals

    def variation(self, rows: IntArray) -> FloatArray:
        """Return surface variation (M,) at the indices `rows` (M,), in float32 precision; see `estimate_normals`.

        Raises:
            InputError: there are fewer than three points.
        """
        missing = np.unique(rows[np.isnan(self._variation[rows])])
        if len(missing):
            self._variation[missing] = self._planes(missing).variation
        return self._variation[rows].astype(np.float64)

    @cached_property
    def sampling(self) -> Sampling:
        """Sampling, with the spacing from an even sample of the points; see `pcbench.geometry.sampling`."""
        return sampling_of(self.index)

    @property
    def spacing(self) -> float:
        """Median spacing from an even sample of the points; see `median_spacing`."""
        return self.sampling.spacing

    @cached_property
    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """Lowest and highest corner (3,) of the points."""
        return bounds(self.points)

    @property
    def corner(self) -> FloatArray:
        """Lowest corner (3,) of the points."""
        return self.bounds[0]

    def first_in_cells(self, side: float, region: Region | None = None) -> IntArray:
        """Return the rows of the first point inside a region in each occupied cell of an edge length.

        Cells count from the lowest corner of all points; see `voxel_downsample`.
        """
        rows = None if region is None else np.flatnonzero(region.contains(self.points))
        return voxel_downsample(self.points, side, rows, self.corner)

    def take_nearest_other(self) -> Matches:
        """Return the nearest other point of each point, see `Index.nearest_other`, and keep them no longer.

        They cost nothing after the normals of all points were computed.
        """
        nearest_other, self._nearest_other = self._nearest_other, None
        return self.index.nearest_other() if nearest_other is None else nearest_other

    def _planes(self, rows: IntArray | None) -> LocalPlanes:
        if len(self) < 3:
            raise InputError(f"expected at least 3 points to estimate normals, got {len(self)}")
        return self.index.local_planes(self.k, rows)


def unit(directions: NDArray[np.float64]) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Scale vectors (M, 3) to unit length, and return a mask (M,) of those with a positive, finite length.

    All other vectors become zero.
    """
    length = np.linalg.norm(directions, axis=1)
    valid = np.isfinite(length) & (length > 0)
    scaled = np.divide(directions, length[:, None], out=np.zeros_like(directions), where=valid[:, None])
    return scaled, valid
