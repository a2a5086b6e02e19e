"""Reference data for registration, computed once and used for all candidates."""

from __future__ import annotations

import copy
from functools import cached_property

import numpy as np

from pcbench.errors import InputError
from pcbench.geometry.arrays import FloatArray, random_rows
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.neighbors import Index
from pcbench.geometry.normals import Surface
from pcbench.geometry.sampling import median_spacing
from pcbench.geometry.voxels import cell_means, robust_extent
from pcbench.io.nodata import MIN_ABSURD
from pcbench.registration.contrast import roughness

MIN_EXTENT = 1e-150  # of a reference: squares of smaller values underflow
_MEDIAN_POINTS = 100_000  # as in an evenly thinned cloud on disk
_BLOCK_ROWS = 65_536  # rows compared at a time: fits into the processor's cache
_MAX_NOISE_SAMPLE = 30_000  # points for a candidate's noise: sparse enough to include blur
_MAX_CANDIDATE_SPACING = 1 / 500  # of the extent: sparse points are not inaccurate


class Target:
    """Reference for registration: precomputed data that do not depend on the candidate.

    Args:
        surface: surface of the reference's points minus `local_origin(reference)`.
        is_sampled: whether the points are samples of a mesh. Their spacing is arbitrary, so that candidates set the
            lengths, see `for_candidate`.
    """

    def __init__(self, surface: Surface, *, is_sampled: bool = False) -> None:
        self.surface = surface
        self.is_sampled = is_sampled
        self._candidate_spacing = 0.0
        self._checked_reference: Cloud | None = None  # reference that is known to match this target

    @classmethod
    def of(cls, reference: Cloud, origin: FloatArray | None = None, *, is_sampled: bool = False) -> Target:
        """Build the target of a reference, with its normals if it has any.

        Args:
            reference: the reference, or the samples of a mesh.
            origin: its local origin (3,), if known.
            is_sampled: whether it was sampled.
        """
        origin = local_origin(reference) if origin is None else origin
        surface = Surface(Index(reference.points - origin), normals=reference.normals, is_even=False)
        target = cls(surface, is_sampled=is_sampled)
        target._checked_reference = reference
        return target

    @cached_property
    def extent(self) -> float:
        """Diagonal of the box of the inner 98 % of the points, in the reference's unit."""
        return robust_extent(self.surface.points)

    @property
    def spacing(self) -> float:
        """Median distance to the nearest other point, in the reference's unit; see `for_candidate` for a mesh."""
        return max(self.surface.spacing, self._candidate_spacing)

    def for_candidate(self, points: FloatArray, scale: float = 1.0) -> Target:
        """Return the target with lengths from a candidate if the reference is a mesh; otherwise this target.

        Five spacings of a million samples of a mesh can be less than a pixel of the photographs that a candidate was
        made from. Its points would then lie off the mesh although they are right. The spacing becomes that of the
        candidate, or the noise of the candidate if that is larger.

        Args:
            points: (N, 3) the candidate's points.
            scale: approximate scale from the candidate to the reference.
        """
        if not self.is_sampled or len(points) < 3:
            return self
        spacing = min(median_spacing(Index(points)), _MAX_CANDIDATE_SPACING * self.extent / scale)
        noise = roughness(random_rows(points, _MAX_NOISE_SAMPLE))
        adapted = copy.copy(self)
        adapted.__dict__.pop("coarse_side", None)
        adapted.__dict__.pop("coarse", None)
        adapted._candidate_spacing = scale * max(spacing, noise)
        return adapted

    @cached_property
    def coarse_side(self) -> float:
        """Edge of the voxels of the coarse stage, in the reference's unit."""
        return max(self.extent / 75, self.spacing)

    @cached_property
    def coarse(self) -> Surface:
        """Surface of one mean point per voxel of edge `coarse_side`."""
        return Surface(Index(cell_means(self.surface.points, self.coarse_side)))

    def check_belongs_to(self, reference: Cloud, origin: FloatArray) -> None:
        """Raise InputError unless this target has exactly the reference's points minus its local origin (3,).

        A target of another cloud or about another origin would give a plausible but wrong transform.

        Args:
            reference: reference cloud.
            origin: (3,) its local origin.
        """
        if reference is self._checked_reference:
            return
        ours, theirs = self.surface.points, reference.points
        if len(ours) != len(theirs):
            raise InputError(
                f"expected a target made from this reference's {len(theirs)} points, got a target of {len(ours)} points"
            )
        for start in range(0, len(ours), _BLOCK_ROWS):
            rows = slice(start, start + _BLOCK_ROWS)
            if not np.array_equal(ours[rows], theirs[rows] - origin):
                raise InputError(
                    "expected a target made from this reference's points minus local_origin(reference), got a target of"
                    " other points or about another origin"
                )
        self._checked_reference = reference


def local_origin(cloud: Cloud) -> FloatArray:
    """Return a rounded point (3,) near a cloud's centre, which is subtracted before all computations.

    It has integer coordinates, because subtracting integers from coordinates on any binary grid is exact: a cloud at
    UTM coordinates and the same cloud at the origin get identical coordinates. For a cloud smaller than 1, it has
    multiples of a power of two.
    """
    return local_origin_of_box(*cloud.bounds, cloud.points)


def local_origin_of_box(lower: FloatArray, upper: FloatArray, points: FloatArray) -> FloatArray:
    """Return the `local_origin` of a cloud from the corners (3,) of its box, and all or evenly thinned points (M, 3).

    If missing data are stored as coordinates such as -3.4e38, the median of the points replaces the centre of the box,
    minus which all others would be equal.
    """
    extent = float((upper - lower).max())
    step = 2.0 ** min(0, np.frexp(extent)[1] - 1) if extent > 0 else 2.0**-1000
    center: FloatArray = 0.5 * lower + 0.5 * upper
    if np.abs(center).max() >= MIN_ABSURD:
        center = np.median(points[:: max(1, len(points) // _MEDIAN_POINTS)], axis=0)
    return np.floor(center / step) * step if extent > 0 else center
