"""The answer of the study in sentences: what to use for the tolerance, what thinning biases, and what was left out."""

from __future__ import annotations

from collections.abc import Iterator

from pcbench.measure.wording import pluralize
from pcbench.progress import duration
from pcbench.report.words import join_words
from pcbench.studies.frame.rates import Rate
from pcbench.studies.tradeoff.approximations import BOTH, CANDIDATE, DISK, RANDOM, REFERENCE, THINNING, VOXEL
from pcbench.studies.tradeoff.metrics import DEFORMATION, GROUP_NAMES, MEAN_DISTANCES
from pcbench.studies.tradeoff.recommend import Recommendation, known_groups, recommend, recommendations
from pcbench.studies.tradeoff.results import Tradeoff, TradeoffRow

_MAX_CPU_SPREAD = 0.2
_MAX_LEFT_SHARE = 0.25  # share of the bias that a working correction leaves at most
# Cloud to which each mean distance is measured: thinning it makes the distance larger.
SEARCHED = {"mean c→r": REFERENCE, "mean r→c": CANDIDATE}


def sentences(study: Tradeoff) -> tuple[str, ...]:
    """Return all sentences: recommendations, bias, verdict."""
    return (*answer(study), *bias_sentences(study), *verdict_sentences(study))


def answer(study: Tradeoff) -> Iterator[str]:
    """Yield a recommendation for each group of metrics, and one for all of them."""
    if all(row.message for row in study.rows):
        yield "No approximation could be measured: use all points."
        return
    parts = recommendations(study)
    for part in parts:
        yield recommendation_sentence(study, part)
    if len(parts) > 1:
        whole = recommend(study, known_groups(study))
        if whole.row is not None:
            yield f"To keep all of these, {_how(study, whole.row, whole.corrected)}."
        elif any(part.row is not None for part in parts):
            yield "Nothing cheaper keeps all of these at once."


def recommendation_sentence(study: Tradeoff, found: Recommendation) -> str:
    """Return a recommendation in words."""
    tolerance = percent(study.settings.tolerance)
    measured = [GROUP_NAMES[group] for group in found.groups if group != DEFORMATION]
    keeps_verdict = DEFORMATION in found.groups
    if found.row is None:
        whats = [f"{join_words(measured)} within {tolerance}"] if measured else []
        whats += [GROUP_NAMES[DEFORMATION]] if keeps_verdict else []
        return f"Nothing cheaper keeps {' and '.join(whats)}: use all points."
    how = _how(study, found.row, found.corrected)
    if not measured:
        return f"For the same verdict on deformation ({study.exact.verdict}), {how}."
    same = f", and the same verdict on deformation ({study.exact.verdict})" if keeps_verdict else ""
    return f"For errors below {tolerance} of {join_words(measured)}{same}, {how}."


def _how(study: Tradeoff, row: TradeoffRow, corrected: bool) -> str:
    correction = ", and correct mean distances by their floors" if corrected else ""
    exact = study.exact.cpu_s
    times = f"{_seconds(row.cpu_ratio * exact)} instead of {_seconds(exact)}"
    return f"{row.instruction}{correction}: it takes {row.cpu_ratio:.2g} of the CPU time ({times})"


def bias_sentences(study: Tradeoff) -> Iterator[str]:
    """Yield how thinning the searched cloud biases each mean distance, and what the correction by the floor leaves."""
    for name, side in SEARCHED.items():
        for kind in THINNING:
            rows = [
                row
                for row in study.rows
                if row.family == kind and row.side in (side, BOTH) and _has_bias(row, name) and row.corrected.get(name)
            ]
            if rows:
                yield _bias_sentence(name, side, kind, rows)


def _bias_sentence(name: str, side: str, kind: str, rows: list[TradeoffRow]) -> str:
    last = min(rows, key=lambda row: (row.level, row.side == BOTH))
    before = last.errors[name]
    after = last.corrected[name]
    assert before is not None and after is not None
    corrected = sum(_is_corrected(row, name) for row in rows)
    which = "both clouds" if last.side == BOTH else f"the {side}"
    how = {RANDOM: "at random", VOXEL: "by voxels", DISK: "by Poisson disks"}[kind]
    verdict = (
        f"the correction by the floor leaves {signed(after.mean)}"
        if abs(after.mean) <= _MAX_LEFT_SHARE * abs(before.mean)
        else f"the correction by the floor fails ({signed(after.mean)})"
    )
    return (
        f"Thinning {which} {how} to {percent(last.level)} changes the {MEAN_NAMES[name]} by {signed(before.mean)};"
        f" {verdict}. It removes most of the bias in {corrected} of {pluralize(len(rows), 'such thinning')}."
    )


MEAN_NAMES = {name: name.replace("mean", "mean distance") for name in MEAN_DISTANCES}


def _has_bias(row: TradeoffRow, name: str) -> bool:
    error = row.errors.get(name)
    return error is not None and error.mean != 0


def _is_corrected(row: TradeoffRow, name: str) -> bool:
    before, after = row.errors[name], row.corrected[name]
    return before is not None and after is not None and abs(after.mean) <= _MAX_LEFT_SHARE * abs(before.mean)


def verdict_sentences(study: Tradeoff) -> Iterator[str]:
    """Yield how often approximations change the verdict on deformation, with a Wilson interval."""
    measured = [row for row in study.rows if not row.message]
    total = sum(row.same_verdict.total for row in measured)
    kept = Rate(sum(row.same_verdict.kept for row in measured), total)
    if not total:
        return
    low, high = kept.interval
    changed = [row.name for row in measured if row.same_verdict.kept < row.same_verdict.total]
    text = (
        f"The verdict on deformation is {study.exact.verdict} in {kept.count} of {pluralize(total, 'run')},"
        f" {percent(kept.share)} [{100 * low:.3g}, {100 * high:.3g}]"
    )
    yield f"{text}; it changes with {join_words(changed)}." if changed else f"{text}."


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


def signed(share: float) -> str:
    """Return a relative error in percent with its sign."""
    return "0 %" if share == 0 else f"{100 * share:+.2g} %" if abs(share) < 0.1 else f"{100 * share:+.0f} %"
