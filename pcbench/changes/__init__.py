"""Parts of a scene that differ between two registered clouds: moved, added, removed, or seen by one cloud only."""

from pcbench.changes.result import ADDED, MOVED, REMOVED, STABLE, UNMATCHED, Change, Changes
from pcbench.changes.search import ClosestPoints, SampledChanges, find_changes

__all__ = [
    "ADDED",
    "MOVED",
    "REMOVED",
    "STABLE",
    "UNMATCHED",
    "Change",
    "Changes",
    "ClosestPoints",
    "SampledChanges",
    "find_changes",
]
