"""Result types of the trade-off study; their fields are the keys of tradeoff.json.

Errors are relative to the exact value: 0.01 is 1 % too large. A value that does not exist is None.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

from pcbench.errors import InputError
from pcbench.studies.frame.folder import StudyKind
from pcbench.studies.tradeoff.metrics import GROUP_OF

LEVELS = (0.5, 0.25, 0.1, 0.05)
QUICK_LEVELS = (0.5, 0.1)
_MAX_SEEDS = 100


@dataclass(frozen=True)
class TradeoffSettings:
    """Settings of a study.

    Attributes:
        tolerance: largest relative error of the recommended settings.
        levels: shares of points or faces that are kept.
        seeds: number of rounds: each runs the exact comparison and all approximations once, with another random seed.
        seed: seed of the first round, and of the comparisons.
        only: parts of the names of approximations to run; none: all.
        quick: whether to run few approximations in three rounds.
        register: registration method, as on the command line.

    Raises:
        InputError: a value is not usable.
    """

    tolerance: float = 0.01
    levels: tuple[float, ...] = LEVELS
    seeds: int = 5
    seed: int = 0
    only: tuple[str, ...] = ()
    quick: bool = False
    register: str = "icp"

    def __post_init__(self) -> None:
        if not 0 < self.tolerance < 1:
            raise InputError(
                f"expected a tolerance above 0 % and below 100 %, such as 1% or 0.01, got {100 * self.tolerance:g} %"
            )
        if not self.levels or not all(0 < level < 1 for level in self.levels):
            got = ", ".join(f"{100 * level:g} %" for level in self.levels) or "none"
            raise InputError(f"expected levels above 0 % and below 100 %, such as 50%,25%,10%, got {got}")
        if not 3 <= self.seeds <= _MAX_SEEDS:
            raise InputError(f"expected 3 to {_MAX_SEEDS} rounds, got {self.seeds}: intervals need at least three")
        object.__setattr__(self, "levels", tuple(sorted(set(self.levels), reverse=True)))

    def selects(self, name: str) -> bool:
        """Return whether an approximation of this name runs."""
        return not self.only or any(text.lower() in name.lower() for text in self.only)

    @classmethod
    def quick_plan(cls, **changes: Any) -> TradeoffSettings:
        """Return the settings of the quick plan, with some changed."""
        return replace(cls(quick=True, levels=QUICK_LEVELS, seeds=3), **changes)


@dataclass(frozen=True)
class ComparisonRun:
    """One run of a comparison.

    Attributes:
        approximation: name of the approximation; empty for the exact comparison.
        seed: random seed of the approximation.
        values: metrics by name.
        floors: sampling floors by name, of the metrics that have one.
        corrected: metrics to thinned clouds, corrected by their floors.
        verdict: verdict on deformation.
        points: points of the reference and of the candidate.
        cpu_s: CPU seconds of this process and its children, the approximation included.
        wall_s: wall seconds.
        memory_bytes: peak memory beyond the loaded clouds; None if unknown.
        message: why the run failed; empty if it did not.
    """

    approximation: str
    seed: int
    values: Mapping[str, float | None] = field(default_factory=dict)
    floors: Mapping[str, float | None] = field(default_factory=dict)
    corrected: Mapping[str, float | None] = field(default_factory=dict)
    verdict: str = ""
    points: tuple[int, int] = (0, 0)
    cpu_s: float = 0.0
    wall_s: float = 0.0
    memory_bytes: int | None = None
    message: str = ""


class ErrorEstimate(NamedTuple):
    """Relative error of a metric under an approximation.

    Attributes:
        mean: mean over the seeds, the bias.
        low, high: 95 % prediction interval of the error of one run; both equal the mean without random numbers.
    """

    mean: float
    low: float
    high: float

    @property
    def bound(self) -> float:
        """Largest absolute error in the interval."""
        return max(abs(self.low), abs(self.high))


class Share(NamedTuple):
    """Number of runs that kept something, out of a total."""

    kept: int
    total: int


@dataclass(frozen=True)
class TradeoffRow:
    """An approximation compared with the exact answer.

    Attributes:
        name: name of the approximation.
        family: kind of approximation.
        side: cloud that it changes: candidate, reference, both, or empty.
        level: share that is kept, or another number that sets its strength.
        instruction: what to do, as an imperative.
        errors: errors by metric; None if the approximation lacks it, or if it is not 0 but the exact value is. Metrics
            without an exact value are left out.
        corrected: errors of mean distances and of D2 to thinned clouds after their correction by the floor.
        same_verdict: runs with the exact verdict.
        cpu_s, wall_s: median seconds.
        cpu_ratio: median ratio of its CPU seconds to those of the exact comparison in the same round.
        cpu_ratio_max: largest of these ratios.
        memory_bytes: largest peak memory beyond the loaded clouds; None if unknown.
        points: median points of the reference and of the candidate.
        message: why it failed, or empty.
    """

    name: str
    family: str
    side: str
    level: float
    instruction: str
    errors: Mapping[str, ErrorEstimate | None]
    corrected: Mapping[str, ErrorEstimate | None]
    same_verdict: Share
    cpu_s: float
    wall_s: float
    cpu_ratio: float
    cpu_ratio_max: float
    memory_bytes: int | None
    points: tuple[int, int]
    message: str = ""

    def errors_with(self, *, corrected: bool) -> Mapping[str, ErrorEstimate | None]:
        """Return the errors by metric, those of the corrected metrics replaced if `corrected`."""
        return {**self.errors, **self.corrected} if corrected else self.errors

    def group_bound(self, group: str, *, corrected: bool = False) -> float | None:
        """Return the largest absolute error over the metrics of a group; None if one of them is unknown."""
        errors = [e for name, e in self.errors_with(corrected=corrected).items() if GROUP_OF[name] == group]
        bounds = [error.bound for error in errors if error is not None]
        return max(bounds) if bounds and len(bounds) == len(errors) else None


@dataclass(frozen=True)
class Exact:
    """The exact answer, by the same comparison without an approximation.

    Attributes:
        values: metrics by name.
        floors: sampling floors by name.
        verdict: verdict on deformation.
        cpu_s, wall_s: median seconds.
        memory_bytes: largest peak memory beyond the loaded clouds; None if unknown.
        points: points of the reference and of the candidate.
        threshold: threshold of the F-score, in the clouds' unit; None without one.
        unit: unit of length; None if unknown.
        cpu_spread: relative difference between its largest and smallest CPU seconds.
    """

    values: Mapping[str, float | None]
    floors: Mapping[str, float | None]
    verdict: str
    cpu_s: float
    wall_s: float
    memory_bytes: int | None
    points: tuple[int, int]
    threshold: float | None
    unit: str | None
    cpu_spread: float = 0.0


@dataclass(frozen=True)
class Tradeoff:
    """A study: the exact answer, all approximations, and what is recommended.

    Attributes:
        settings: settings.
        exact: exact answer.
        rows: approximations.
        skipped: one line for each kind of approximation that was left out.
        sentences: the answer in words.
        provenance: version, commit, machine and time.
    """

    settings: TradeoffSettings
    exact: Exact
    rows: tuple[TradeoffRow, ...]
    skipped: tuple[str, ...] = ()
    sentences: tuple[str, ...] = ()
    provenance: Mapping[str, Any] | None = field(default=None, compare=False)

    def row(self, name: str) -> TradeoffRow:
        """Return the approximation of that name.

        Raises:
            KeyError: there is none.
        """
        for row in self.rows:
            if row.name == name:
                return row
        raise KeyError(f"no approximation {name!r}: there are {', '.join(row.name for row in self.rows)}")


KIND = StudyKind("tradeoff", "tradeoff.json", "pcbench.tradeoff/1", Tradeoff, "tradeoff.md")
