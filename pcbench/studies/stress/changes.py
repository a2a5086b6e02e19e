"""Changes that are reported for a pair, and whether they are those that were made."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from pcbench.changes import find_changes
from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.neighbors import Index
from pcbench.geometry.normals import Surface
from pcbench.registration import register
from pcbench.studies.stress.scenes import StressPair
from pcbench.studies.stress.subject import (
    COST_LEGEND,
    ENDS,
    RIGHT,
    UNNAMED,
    WRONG,
    Group,
    Outcome,
    PairSubject,
    RunResult,
    StressCell,
    StressMethod,
    by_name,
)

_REACH = 3.0  # spacings around what changed that count as its place
_ROUNDING = 1e-5  # relative errors of the sizes of a cell, which are rounded to six digits
_MIN_SHARE = 0.2  # of the points of a reported change at that place

MIN_CHANGE_SIZE, MIN_CHANGE_POINTS = 10.0, 30
"""Motion over the noise, and number of points of both clouds, from which a change has to be named; others may be."""


@dataclass(frozen=True)
class ChangeCell(StressCell):
    """Result of one search for changes.

    Attributes:
        kinds: kinds of the true change that are right; empty if nothing changed.
        points: number of points of both clouds that belong to it.
        named: kinds of the changes that are reported at its place, the one with the most points first.
        elsewhere: number of changes that are reported elsewhere.
        true_size: length by which it moved, in the clouds' unit; None if it did not.
        size: length of the motion that is reported for it; None if there is none.
        noise: standard deviation of the difference of both clouds along the normals, in the clouds' unit.
    """

    kinds: tuple[str, ...] = ()
    points: int = 0
    named: tuple[str, ...] = ()
    elsewhere: int = 0
    true_size: float | None = None
    size: float | None = None
    noise: float = math.nan

    @property
    def has_to_be_named(self) -> bool:
        """Return whether the change is so large that it has to be reported."""
        least = MIN_CHANGE_SIZE * (1 - _ROUNDING) * self.noise
        is_far = self.true_size is None or self.true_size >= least
        return bool(self.kinds) and is_far and self.points >= MIN_CHANGE_POINTS


class NamedChange(NamedTuple):
    """A reported change: its kind, the length of its motion, or None, and its points (K, 3) in both clouds."""

    kind: str
    size: float | None
    points: FloatArray


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


def outcome_of(cell: ChangeCell) -> str:
    """Return the outcome of a search: a small change may be named or not, and nothing may be named elsewhere."""
    if cell.elsewhere or (cell.named and cell.named[0] not in cell.kinds):
        return WRONG
    return UNNAMED if cell.has_to_be_named and not cell.named else RIGHT


def _register_and_name(pair: StressPair) -> list[NamedChange]:
    """Register the pair as `pcbench compare` does, and search it for changes."""
    registration = register(pair.reference, pair.candidate)
    return name_changes(pair.reference, registration.T_reference_candidate.apply(pair.candidate))


CHANGE_METHODS = by_name(StressMethod("changes", _register_and_name))


def _judge(answer: Sequence[NamedChange], pair: StressPair, values: Mapping[str, Any]) -> RunResult:
    """Compare the named changes with the one that was made."""
    true = pair.change
    there, elsewhere = split_by_place(answer, pair)
    cell = ChangeCell(
        **values,
        outcome="",
        kinds=() if true is None else true.kinds,
        points=0 if true is None else len(true.points),
        named=tuple(change.kind for change in there),
        elsewhere=len(elsewhere),
        true_size=None if true is None else true.size,
        size=there[0].size if there else None,
        noise=float(np.hypot(pair.noise, pair.candidate_noise)),
    )
    return RunResult((replace(cell, outcome=outcome_of(cell)),))


CHANGES = PairSubject(
    name="changes",
    title="Changes",
    noun="search for changes",
    key="changes",
    cell=ChangeCell,
    outcomes=(
        Outcome(RIGHT, "right", Group.SUCCESS),
        Outcome(UNNAMED, "not named", Group.CONFIDENT),
        Outcome(WRONG, "wrong with confidence", Group.CONFIDENT),
        *ENDS,
    ),
    legend=f"unnamed: no change is reported at its place; wrong: of another kind, or reported elsewhere; {COST_LEGEND}",
    success="rightly named changes [% of runs]",
    charts=("outcomes", "matrix", "severity"),
    methods=CHANGE_METHODS,
    ask=lambda method, pair, _: CHANGE_METHODS[method].run(pair),
    judge=_judge,
    warm_up=_register_and_name,
    start=(1.0, 0.005),
)
