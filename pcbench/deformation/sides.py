"""One cloud of the pair of the test for deformation: its points, the ones that are queries, and their weights."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pcbench.changes import STABLE
from pcbench.deformation.displacement import Displacement
from pcbench.geometry.arrays import FloatArray, IntArray
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.neighbors import Index
from pcbench.geometry.normals import Surface
from pcbench.geometry.voxels import robust_bounds, voxel_downsample_to

MIN_PAIRS = 300
SPREAD_SIDE = 1e-3  # side of the smallest cells with one query point each, in the extent
# What reconstructors write for each point: images that show it, length of its track, opacity of a Gaussian.
_PHOTOGRAMMETRIC_ATTRIBUTES = frozenset(("views", "track_length", "opacity"))
_CLASS_WEIGHTS = {3: 0.1, 4: 0.1, 5: 0.1, 7: 0.0, 9: 0.1, 18: 0.0}  # ASPRS: vegetation, noise, water


@dataclass(frozen=True, eq=False)
class Side:
    """One cloud of the pair, in the reference's coordinates minus the local origin.

    Attributes:
        surface: points and normals.
        inside: (N,) points that may be queries; all points are searched.
        cloud: the cloud as it was read: classes, coordinate system, unit.
    """

    surface: Surface
    inside: NDArray[np.bool_]
    cloud: Cloud

    @property
    def fresh_surface(self) -> Surface:
        """The same points and normals, for queries far from each other that are not repeated."""
        return self.surface

    def displaced(self, displacement: Displacement) -> Surface:
        """Return the points after a displacement was removed."""
        points = self.surface.points
        return Surface(Index(points - displacement(points)), is_even=False)

    def lies_on(self, other: Side, within: float) -> bool:
        """Return whether every point that may be a query lies within a distance of a point of another cloud."""
        return bool(other.surface.index.query(self.surface.points[self.inside]).distances.max() <= within)

    def without(self, labels: NDArray[np.int32]) -> Side:
        """Return the cloud without the points (N,) of changes, and without those that have no counterpart."""
        return replace(self, inside=self.inside & (labels == STABLE))

    @property
    def is_metric(self) -> bool:
        """Return whether the scale is known, from a unit or a coordinate system."""
        return self.cloud.unit is not None or self.cloud.crs is not None

    @property
    def is_from_photographs(self) -> bool:
        """Return whether attributes show that the cloud was reconstructed from photographs."""
        return not _PHOTOGRAMMETRIC_ATTRIBUTES.isdisjoint(self.cloud.attributes)

    @property
    def corners(self) -> FloatArray:
        """Lowest and highest corner (2, 3) of the points."""
        return np.array(self.surface.bounds)

    def classes(self, rows: IntArray) -> NDArray[Any] | None:
        """Return the LAS classes (M,) of points; None without classes."""
        classes = self.cloud.attributes.get("classification")
        return None if classes is None else classes[rows]

    def class_weights(self, rows: IntArray) -> FloatArray:
        """Return (M,) weights of points by LAS class; 1 without classes."""
        classes = self.classes(rows)
        if classes is None:
            return np.ones(len(rows))
        table = np.ones(256)
        table[list(_CLASS_WEIGHTS)] = list(_CLASS_WEIGHTS.values())
        weights: FloatArray = table[np.clip(classes.astype(np.int64), 0, 255)]
        return weights

    def spread_rows(self, count: int) -> IntArray | None:
        """Return rows of about `count` evenly spread points that may be queries; None if there are too few."""
        if np.count_nonzero(self.inside) < MIN_PAIRS:
            return None
        points, rows = self.surface.points, None if self.inside.all() else np.flatnonzero(self.inside)
        side = SPREAD_SIDE * extent(points, rows)
        return voxel_downsample_to(points, count, side, rows) if side > 0 else None


def extent(points: FloatArray, rows: IntArray | None = None) -> float:
    """Return the longest side of the robust bounds of points (N, 3), or of those at some rows (M,)."""
    lower, upper = robust_bounds(points, rows)
    return float((upper - lower).max())
