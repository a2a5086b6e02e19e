"""Conclusions of the stress study as sentences, computed from its cells alone."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from statistics import median

from pcbench.measure.wording import pluralize
from pcbench.report.words import join_words
from pcbench.studies.stress.limits import (
    ABORTED,
    CONFIDENT,
    SAID_SO,
    SUCCESS,
    SafeRange,
    SafeStart,
    StressRow,
    ladder_counts,
    limit_text,
    safe_ranges,
    safe_starts,
    stress_rows,
)
from pcbench.studies.stress.reconstructors.words import case_sentences, failure_sentences, limit_sentences
from pcbench.studies.stress.results import (
    CHANGES,
    CRASH,
    FALSE_ALARM,
    FALSE_BEND,
    LOCAL,
    MAX_METRIC_ERROR,
    METRICS,
    MISSED,
    RECONSTRUCTION,
    REFUSED,
    REGISTRATION,
    RIGHT,
    SAID,
    SILENT,
    TIME_OUT,
    UNNAMED,
    VERDICTS,
    WITHHELD,
    WITHHELD_ALTHOUGH_RIGHT,
    WRONG,
    Cell,
    ChangeCell,
    MetricCell,
    Rate,
    RegistrationCell,
    StressStudy,
    Tally,
    VerdictCell,
    grouped,
)

# Ladders whose limits describe a method best, if they were run.
_HEADLINES = ("start-rotation", "start-offset", "overlap", "noise-gaussian", "background")
_MAX_HEADLINES = 5
_MAX_BREAKS = 4  # ladders named as those under which a method breaks first
_NOMINAL_COVERAGE = 0.95


def sentences(study: StressStudy) -> tuple[str, ...]:
    """Return all conclusions as sentences, those on registration first."""
    parts = (
        registration_sentences,
        metric_sentences,
        verdict_sentences,
        change_sentences,
        reconstruction_sentences,
        warnings,
    )
    return tuple(sentence for part in parts for sentence in part(study))


def answer(study: StressStudy) -> Iterator[str]:
    """Yield the conclusions to read first: the limits of our methods, and how often they are wrong with confidence."""
    for row in stress_rows(study, REGISTRATION):
        if row.method.is_ours:
            yield from _limit_sentence(row, safe_ranges(study, row))
            yield _silent_sentence(study, row)
    yield from (_metric_sentence(row) for row in stress_rows(study, METRICS) if row.method.is_ours)
    yield from (_verdict_sentence(row) for row in stress_rows(study, VERDICTS) if row.method.is_ours)
    yield from (_change_sentence(row) for row in stress_rows(study, CHANGES))
    for row in stress_rows(study, RECONSTRUCTION):
        yield from limit_sentences(study, row)


def registration_sentences(study: StressStudy) -> Iterator[str]:
    """Yield where each registration method is safe, how it fails beyond, and where it is wrong with confidence."""
    for row in stress_rows(study, REGISTRATION):
        ranges = safe_ranges(study, row)
        yield from _limit_sentence(row, ranges)
        for start in safe_starts(study, row):
            yield _start_sentence(row, start)
        yield from _break_sentence(row, ranges)
        yield _silent_sentence(study, row)
        yield from _alarm_sentence(row)
        yield from _abort_sentence(study, row)


def metric_sentences(study: StressStudy) -> Iterator[str]:
    """Yield how often each metric is right, explained or silently wrong, and whether its intervals cover."""
    for row in stress_rows(study, METRICS):
        yield _metric_sentence(row)
        yield from _coverage_sentence(row)
        yield from _break_sentence(row, safe_ranges(study, row))
        yield from _abort_sentence(study, row)


def verdict_sentences(study: StressStudy) -> Iterator[str]:
    """Yield how often each rule is right, wrong with confidence, or withholds a verdict on a right pose."""
    for row in stress_rows(study, VERDICTS):
        cells = [cell for cell in row.cells if isinstance(cell, VerdictCell)]
        completed = [cell for cell in cells if cell.outcome not in ABORTED]
        deformed = [cell for cell in completed if cell.is_deformed]
        undeformed = [cell for cell in completed if cell.true_rms == 0]
        posed = [cell for cell in completed if cell.pose_is_right]
        false_bends, missed = _failures(undeformed, FALSE_BEND), _failures(deformed, MISSED)
        withheld = _failures(posed, WITHHELD_ALTHOUGH_RIGHT)
        yield _verdict_sentence(row)
        parts = [
            *_share_part("finds a deformation in", false_bends, "undeformed cloud"),
            *_share_part("misses", missed, "deformed cloud"),
            *_share_part("withholds its verdict on", withheld, "right pose"),
        ]
        if parts:
            yield f"{row.name} {'; it '.join(parts)}."
        if places := ladder_counts(study, cells, WRONG):
            yield f"{row.name} is wrong with confidence under {places}."
        yield from _size_sentence(row)
        yield from _coverage_sentence(row)
        yield from _break_sentence(row, safe_ranges(study, row))
        yield from _abort_sentence(study, row)


def change_sentences(study: StressStudy) -> Iterator[str]:
    """Yield how often a change is named, and how often one is reported where nothing changed."""
    for row in stress_rows(study, CHANGES):
        yield _change_sentence(row)
        cells = [cell for cell in row.cells if isinstance(cell, ChangeCell) and cell.outcome not in ABORTED]
        unnamed = Rate(sum(cell.outcome == UNNAMED for cell in cells), sum(cell.has_to_be_named for cell in cells))
        false = Rate(sum(cell.elsewhere > 0 for cell in cells), len(cells))
        parts = [
            *_share_part("does not name", unnamed, "large change"),
            *_share_part("reports a change where there is none in", false, "run"),
        ]
        if parts:
            yield f"{row.name} {'; it '.join(parts)}."
        yield from _break_sentence(row, safe_ranges(study, row))
        yield from _abort_sentence(study, row)


def reconstruction_sentences(study: StressStudy) -> Iterator[str]:
    """Yield how far each reconstructor keeps half of its F-score, and what it does beyond."""
    for row in stress_rows(study, RECONSTRUCTION):
        yield from limit_sentences(study, row)
        yield from failure_sentences(study, row)
        yield from case_sentences(study, row)


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


def percent(share: float) -> str:
    """Return a share as a percentage: two digits below 10 %, and no rounding of less than all to 100 %."""
    return f"{_percent_number(share)} %"


def rate_text(rate: Rate) -> str:
    """Return a share with its 95 % interval, such as `0.4 % [0.1, 1.2]`; a dash without runs."""
    if not rate.total:
        return "–"
    low, high = rate.interval
    return f"{percent(rate.share)} [{_percent_number(low)}, {_percent_number(high)}]"


def axis_title(title: str, unit: str) -> str:
    """Return a quantity with its unit in brackets, if it has one."""
    return f"{title} [{unit}]" if unit else title


def _percent_number(share: float) -> str:
    value = 100 * share
    if 99 < value < 100:
        return f"{min(value, 99.9):.1f}"
    return f"{value:.2g}" if value < 9.95 else f"{value:.0f}"


def _limit_sentence(row: StressRow, ranges: Sequence[SafeRange]) -> Iterator[str]:
    named = {found.ladder.name: found for found in ranges}
    chosen = [named[name] for name in _HEADLINES if name in named] or list(ranges[:_MAX_HEADLINES])
    if not chosen:
        return
    safe, unsafe = ([f for f in chosen if (f.level is None) is none] for none in (False, True))
    limits = f"safe {join_words([limit_text(found) for found in safe])}" if safe else ""
    never = f"not safe at any level of {join_words([found.ladder.title for found in unsafe])}" if unsafe else ""
    start = f"{row.name}: {', '.join(filter(None, (limits, never)))}"
    beyond = _sum(found.beyond for found in chosen)
    if not beyond.total:
        yield f"{start}."
        return
    yield f"{start}; {'beyond that' if safe else 'there'} it {_failure_words(beyond)}."


def _failure_words(beyond: Tally) -> str:
    """Return how runs end beyond the safe levels."""
    said, silent = (beyond.rate(*of[REGISTRATION]) for of in (SAID_SO, CONFIDENT))
    parts = [
        f"fails and says so in {percent(said.share)}",
        f"is silently wrong in {rate_text(silent)}",
        f"is right in {percent(beyond.rate(*SUCCESS[REGISTRATION]).share)}",
    ]
    aborted = beyond.rate(*ABORTED)
    if aborted.count:
        parts.append(f"crashes or runs out of time in {percent(aborted.share)}")
    return f"{join_words(parts)} of {pluralize(beyond.total, 'run')}"


def _start_sentence(row: StressRow, start: SafeStart) -> str:
    ladder = start.ladder
    if start.level is None or start.second is None:
        return (
            f"{row.name}: no start is safe, not even the nearest of {ladder.title} and {ladder.second_title};"
            f" it {_failure_words(start.beyond)}."
        )
    inside = start.within.rate(*SUCCESS[REGISTRATION])
    second = f"{start.second:g} {ladder.second_unit}".rstrip()
    outside = f"; from others it {_failure_words(start.beyond)}" if start.beyond.total else ""
    return (
        f"{row.name}: safe from starts within {ladder.level_text(start.level)} and {second} together"
        f" ({inside.count} of {pluralize(inside.total, 'run')} right){outside}."
    )


def _break_sentence(row: StressRow, ranges: Sequence[SafeRange]) -> Iterator[str]:
    """Yield the ladders under which a row breaks first, and those that it withstands."""
    broken = sorted((found for found in ranges if not found.is_complete), key=lambda found: found.share)
    withstood = [found.ladder.title for found in ranges if found.is_complete]
    parts = []
    if broken:
        some = [f"{found.ladder.title} ({_short_limit(found)})" for found in broken[:_MAX_BREAKS]]
        first = "first " if len(broken) > _MAX_BREAKS else ""
        parts.append(f"breaks {first}under {join_words(some)}")
    if withstood:
        parts.append(f"withstands all levels of {join_words(withstood)}")
    if parts:
        yield f"{row.name} {'; it '.join(parts)}."


def _short_limit(found: SafeRange) -> str:
    if found.level is None:
        return "safe at no level"
    way = "below" if found.ladder.levels[0] > found.ladder.levels[-1] else "beyond"
    return f"{way} {found.ladder.level_text(found.level)}"


def _silent_sentence(study: StressStudy, row: StressRow) -> str:
    silent = Tally.of(row.cells).rate(SILENT)
    text = f"{row.name} is wrong with confidence in {silent.count} of {pluralize(silent.total, 'run')}"
    places = ladder_counts(study, row.cells, SILENT)
    text = f"{text}, {rate_text(silent)}" + (f": {places}" if places else "")
    warned = [cell for cell in row.cells if isinstance(cell, RegistrationCell) and cell.warned]
    codes = Counter(code for cell in warned if cell.outcome == SILENT for code in cell.codes)
    if not codes:
        return f"{text}."
    count = sum(cell.outcome == SILENT for cell in warned)
    names = join_words([f"{code} ({number})" for code, number in codes.most_common()])
    return f"{text}; {count} of them with a warning that does not make the pose doubtful: {names}."


def _metric_sentence(row: StressRow) -> str:
    tally = Tally.of(row.cells)
    return (
        f"{row.name}: within {percent(MAX_METRIC_ERROR)} of the exact value in {rate_text(tally.rate(RIGHT))} of"
        f" {pluralize(tally.total, 'run')}; further off, but explained by its floor or its interval, in"
        f" {rate_text(tally.rate(SAID))}; silently wrong in {rate_text(tally.rate(SILENT))}."
    )


def _verdict_sentence(row: StressRow) -> str:
    tally = Tally.of(row.cells)
    return (
        f"{row.name}: right in {rate_text(tally.rate(RIGHT))} of {pluralize(tally.total, 'verdict')}, wrong with"
        f" confidence in {rate_text(tally.rate(WRONG))}, withheld in {rate_text(tally.rate(WITHHELD))}."
    )


def _change_sentence(row: StressRow) -> str:
    tally = Tally.of(row.cells)
    return (
        f"{row.name}: names what changed, or that nothing did, in {rate_text(tally.rate(RIGHT))} of"
        f" {pluralize(tally.total, 'run')}, leaves a large change out in {rate_text(tally.rate(UNNAMED))}, and names"
        f" another kind or place in {rate_text(tally.rate(WRONG))}."
    )


def _alarm_sentence(row: StressRow) -> Iterator[str]:
    tally = Tally.of(row.cells)
    doubted = Rate(tally.counts.get(FALSE_ALARM, 0), tally.rate(RIGHT, FALSE_ALARM).count)
    refused = tally.counts.get(REFUSED, 0)
    parts = [*_share_part("doubts", doubted, "right pose")]
    if refused:
        other = "another local method" if row.method.scope == LOCAL else "another method"
        parts.append(f"refuses {pluralize(refused, 'pose')} that {other} found")
    if parts:
        yield f"{row.name} {'; it '.join(parts)}."


def _abort_sentence(study: StressStudy, row: StressRow) -> Iterator[str]:
    tally = Tally.of(row.cells)
    parts = [
        f"{verb} in {pluralize(tally.counts[outcome], 'run')}: {ladder_counts(study, row.cells, outcome)}"
        for outcome, verb in ((CRASH, "crashes"), (TIME_OUT, "runs out of time"))
        if outcome in tally.counts
    ]
    if parts:
        yield f"{row.name} {'; it '.join(parts)}."


def _coverage_sentence(row: StressRow) -> Iterator[str]:
    known = [cell.covers for cell in row.cells if isinstance(cell, MetricCell | VerdictCell) and _has_truth(cell)]
    covered = Rate(sum(value is True for value in known), sum(value is not None for value in known))
    if not covered.total:
        return
    low, high = covered.interval
    stated = _NOMINAL_COVERAGE
    judgement = "less often than stated" if high < stated else "more often than stated" if low > stated else "as stated"
    what = "true size" if row.subject == VERDICTS else "exact value"
    yield (
        f"{row.name}: the 95 % interval contains the {what} in {rate_text(covered)} of"
        f" {pluralize(covered.total, 'interval')}, {judgement}."
    )


def _has_truth(cell: Cell) -> bool:
    return not isinstance(cell, VerdictCell) or cell.true_rms > 0


def _size_sentence(row: StressRow) -> Iterator[str]:
    """Yield the median of measured over true size, by size of the true deformation in units of the noise."""
    cells = [cell for cell in row.cells if isinstance(cell, VerdictCell) and cell.ratio is not None]
    sizes = grouped(cells, lambda cell: round(cell.size_in_noise, 1))
    parts = [
        f"{median([cell.ratio or 0.0 for cell in sizes[size]]):.2g} times the true one at {size:g} times the noise"
        for size in sorted(sizes)
    ]
    if parts:
        yield f"{row.name}: the median of the measured sizes is {join_words(parts)}."


def _share_part(verb: str, rate: Rate, noun: str) -> list[str]:
    if not rate.total:
        return []
    return [f"{verb} {rate.count} of {pluralize(rate.total, noun)}, {rate_text(rate)}"]


def _failures(cells: Sequence[VerdictCell], failure: str) -> Rate:
    return Rate(sum(cell.failure == failure for cell in cells), len(cells))


def _sum(tallies: Iterable[Tally]) -> Tally:
    counts: Counter[str] = Counter()
    total = 0
    for tally in tallies:
        counts.update(tally.counts)
        total += tally.total
    return Tally(dict(counts), total, None, None)
