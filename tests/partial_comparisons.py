"""Comparisons without the stages that a test does not check: they take most of the time of a comparison."""

from pcbench.changes import SampledChanges
from pcbench.comparison import in_memory, in_tiles
from pcbench.deformation import Deformation, stable
from pcbench.errors import Notice


def skip_deformation(monkeypatch):
    """Let comparisons, in memory and in tiles, return an undecided deformation without testing for one."""
    undecided = Deformation.undecided_because(Notice("few-pairs", "not tested"))
    for back_end in (in_memory, in_tiles):
        monkeypatch.setattr(back_end, "assess_deformation", lambda *_, **__: undecided)


def skip_changes(monkeypatch):
    """Let comparisons, in memory and in tiles, find no changes without searching for any."""
    none = SampledChanges.none()
    monkeypatch.setattr(stable, "find_changes", lambda *_: none)
