"""The reference as registrations need it: computed once, used for every candidate."""

from __future__ import annotations

from functools import cached_property

import numpy as np

from pcbench.errors import InputError
from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.neighbors import Index
from pcbench.geometry.normals import Surface
from pcbench.geometry.voxels import cell_means, robust_extent

_MAX_ROWS = 65_536  # compared at a time: what fits into a processor's cache


class Target:
    """A reference to register candidates to: what does not depend on the candidate is computed once.

    Args:
        surface: of the reference's points minus `local_origin(reference)`.
    """

    def __init__(self, surface: Surface) -> None:
        self.surface = surface
        self._known: Cloud | None = None  # the reference that this was compared with already

    @classmethod
    def of(cls, reference: Cloud, origin: FloatArray | None = None) -> Target:
        """The target of a reference, with its normals where it has some; `origin` is its local origin, if known."""
        origin = local_origin(reference) if origin is None else origin
        target = cls(Surface(Index(reference.points - origin), given=reference.normals))
        target._known = reference
        return target

    @cached_property
    def extent(self) -> float:
        """Diagonal of the box of the inner 98 % of the points, in the reference's unit."""
        return robust_extent(self.surface.points)

    @property
    def spacing(self) -> float:
        """Median distance to the nearest other point, in the reference's unit."""
        return self.surface.spacing

    @cached_property
    def coarse_side(self) -> float:
        """Edge of the voxels of the coarse stage, in the reference's unit."""
        return max(self.extent / 75, self.spacing)

    @cached_property
    def coarse(self) -> Surface:
        """The surface, one mean point a voxel of edge `coarse_side`."""
        return Surface(Index(cell_means(self.surface.points, self.coarse_side)))

    def check_belongs_to(self, reference: Cloud, origin: FloatArray) -> None:
        """Raise InputError unless this target holds the reference's points, minus its local origin (3,), bit for bit.

        A target of another cloud, or about another origin, would give a transform that looks right and is not.
        """
        if reference is self._known:
            return
        ours, theirs = self.surface.points, reference.points
        if len(ours) != len(theirs):
            raise InputError(
                f"expected a target made from this reference's {len(theirs)} points, got one of {len(ours)} points"
            )
        for start in range(0, len(ours), _MAX_ROWS):
            rows = slice(start, start + _MAX_ROWS)
            if not np.array_equal(ours[rows], theirs[rows] - origin):
                raise InputError(
                    "expected a target made from this reference's points minus local_origin(reference), got one of"
                    " other points or about another origin"
                )
        self._known = reference


def local_origin(cloud: Cloud) -> FloatArray:
    """The round point (3,) near a cloud's centre that is subtracted before anything is computed.

    Whole numbers, because subtracting them from coordinates on any binary grid is exact: a cloud at UTM coordinates
    and the same cloud at the origin become the same bits. For a cloud smaller than 1, multiples of a power of two.
    """
    lower, upper = cloud.bounds
    extent = float((upper - lower).max())
    step = 2.0 ** min(0, np.frexp(extent)[1] - 1) if extent > 0 else 2.0**-1000
    center: FloatArray = 0.5 * lower + 0.5 * upper
    return np.floor(center / step) * step if extent > 0 else center
