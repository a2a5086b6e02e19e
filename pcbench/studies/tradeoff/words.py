"""The answer of the study in sentences: what to use for the tolerance, and what was left out."""

from __future__ import annotations

from collections.abc import Iterator

from pcbench.progress import duration
from pcbench.report.words import join_words
from pcbench.studies.tradeoff.metrics import DEFORMATION, GROUP_NAMES
from pcbench.studies.tradeoff.recommend import Recommendation, known_groups, recommend, recommendations
from pcbench.studies.tradeoff.results import Tradeoff, TradeoffRow

_MAX_CPU_SPREAD = 0.2


def answer(study: Tradeoff) -> Iterator[str]:
    """Yield a recommendation for each group of metrics, and one for all of them."""
    if all(row.message for row in study.rows):
        yield "No approximation could be measured: use all points."
        return
    parts = recommendations(study)
    for part in parts:
        yield _recommendation(study, part)
    if len(parts) > 1:
        whole = recommend(study, known_groups(study))
        if whole.row is not None:
            yield f"To keep all of these, {_how(study, whole.row, whole.corrected)}."
        elif any(part.row is not None for part in parts):
            yield "Nothing cheaper keeps all of these at once."


def _recommendation(study: Tradeoff, recommendation: Recommendation) -> str:
    """Return a recommendation in words."""
    tolerance = percent(study.settings.tolerance)
    measured = [GROUP_NAMES[group] for group in recommendation.groups if group != DEFORMATION]
    keeps_verdict = DEFORMATION in recommendation.groups
    if recommendation.row is None:
        whats = [f"{join_words(measured)} within {tolerance}"] if measured else []
        whats += [GROUP_NAMES[DEFORMATION]] if keeps_verdict else []
        return f"Nothing cheaper keeps {' and '.join(whats)}: use all points."
    how = _how(study, recommendation.row, recommendation.corrected)
    if not measured:
        return f"For the same verdict on deformation ({study.exact.verdict}), {how}."
    same = f", and the same verdict on deformation ({study.exact.verdict})" if keeps_verdict else ""
    return f"For errors below {tolerance} of {join_words(measured)}{same}, {how}."


def _how(study: Tradeoff, row: TradeoffRow, corrected: bool) -> str:
    correction = ", and correct mean distances by their floors" if corrected else ""
    exact = study.exact.cpu_s
    times = f"{_seconds(row.cpu_ratio * exact)} instead of {_seconds(exact)}"
    return f"{row.instruction}{correction}: it takes {row.cpu_ratio:.2g} of the CPU time ({times})"


def warnings(study: Tradeoff) -> Iterator[str]:
    """Yield what not to trust: uncertain times, what was left out, and what failed."""
    if study.exact.cpu_spread > _MAX_CPU_SPREAD:
        yield (
            f"CPU seconds of the exact comparison differ by {percent(study.exact.cpu_spread)} between rounds: smaller"
            " savings are uncertain; repeat the study without other load"
        )
    if zero := [name for name, value in study.exact.values.items() if value == 0]:
        yield f"the exact value of {join_words(zero)} is 0: an approximation keeps it only if its value is 0 too"
    for line in study.skipped:
        yield f"skipped: {line}"
    for row in study.rows:
        if row.message:
            yield f"failed: {row.name}: {row.message}"


def _seconds(seconds: float) -> str:
    return duration(seconds) if seconds >= 10 else f"{seconds:.2g} s"


def percent(share: float) -> str:
    """Return a share in percent, with three significant digits."""
    return f"{100 * share:.3g} %"
