"""Surface normals and surface variation from the k nearest neighbours."""

from __future__ import annotations

from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcbench.errors import InputError
from pcbench.geometry.arrays import FloatArray, IntArray
from pcbench.geometry.neighbors import Index, LocalPlanes, Matches, median_spacing
from pcbench.native import _core


class Normals(NamedTuple):
    """Unit normals (M, 3), their sign chosen upwards, and surface variation (M,): 0 flat, 1/3 shapeless."""

    directions: FloatArray
    variation: FloatArray


def estimate_normals(index: Index, k: int = 20, which: IntArray | None = None) -> Normals:
    """Normals of the indexed points (or those of `which`) from planes through their k nearest points, self included.

    The normal is the eigenvector of the smallest eigenvalue of the neighbours' covariance (Hoppe et al. 1992,
    section 3.2); surface variation is that eigenvalue's share of their sum (Pauly et al. 2002, eq. 3).

    Raises:
        InputError: fewer than three points.
    """
    k = min(k, len(index))
    if k < 3:
        raise InputError(f"expected at least 3 points to estimate normals, got {k}")
    return Normals(*index.local_planes(k, which)[:2])


def plane_normals(points: FloatArray, neighbors: IntArray) -> Normals:
    """Normals, signs as they come, of planes through the points (N, 3) that each row of `neighbors` (M, k) names."""
    directions, variation = np.empty((len(neighbors), 3)), np.empty(len(neighbors))
    _core.plane_fits(points, np.ascontiguousarray(neighbors), directions, variation)
    return Normals(directions, variation)


class Surface:
    """A cloud as a surface: its index, and what is known of its points, computed where it is first asked for and kept.

    Args:
        index: of the points.
        k: neighbours a normal is estimated from.
        given: normals (N, 3) that came with the cloud; only those without a length are estimated.
    """

    def __init__(self, index: Index, k: int = 20, given: FloatArray | None = None) -> None:
        self.index = index
        self.k = k
        self._normals: FloatArray | None = None  # NaN where it is not known
        self._known = np.zeros(len(index), dtype=bool)
        if given is not None:
            self._normals, self._known = unit(given)
            self._normals[~self._known] = np.nan
        self._complete = bool(self._known.all())
        self._variation = np.full(len(index), np.nan, dtype=np.float32)
        self._nearest_other: Matches | None = None

    def __len__(self) -> int:
        return len(self.index)

    @property
    def points(self) -> FloatArray:
        return self.index.points

    @property
    def is_complete(self) -> bool:
        """Whether the normals of all points are known already."""
        return self._complete

    def normals(self, which: IntArray) -> FloatArray:
        """Unit normals (M, 3) at the indices `which` (M,).

        Raises:
            InputError: fewer than three points.
        """
        return self.with_normals_at(which)[which]

    def with_normals_at(self, which: IntArray | None) -> FloatArray:
        """All normals (N, 3), not a copy: unit ones at the indices `which` (M,) (None: at every index), and NaN where
        one was never computed.
        """
        if not self._complete:
            if which is None or len(which) == len(self):
                missing = np.flatnonzero(~self._known)
            else:
                missing = np.unique(which[~self._known[which]])
            if len(missing) == len(self):
                self._normals, self._variation[:], self._nearest_other = self._planes(None)
            elif len(missing):
                directions, self._variation[missing], _ = self._planes(missing)
                self._all_normals()[missing] = directions
            self._known[missing] = True
            self._complete = bool(self._known.all())
        return self._all_normals()

    def _all_normals(self) -> FloatArray:
        if self._normals is None:
            self._normals = np.full((len(self), 3), np.nan)
        return self._normals

    def variation(self, which: IntArray) -> FloatArray:
        """Surface variation (M,) at the indices `which` (M,), to float32's digits: see `estimate_normals`.

        Raises:
            InputError: fewer than three points.
        """
        missing = np.unique(which[np.isnan(self._variation[which])])
        if len(missing):
            self._variation[missing] = self._planes(missing).variation
        return self._variation[which].astype(np.float64)

    @cached_property
    def spacing(self) -> float:
        """See `median_spacing`; of an even sample."""
        return median_spacing(self.index)

    def nearest_other(self) -> Matches:
        """See `Index.nearest_other`."""
        if self._nearest_other is None:
            self._nearest_other = self.index.nearest_other()
        return self._nearest_other

    def _planes(self, which: IntArray | None) -> LocalPlanes:
        if len(self) < 3:
            raise InputError(f"expected at least 3 points to estimate normals, got {len(self)}")
        return self.index.local_planes(min(self.k, len(self)), which)


def orient_towards(directions: FloatArray, points: FloatArray, sensors: FloatArray) -> FloatArray:
    """The same normals (M, 3) with signs such that each looks at its sensor's position (M, 3) or (3,)."""
    away = np.einsum("ni,ni->n", directions, sensors - points) < 0
    return np.where(away[:, None], -directions, directions)


def unit(directions: NDArray[np.float64]) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Directions (M, 3) scaled to length one, and which of them have one (zero vectors stay zero)."""
    length = np.linalg.norm(directions, axis=1)
    valid = np.isfinite(length) & (length > 0)
    scaled = np.divide(directions, length[:, None], out=np.zeros_like(directions), where=valid[:, None])
    return scaled, valid
