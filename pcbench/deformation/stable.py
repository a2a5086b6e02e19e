"""Changes of parts of a scene, apart from a smooth deformation of the whole."""

from __future__ import annotations

from pcbench.changes import Changes, find_changes
from pcbench.deformation.pairs import PairSearch, Side

_MIN_SHARE = 0.02  # of the points, above which a deformation may look like changes
_MIN_REDUCTION = 0.5  # share of the changed points that a deformation has to explain


def separate_changes(reference: Side, candidate: Side) -> Changes:
    """Find the changes between a reference and its aligned candidate, in the same coordinates.

    A deformed scene is off the reference in most places. So if many points changed, changes are also sought after a
    smooth displacement is removed, and if that leaves less than half of them, only those remain. A smooth model that
    explains less is not needed: parts changed.
    """
    changes = find_changes(reference.surface, candidate.surface)
    if changes.share <= _MIN_SHARE:
        return changes
    search = PairSearch.of(reference, candidate)
    displacement = None if search is None else search.displacement()
    if displacement is None:
        return changes
    others = find_changes(reference.surface, candidate.surface, displacement(candidate.surface.points))
    return others if others.share <= _MIN_REDUCTION * changes.share else changes
