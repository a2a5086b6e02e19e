"""An evaluation in sentences: which method is best, by how much, and whether that is told from chance."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence

from pcbench.measure.wording import with_unit
from pcbench.report.words import interval_text, join_words
from pcbench.studies.evaluate.means import MIN_SCENES
from pcbench.studies.evaluate.results import FAILED, MISSING, OK, MethodComparison, MethodMean, ScoreColumn

_MAX_ANSWERS = 4  # scores in the answer; the tables have all
_MAX_LINES = 8  # pairs without scores that are listed


def answer(study: MethodComparison) -> Iterator[str]:
    """Yield the best method of each chosen score, and by how much it is better than the others."""
    if not any(pair.status == OK for pair in study.pairs):
        yield "No pair could be evaluated."
        return
    ranked = [column for column in study.chosen_columns if column.better is not None]
    candidates = [_scores(study, ranked)] if len(study.methods) == 1 else [_best(study, column) for column in ranked]
    sentences = [sentence for sentence in candidates if sentence]
    yield from sentences[:_MAX_ANSWERS]
    if not sentences:
        yield "No score has a value for all methods on the same scene."


def _scores(study: MethodComparison, columns: Sequence[ScoreColumn]) -> str:
    """Return the scores of the only method in one sentence; empty if it has none."""
    means = [(column, mean) for column in columns for mean in study.means_of(column.name) if mean.mean is not None]
    if not means:
        return ""
    scores = join_words([f"{column.name} {with_unit(f'{mean.mean:.4g}', column.unit)}" for column, mean in means], 6)
    if len(study.scenes) == 1:
        return f"{study.methods[0]} on {study.scenes[0]}: {scores}."
    return f"{study.methods[0]}, means over {scenes_text(max(mean.scenes for _, mean in means))}: {scores}."


def _best(study: MethodComparison, column: ScoreColumn) -> str:
    means = sorted((mean for mean in study.means_of(column.name) if mean.rank is not None), key=lambda m: m.rank or 0)
    if not means:
        return ""
    first, *others = means
    extreme = "lowest" if column.better == "lower" else "highest"
    where = f"on {study.scenes[0]}" if len(study.scenes) == 1 else f"over {scenes_text(first.scenes)}"
    value = with_unit(f"{first.mean:.4g}", column.unit)
    noun = "mean" if first.scenes > 1 else "value"
    if not others:
        return f"{column.name}: {first.method} has a {noun} of {value} {where}."
    start = f"{column.name}: {first.method} has the {extreme} {noun}, {value} {where}"
    if equal := [mean.method for mean in others if mean.rank == 1]:
        return f"{start}, as {'has' if len(equal) == 1 else 'have'} {join_words(equal)}."
    start = f"{start}; {others[0].method} is second ({_difference(others[0], column.unit)})"
    if first.scenes == 1:
        return f"{start}."
    if first.scenes < MIN_SCENES:
        return f"{start}; {MIN_SCENES} or more scenes would tell whether that is chance."
    if similar := [mean.method for mean in others if not mean.differs]:
        return f"{start}; these scenes do not tell {first.method} from {join_words(similar)}."
    which = "this interval" if len(others) == 1 else "the interval of each difference to it"
    return f"{start}; {which} excludes zero."


def _difference(mean: MethodMean, unit: str) -> str:
    """Return a difference with its interval, such as "+0.08 mm [0.03, 0.13]"."""
    interval = "" if mean.low is None or mean.high is None else f" {interval_text((mean.low, mean.high))}"
    return f"{with_unit(f'{mean.difference:+.3g}', unit)}{interval}"


def scenes_text(count: int) -> str:
    """Return a number of scenes in words."""
    return "one scene" if count == 1 else f"{count} scenes"


def matched_methods(names: Sequence[str]) -> Iterator[str]:
    """Yield which methods the placeholder {method} stood for, if there are any."""
    if names:
        yield f"{{method}} matched {join_words(names, _MAX_LINES)}."


def warnings(study: MethodComparison, notes: Sequence[str] = ()) -> Iterator[str]:
    """Yield what not to trust: pairs without scores, and means over fewer scenes than there are.

    Args:
        study: the evaluation.
        notes: remarks on the plan.
    """
    yield from _incomplete_means(study)
    for status, what in ((MISSING, "have no file"), (FAILED, "failed")):
        rows = [pair for pair in study.pairs if pair.status == status]
        if not rows:
            continue
        yield f"{len(rows)} of {len(study.pairs)} pairs {what if len(rows) > 1 or status == FAILED else 'has no file'}"
        for pair in rows[:_MAX_LINES]:
            yield f"{pair.method}, {pair.scene}: {pair.message}"
        if len(rows) > _MAX_LINES:
            yield f"{len(rows) - _MAX_LINES} further pairs: see evaluate.csv"
    yield from notes
    yield from _common_notes(study)


def _incomplete_means(study: MethodComparison) -> Iterator[str]:
    """Yield over how many scenes the means are, if that is not all of them, and the methods without means."""
    scenes_of_scores: dict[int, list[str]] = {}
    empty: dict[str, list[str]] = {}
    for column in study.chosen_columns:
        means = study.means_of(column.name)
        count = max((mean.scenes for mean in means), default=0)
        if count < len(study.scenes):
            scenes_of_scores.setdefault(count, []).append(column.name)
        for mean in means:
            if count and mean.scenes == 0:
                empty.setdefault(mean.method, []).append(column.name)
    total, chosen = len(study.scenes), len(study.chosen_columns)
    for count, names in scenes_of_scores.items():
        which = "all means" if len(names) == chosen else f"the means of {join_words(names, 4)}"
        if count:
            yield f"{which} are over the {count} of {total} scenes for which all methods have scores"
        else:
            yield f"{which} are undefined: there is no scene for which all methods have scores"
    for method, names in empty.items():
        which = "" if len(names) == chosen else f" {join_words(names, 4)}"
        yield f"{method} has no score{which} and is not ranked"


def _common_notes(study: MethodComparison) -> Iterator[str]:
    """Yield the notes of pairs, those of several pairs once."""
    measured = [pair for pair in study.pairs if pair.status == OK]
    counts = Counter(note for pair in measured for note in dict.fromkeys(pair.notes))
    own = [note for note, count in counts.items() if count == 1 and len(measured) > 1]
    for note, count in counts.items():
        if note not in own:
            where = "" if count == len(measured) else f" ({count} of {len(measured)} pairs)"
            yield f"{note}{where}"
    if own:
        owners = sum(any(note in own for note in pair.notes) for pair in measured)
        yield f"notes on {owners} of {len(measured)} pairs are on their own pages"
