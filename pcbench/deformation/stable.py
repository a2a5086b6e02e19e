"""Changes of parts of a scene, apart from a smooth deformation of the whole."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pcbench.changes import Changes, ClosestPoints, SampledChanges, find_changes
from pcbench.deformation.displacement import Displacement
from pcbench.deformation.pairs import PairSearch
from pcbench.deformation.sides import Side
from pcbench.geometry.arrays import FloatArray

_MIN_SHARE = 0.02  # of the points, above which a deformation may look like changes
_MIN_REDUCTION = 0.5  # share of the changed points that a deformation has to explain
_MAX_VARIATION = 1.25  # of a displacement over the noise, up to which small changes count


@dataclass(frozen=True, eq=False)
class SeparatedChanges:
    """Changes, found after a smooth displacement of the candidate was removed; None: as the clouds are."""

    sampled: SampledChanges
    displacement: Displacement | None

    def of_candidate(self, points: FloatArray) -> NDArray[np.int32]:
        """Return the labels (N,) of points (N, 3) of the candidate."""
        if self.displacement is not None and not self.sampled.are_stable(1):
            points = points - self.displacement(points)
        return self.sampled.of_points(1, points)

    def of_points(self, reference: FloatArray, candidate: FloatArray) -> Changes:
        """Return the changes with the labels of all points (N, 3) and (M, 3) of both clouds."""
        sampled = self.sampled
        labels = sampled.of_points(0, reference), self.of_candidate(candidate)
        return Changes(sampled.found, *labels, sampled.left_out)


def separate_changes(reference: Side, candidate: Side, closest: ClosestPoints | None = None) -> SeparatedChanges:
    """Find the changes between a reference and its aligned candidate, in the same coordinates.

    A deformed scene is off the reference in most places. So if many points changed, changes are also sought after a
    smooth displacement is removed, and if that leaves less than half of them, only those remain. A smooth model that
    explains less is not needed: parts changed. Changes of small places are left out where the displacement exceeds the
    noise: of a deformed scene, some places fit worse than their surroundings.

    Args:
        reference: the reference.
        candidate: the candidate.
        closest: closest points of the complete clouds, if they are known.
    """
    changes = find_changes(reference.fresh_surface, candidate.fresh_surface, closest)
    if changes.share <= _MIN_SHARE and changes.large is None:
        return SeparatedChanges(changes, None)
    search = PairSearch.of(reference, candidate)
    displacement = None if search is None else search.displacement()
    if displacement is None:
        return SeparatedChanges(changes, None)
    assert changes.samples is not None
    is_bent = _variation(displacement, changes.samples[1].points) > _MAX_VARIATION * changes.noise
    if changes.share > _MIN_SHARE:
        others = find_changes(reference.fresh_surface, candidate.displaced(displacement))
        if others.share <= _MIN_REDUCTION * changes.share:
            return SeparatedChanges(_without_small(others) if is_bent else others, displacement)
    return SeparatedChanges(_without_small(changes) if is_bent else changes, None)


def _variation(displacement: Displacement, points: FloatArray) -> float:
    """Return the RMS deviation of the displacements of points (N, 3) from their median."""
    vectors = displacement(points)
    return float(np.sqrt(np.square(vectors - np.median(vectors, axis=0)).sum(axis=1).mean()))


def _without_small(changes: SampledChanges) -> SampledChanges:
    return changes if changes.large is None else changes.large
