"""Labels of the points of a cloud by the change to which they belong, from those of a sample."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from pcbench.changes import STABLE
from pcbench.deformation import SeparatedChanges
from pcbench.deformation.displacement import Displacement
from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.neighbors import Index
from pcbench.geometry.regions import Mask, Region


@dataclass(frozen=True, eq=False)
class PointLabels:
    """Labels of points: those of the nearest sampled points, see `pcbench.changes.Changes`.

    Attributes:
        sample: (N, 3) sampled points; none if all points are stable.
        labels: (N,) their labels.
        displacement: displacement that is removed from points before; None: none.
        changes: number of changes.
    """

    sample: FloatArray
    labels: NDArray[np.int32]
    displacement: Displacement | None
    changes: int

    @classmethod
    def of(cls, changes: SeparatedChanges, which: int) -> PointLabels:
        """Return the labels of a cloud (0: the reference)."""
        sampled, count = changes.sampled, len(changes.sampled.found)
        if sampled.samples is None or sampled.are_stable(which):
            return cls(np.zeros((0, 3)), np.zeros(0, np.int32), None, count)
        displacement = changes.displacement if which else None
        return cls(sampled.samples[which].points, sampled.labels[which], displacement, count)

    @cached_property
    def _index(self) -> Index:
        return Index(self.sample)

    def of_points(self, points: FloatArray) -> NDArray[np.int32]:
        """Return the labels (N,) of points (N, 3)."""
        if not len(self.sample):
            return np.full(len(points), STABLE, np.int32)
        places = points if self.displacement is None else points - self.displacement(points)
        labels: NDArray[np.int32] = self.labels[self._index.query(places).indices]
        return labels


@dataclass(frozen=True, eq=False)
class StableRegion:
    """The points of a cloud that did not change.

    Attributes:
        region: another region, to which it is limited; None: it is not.
        labels: labels of the cloud.
        text: text of the region in settings and errors.
        origin: (3,) origin that was subtracted from the points; None: zero.
    """

    region: Region | None
    labels: PointLabels
    text: str = "stable"
    origin: FloatArray | None = None

    def contains(self, points: FloatArray) -> Mask:
        """Return the mask (N,) of the points inside."""
        points = points if self.origin is None else points + self.origin
        is_stable: Mask = self.labels.of_points(points) == STABLE
        return is_stable if self.region is None else is_stable & self.region.contains(points)

    def shifted(self, origin: FloatArray) -> StableRegion:
        """Return the region in coordinates minus `origin` (3,)."""
        return replace(self, origin=origin if self.origin is None else self.origin + origin)

    def describe(self) -> str:
        """Return a readable name."""
        return "the part that did not change"
