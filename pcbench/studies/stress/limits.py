"""Limits of methods: the level of each ladder up to which a method is safe, and the outcomes beyond it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from statistics import median
from typing import Any, Generic, TypeVar

from pcbench.report.words import join_words
from pcbench.studies.frame.rates import Rate
from pcbench.studies.stress.descriptions import LadderInfo, MethodInfo
from pcbench.studies.stress.results import StressStudy
from pcbench.studies.stress.subject import C, Group, StressCell, Subject

MIN_SAFE_SHARE = 0.9
"""Smallest share of successes at each level of a safe range."""

_MAX_LADDERS = 4  # ladders named as those where an outcome occurs
_Key = TypeVar("_Key", bound=Hashable)


@dataclass(frozen=True)
class Tally:
    """Outcomes of a group of cells.

    Attributes:
        counts: number of cells by outcome; outcomes that do not occur are absent.
        total: number of cells.
        cpu_s: median of the CPU seconds; None if none is known.
        memory_bytes: largest peak of memory; None if none is known.
    """

    counts: Mapping[str, int]
    total: int
    cpu_s: float | None
    memory_bytes: int | None

    @classmethod
    def of(cls, cells: Iterable[StressCell]) -> Tally:
        """Count the outcomes of cells."""
        group = list(cells)
        counts: dict[str, int] = {}
        for cell in group:
            counts[cell.outcome] = counts.get(cell.outcome, 0) + 1
        times = [cell.cpu_s for cell in group if cell.cpu_s is not None]
        peaks = [cell.memory_bytes for cell in group if cell.memory_bytes is not None]
        return cls(counts, len(group), median(times) if times else None, max(peaks, default=None))

    def rate(self, *outcomes: str) -> Rate:
        """Return the share of the cells with any of these outcomes."""
        return Rate(sum(self.counts.get(outcome, 0) for outcome in outcomes), self.total)

    def of_groups(self, subject: Subject[Any], *groups: Group) -> Rate:
        """Return the share of the cells whose outcomes are in groups, such as `Group.SUCCESS`."""
        return self.rate(*subject.named(*groups))


def grouped(cells: Iterable[C], key: Callable[[C], _Key]) -> dict[_Key, list[C]]:
    """Return cells in groups, in the order in which their keys first occur."""
    groups: dict[_Key, list[C]] = {}
    for cell in cells:
        groups.setdefault(key(cell), []).append(cell)
    return groups


@dataclass(frozen=True)
class StressRow(Generic[C]):
    """A row of tables and charts: a method, or for metrics a method and one of its metrics.

    Attributes:
        name: name of the row.
        subject: its subject.
        method: the method.
        cells: its cells.
    """

    name: str
    subject: Subject[C]
    method: MethodInfo
    cells: tuple[C, ...]

    @cached_property
    def by_ladder(self) -> dict[str, list[C]]:
        """The cells by the name of their ladder."""
        return grouped(self.cells, lambda cell: cell.ladder)


@dataclass(frozen=True)
class SafeRange:
    """The levels of a ladder up to which a row is safe.

    A level is safe if at least 90 % of its runs succeed, none is wrong with confidence, and all easier levels are safe.

    Attributes:
        ladder: the ladder.
        safe_levels: number of safe levels.
        beyond: cells of the other levels.
    """

    ladder: LadderInfo
    safe_levels: int
    beyond: tuple[StressCell, ...]

    @property
    def level(self) -> float | None:
        """The last safe level; None if the first is not safe."""
        return self.ladder.levels[self.safe_levels - 1] if self.safe_levels else None

    @property
    def is_complete(self) -> bool:
        """Return whether all levels are safe."""
        return self.safe_levels == len(self.ladder.levels)


@dataclass(frozen=True)
class SafeStart:
    """The largest safe rectangle of a map, from its easiest corner.

    Attributes:
        ladder: the map.
        level: last safe level; None if the easiest corner is not safe.
        second: last safe second coordinate.
    """

    ladder: LadderInfo
    level: float | None
    second: float | None


def stress_rows(study: StressStudy, subject: Subject[C]) -> list[StressRow[C]]:
    """Return the rows of a subject, ours first."""
    rows = []
    for method in study.methods_of(subject):
        cells = [cell for cell in study.cells(subject) if cell.method == method.name]
        for name, group in grouped(cells, subject.row).items():
            rows.append(StressRow(name, subject, method, tuple(group)))
    return rows


def safe_ranges(study: StressStudy, row: StressRow[Any]) -> list[SafeRange]:
    """Return the safe range of a row on each ladder; maps and lists of cases have none."""
    groups = row.by_ladder
    return [
        _safe_range(ladder, row.subject, groups[ladder.name])
        for ladder in study.ladders_of(row.subject)
        if not ladder.is_map and not ladder.is_list and ladder.name in groups
    ]


def safe_starts(study: StressStudy, row: StressRow[Any]) -> list[SafeStart]:
    """Return the safe rectangle of a row on each map."""
    groups = row.by_ladder
    return [
        _safe_start(ladder, row.subject, groups[ladder.name])
        for ladder in study.ladders_of(row.subject)
        if ladder.is_map and ladder.name in groups
    ]


def ladder_success(tally: Tally, ladder: LadderInfo, subject: Subject[Any]) -> Rate:
    """Return the share of a ladder's runs that succeed; for a list of cases, of those that are right or say so.

    Cases may have no right result: then a method has to say so.
    """
    return tally.of_groups(subject, Group.SUCCESS, *([Group.SAID_SO] if ladder.is_list else []))


def is_safe(tally: Tally, subject: Subject[Any]) -> bool:
    """Return whether enough runs succeed and none is wrong with confidence."""
    good, confident = tally.of_groups(subject, Group.SUCCESS), tally.of_groups(subject, Group.CONFIDENT)
    return tally.total > 0 and good.share >= MIN_SAFE_SHARE and confident.count == 0


def coverage(cells: Iterable[StressCell]) -> Rate:
    """Return the share of intervals that contain the truth."""
    covers = [cell.covers for cell in cells if cell.covers is not None]
    return Rate(sum(covers), len(covers))


def _safe_range(ladder: LadderInfo, subject: Subject[Any], cells: Sequence[StressCell]) -> SafeRange:
    by_level = grouped(cells, lambda cell: cell.level)
    safe = 0
    for level in ladder.levels:
        if not is_safe(Tally.of(by_level.get(level, ())), subject):
            break
        safe += 1
    return SafeRange(ladder, safe, tuple(cell for cell in cells if cell.level in ladder.levels[safe:]))


def _safe_start(ladder: LadderInfo, subject: Subject[Any], cells: Sequence[StressCell]) -> SafeStart:
    by_place = grouped(cells, lambda cell: (cell.level, cell.second))
    safe = {place for place, group in by_place.items() if is_safe(Tally.of(group), subject)}
    best = (0, 0)
    width = len(ladder.second_levels)
    for rows in range(1, len(ladder.levels) + 1):
        level = ladder.levels[rows - 1]
        unsafe = (n for n, second in enumerate(ladder.second_levels) if (level, second) not in safe)
        width = min(width, next(unsafe, len(ladder.second_levels)))
        # Equal areas: the rectangle nearer to a square has the larger smaller side.
        best = max(best, (rows, width), key=lambda size: (size[0] * size[1], min(size)))
    rows, width = best
    if not rows or not width:
        return SafeStart(ladder, None, None)
    return SafeStart(ladder, ladder.levels[rows - 1], ladder.second_levels[width - 1])


def limit_text(limit: SafeRange) -> str:
    """Return the last safe level in words, with the title of its ladder."""
    ladder = limit.ladder
    if limit.level is None:
        return f"at no level of {ladder.title}"
    way = "down to" if ladder.levels[0] > ladder.levels[-1] else "up to"
    rest = ", the last level" if limit.is_complete else ""
    return f"{way} {ladder.level_text(limit.level)} ({ladder.title}{rest})"


def ladder_counts(study: StressStudy, cells: Iterable[StressCell], outcome: str) -> str:
    """Return the ladders where an outcome occurs, most frequent first, with counts; cases of a list by name."""
    counts: Counter[str] = Counter()
    for cell in cells:
        if cell.outcome == outcome:
            ladder = study.ladder(cell.ladder)
            counts[ladder.level_text(cell.level) if ladder.is_list else ladder.title] += 1
    return join_words([f"{name} ({count})" for name, count in counts.most_common()], _MAX_LADDERS) if counts else ""
