"""Headlines of the stress study, computed from its cells alone: at most three for each subject.

Tables and charts show the rest: every method, ladder and outcome.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from statistics import median

from pcbench.measure.wording import pluralize
from pcbench.report.words import join_words
from pcbench.studies.frame.rates import Rate, percent
from pcbench.studies.stress.changes import CHANGES
from pcbench.studies.stress.limits import (
    StressRow,
    Tally,
    coverage,
    ladder_counts,
    limit_text,
    safe_ranges,
    stress_rows,
)
from pcbench.studies.stress.metrics import MAX_METRIC_ERROR, METRICS
from pcbench.studies.stress.reconstructors.reconstruction import RECONSTRUCTION, UNPERTURBED
from pcbench.studies.stress.registration import REGISTRATION, RegistrationCell
from pcbench.studies.stress.results import StressStudy
from pcbench.studies.stress.subject import (
    CRASH,
    GLOBAL,
    LOCAL,
    RIGHT,
    SAID,
    SILENT,
    TIME_OUT,
    UNNAMED,
    WITHHELD,
    WRONG,
    C,
    Group,
    StressCell,
    Subject,
)
from pcbench.studies.stress.verdicts import FALSE_BEND, MISSED, VERDICTS, WITHHELD_ALTHOUGH_RIGHT

# Ladders whose limits describe a method best, if they were run.
_HEADLINES = ("start-rotation", "start-offset", "overlap", "noise-gaussian", "background")
_MAX_HEADLINES = 5
_NOMINAL_COVERAGE = 0.95


def answer(study: StressStudy) -> Iterator[str]:
    """Yield the headlines of each subject: where our methods are right, and whether they say so where they are not."""
    yield from registration_headlines(study)
    yield from metric_headlines(study)
    yield from verdict_headlines(study)
    yield from change_headlines(study)
    yield from reconstruction_headlines(study)


def registration_headlines(study: StressStudy) -> Iterator[str]:
    """Yield the limits of our first method of each scope, and how often our methods are wrong with confidence."""
    rows = _ours(study, REGISTRATION)
    for scope in (LOCAL, GLOBAL):
        for row in [row for row in rows if row.method.scope == scope][:1]:
            yield from _limit_sentence(study, row)
    if rows:
        parts = [f"{row.name} in {_count_text(study, row.cells, SILENT)}" for row in rows]
        yield f"Wrong with confidence: {'; '.join(parts)}."


def metric_headlines(study: StressStudy) -> Iterator[str]:
    """Yield how often our metrics are right, explained or silently wrong, and whether their intervals cover."""
    rows = _ours(study, METRICS)
    for row in rows:
        tally = Tally.of(row.cells)
        yield (
            f"{row.name}: within {percent(MAX_METRIC_ERROR)} of the exact value in {tally.rate(RIGHT).text} of"
            f" {pluralize(tally.total, 'run')}; further off, but explained by its floor or its interval, in"
            f" {tally.rate(SAID).text}; silently wrong in {tally.rate(SILENT).text}."
        )
    yield from _coverage_sentence("pcbench", [cell for row in rows for cell in row.cells], "exact value")


def verdict_headlines(study: StressStudy) -> Iterator[str]:
    """Yield how often our verdicts are right, in which way they fail, and whether their intervals cover."""
    for row in _ours(study, VERDICTS):
        tally = Tally.of(row.cells)
        yield (
            f"{row.name}: right in {tally.rate(RIGHT).text} of {pluralize(tally.total, 'verdict')}, wrong with"
            f" confidence in {tally.rate(WRONG).text}, withheld in {tally.rate(WITHHELD).text}."
        )
        completed = [cell for cell in row.cells if cell.outcome not in (CRASH, TIME_OUT)]
        undeformed = [cell.failure == FALSE_BEND for cell in completed if cell.true_rms == 0]
        deformed = [cell.failure == MISSED for cell in completed if cell.is_deformed]
        posed = [cell.failure == WITHHELD_ALTHOUGH_RIGHT for cell in completed if cell.pose_is_right]
        yield from _failure_sentence(
            row.name,
            ("finds a deformation in", undeformed, "undeformed cloud"),
            ("misses", deformed, "deformed cloud"),
            ("withholds its verdict on", posed, "right pose"),
        )
        yield from _coverage_sentence(row.name, row.cells, "true size")


def change_headlines(study: StressStudy) -> Iterator[str]:
    """Yield how often a change is named, and how often one is reported where nothing changed."""
    for row in _ours(study, CHANGES):
        tally = Tally.of(row.cells)
        yield (
            f"{row.name}: names what changed, or that nothing did, in {tally.rate(RIGHT).text} of"
            f" {pluralize(tally.total, 'run')}, leaves a large change out in {tally.rate(UNNAMED).text}, and names"
            f" another kind or place in {tally.rate(WRONG).text}."
        )
        completed = [cell for cell in row.cells if cell.outcome not in (CRASH, TIME_OUT)]
        yield from _failure_sentence(
            row.name,
            ("does not name", [c.outcome == UNNAMED for c in completed if c.has_to_be_named], "large change"),
            ("reports a change where there is none in", [c.elsewhere > 0 for c in completed], "run"),
        )


def reconstruction_headlines(study: StressStudy) -> Iterator[str]:
    """Yield the scores on the unperturbed scene, how far half of them is kept, and how often that is not said."""
    info, scores, limits, silent = study.photographs, [], [], []
    for row in stress_rows(study, RECONSTRUCTION):
        fscores = [cell.fscore for cell in row.cells if cell.ladder == UNPERTURBED and cell.fscore is not None]
        scores.append(
            f"{row.name} {median(fscores):.2g}" if fscores else f"{row.name} none, so its clouds are not judged"
        )
        ranges = [limit_text(limit) for limit in safe_ranges(study, row) if fscores and limit.safe_levels]
        limits += [f"{row.name} {join_words(ranges)}"] if ranges else []
        perturbed = [cell for cell in row.cells if cell.ladder != UNPERTURBED]
        if fscores and perturbed:
            silent.append(f"{row.name} in {_count_text(study, perturbed, *RECONSTRUCTION.named(Group.CONFIDENT))}")
    if info is not None and scores:
        yield f"F-score at {info.threshold:.3g} m on the unperturbed scene: {'; '.join(scores)}."
    if limits:
        yield f"At least half of it is kept by {'; '.join(limits)}."
    if silent:
        yield f"Less than half of it without a warning: {'; '.join(silent)}."


def warnings(study: StressStudy) -> Iterator[str]:
    """Yield what was not run, and what limits the results."""
    if study.settings.quick:
        yield "These are the results of the quick plan: few levels and seeds; without --quick the limits are finer."
    if any(not method.is_ours for method in study.methods_of(REGISTRATION)):
        yield (
            "Other libraries state no doubt about a pose: it counts as doubtful if the method has not converged or"
            " matches too few points."
        )
    if any(method.name == "sfm" for method in study.methods_of(RECONSTRUCTION)):
        yield (
            "sfm solves for its cameras and aligns them to the given ones: errors of the given cameras move its cloud,"
            " but do not bend it. mvs and splat use the given cameras."
        )
    if study.settings.chosen_workers is not None:
        yield (
            "Runs had one thread, and other runs beside them (--workers): do not compare their times with those of runs"
            " alone."
        )
    by_reason: dict[str, list[str]] = {}
    for missing in study.missing:
        by_reason.setdefault(missing.reason, []).append(missing.name)
    for reason, names in by_reason.items():
        yield f"Left out: {join_words(names)} ({reason})."


def _ours(study: StressStudy, subject: Subject[C]) -> list[StressRow[C]]:
    return [row for row in stress_rows(study, subject) if row.method.is_ours]


def _limit_sentence(study: StressStudy, row: StressRow[RegistrationCell]) -> Iterator[str]:
    """Yield the last safe levels of a method, and how runs beyond them end."""
    ranges = {limit.ladder.name: limit for limit in safe_ranges(study, row)}
    chosen = [ranges[name] for name in _HEADLINES if name in ranges] or list(ranges.values())[:_MAX_HEADLINES]
    if not chosen:
        return
    safe = [limit_text(limit) for limit in chosen if limit.level is not None]
    unsafe = [limit.ladder.title for limit in chosen if limit.level is None]
    parts = [f"safe {join_words(safe)}"] if safe else []
    parts += [f"not safe at any level of {join_words(unsafe)}"] if unsafe else []
    beyond = Tally.of(cell for limit in chosen for cell in limit.beyond)
    end = f"; {'beyond that' if safe else 'there'} it {_failure_words(beyond)}" if beyond.total else ""
    yield f"{row.name}: {', '.join(parts)}{end}."


def _failure_words(beyond: Tally) -> str:
    """Return how registrations end beyond the safe levels."""
    parts = [
        f"fails and says so in {percent(beyond.of_groups(REGISTRATION, Group.SAID_SO).share)}",
        f"is silently wrong in {beyond.of_groups(REGISTRATION, Group.CONFIDENT).text}",
        f"is right in {percent(beyond.of_groups(REGISTRATION, Group.SUCCESS).share)}",
    ]
    aborted = beyond.of_groups(REGISTRATION, Group.ABORTED)
    if aborted.count:
        parts.append(f"crashes or runs out of time in {percent(aborted.share)}")
    return f"{join_words(parts)} of {pluralize(beyond.total, 'run')}"


def _count_text(study: StressStudy, cells: Sequence[StressCell], outcome: str) -> str:
    """Return how many cells have an outcome, and under which ladders."""
    rate = Tally.of(cells).rate(outcome)
    places = ladder_counts(study, cells, outcome)
    return f"{rate.count} of {pluralize(rate.total, 'run')}, {rate.text}" + (f" ({places})" if places else "")


def _failure_sentence(name: str, *failures: tuple[str, Sequence[bool], str]) -> Iterator[str]:
    """Yield how often each kind of failure occurs: its verb, whether each of its cases failed, and what a case is."""
    parts = []
    for verb, failed, noun in failures:
        if failed:
            rate = Rate(sum(failed), len(failed))
            parts.append(f"{verb} {rate.count} of {pluralize(rate.total, noun)}, {rate.text}")
    if parts:
        yield f"{name} {'; it '.join(parts)}."


def _coverage_sentence(name: str, cells: Iterable[StressCell], truth: str) -> Iterator[str]:
    """Yield whether the intervals of cells contain the truth as often as they state."""
    covered = coverage(cells)
    if not covered.total:
        return
    low, high = covered.interval
    stated = _NOMINAL_COVERAGE
    judgement = "less often than stated" if high < stated else "more often than stated" if low > stated else "as stated"
    yield (
        f"{name}: the 95 % interval contains the {truth} in {covered.text} of {pluralize(covered.total, 'interval')},"
        f" {judgement}."
    )
