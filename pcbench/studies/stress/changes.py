"""Changes that are reported for a pair, and whether they are those that were made."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pcbench.changes import find_changes
from pcbench.extras import installed_versions
from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.neighbors import Index
from pcbench.geometry.normals import Surface
from pcbench.registration import register
from pcbench.studies.stress.results import CHANGES, RIGHT, UNNAMED, WRONG, ChangeCell, MethodInfo
from pcbench.studies.stress.scenes import StressPair

_REACH = 3.0  # spacings around what changed that count as its place
_MIN_SHARE = 0.2  # of the points of a reported change at that place


class NamedChange(NamedTuple):
    """A reported change: its kind, the length of its motion, or None, and its points (K, 3) in both clouds."""

    kind: str
    size: float | None
    points: FloatArray


@dataclass(frozen=True)
class ChangeMethod:
    """A method that names changes."""

    name: str
    run: Callable[[StressPair], list[NamedChange]]

    def info(self) -> MethodInfo:
        """Return the description for results."""
        return MethodInfo(self.name, CHANGES, "", "pcbench", installed_versions(["pcbench"]).get("pcbench", ""))


def name_changes(reference: FloatArray, aligned: FloatArray) -> list[NamedChange]:
    """Return the changes from a reference (N, 3) to an aligned candidate (M, 3), the most important one first."""
    result = find_changes(Surface(Index(reference)), Surface(Index(aligned))).of_clouds(reference, aligned)
    named = []
    for number, change in enumerate(result.found):
        points = np.concatenate([reference[result.of_reference == number], aligned[result.of_candidate == number]])
        size = change.mean if change.motion is None else float(np.linalg.norm(change.motion))
        named.append(NamedChange(change.kind, size, points))
    return named


def split_by_place(named: Sequence[NamedChange], pair: StressPair) -> tuple[list[NamedChange], list[NamedChange]]:
    """Return the changes at the place of the true one, that with the most points first, and those elsewhere."""
    if pair.change is None:
        return [], list(named)
    index, reach = Index(pair.change.points), _REACH * pair.spacing
    there: list[NamedChange] = []
    elsewhere: list[NamedChange] = []
    for change in named:
        share = float(np.mean(index.query(change.points).distances <= reach)) if len(change.points) else 0.0
        (there if share >= _MIN_SHARE else elsewhere).append(change)
    return sorted(there, key=lambda change: -len(change.points)), elsewhere


def judge(cell: ChangeCell) -> str:
    """Return the outcome of a search: a small change may be named or not, and nothing may be named elsewhere."""
    if cell.elsewhere or (cell.named and cell.named[0] not in cell.kinds):
        return WRONG
    return UNNAMED if cell.has_to_be_named and not cell.named else RIGHT


def _run(pair: StressPair) -> list[NamedChange]:
    """Register the pair as `pcbench compare` does, and search it for changes."""
    registration = register(pair.reference, pair.candidate)
    return name_changes(pair.reference, registration.T_reference_candidate.apply(pair.candidate))


CHANGE_METHODS = {"changes": ChangeMethod("changes", _run)}
