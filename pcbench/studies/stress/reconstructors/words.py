"""Conclusions on reconstructors as sentences, computed from the cells alone."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from statistics import median

from pcbench.measure.wording import pluralize
from pcbench.report.words import join_words
from pcbench.studies.stress.limits import StressRow, ladder_counts, limit_text, safe_ranges
from pcbench.studies.stress.reconstructors.ladders import UNPERTURBED
from pcbench.studies.stress.results import (
    CRASH,
    DEGRADED,
    REFUSED,
    RIGHT,
    TIME_OUT,
    WARNED,
    ReconstructionCell,
    StressStudy,
    Tally,
    grouped,
)

_MAX_MESSAGE_LETTERS = 160


def limit_sentences(study: StressStudy, row: StressRow) -> Iterator[str]:
    """Yield the score of the unperturbed scene, the limits of a method, and how often it degrades without a warning."""
    cells = reconstructions(row)
    unperturbed = [cell for cell in cells if cell.ladder == UNPERTURBED]
    known = [cell.fscore for cell in unperturbed if cell.fscore is not None]
    if not known:
        yield f"{row.name}: no cloud of the unperturbed scene can be measured, so its other clouds cannot be judged."
        return
    threshold = next(cell.threshold for cell in unperturbed if cell.threshold is not None)
    seconds = [cell.cpu_s for cell in unperturbed if cell.cpu_s is not None]
    cost = f", in {median(seconds):.2g} CPU s" if seconds else ""
    yield f"{row.name}: F-score {median(known):.2g} at {threshold:.3g} m on the unperturbed scene{cost}."
    ranges = safe_ranges(study, row)
    kept = [limit_text(found) for found in ranges if found.safe_levels]
    lost = [found.ladder.title for found in ranges if not found.safe_levels]
    parts = [f"keeps at least half of its F-score {join_words(kept)}"] if kept else []
    parts += [f"does not keep half at any tested level of {join_words(lost)}"] if lost else []
    if parts:
        yield f"{row.name} {'; it '.join(parts)}."
    perturbed = Tally.of(cell for cell in cells if cell.ladder != UNPERTURBED)
    if perturbed.total:
        degraded = [cell for cell in cells if cell.ladder != UNPERTURBED and cell.outcome == DEGRADED]
        places = f": {ladder_counts(study, degraded, DEGRADED)}" if degraded else ""
        yield (
            f"{row.name} delivers a cloud with less than half of its F-score, without a warning, in"
            f" {len(degraded)} of {pluralize(perturbed.total, 'perturbed run')}{places}."
        )
    doubted = [cell for cell in cells if cell.outcome == RIGHT and cell.warns]
    if doubted:
        right = sum(cell.outcome == RIGHT for cell in cells)
        yield f"{row.name} warns about {len(doubted)} of {pluralize(right, 'cloud')} that keep half of its F-score."


def failure_sentences(study: StressStudy, row: StressRow) -> Iterator[str]:
    """Yield what a method does at the levels at which it does not keep half of its F-score, one sentence per ladder."""
    by_ladder = grouped(reconstructions(row), lambda cell: cell.ladder)
    for ladder in study.ladders:
        by_level = grouped(by_ladder.get(ladder.name, []), lambda cell: cell.level)
        levels: dict[str, list[str]] = {}  # by what the method does at them
        for level, cells in by_level.items():
            failed = [cell for cell in cells if cell.outcome != RIGHT]
            if failed:
                runs = f" in {len(failed)} of {pluralize(len(cells), 'run')}" if len(cells) > 1 else ""
                levels.setdefault(f"{_failures(failed)}{runs}", []).append(ladder.level_text(level))
        if levels:
            title = "" if ladder.is_list else f", {ladder.title}"
            at = "for" if ladder.is_list else "at"
            parts = [f"{at} {join_words(names, len(names))} it {text}" for text, names in levels.items()]
            yield f"{row.name}{title}: {'; '.join(parts)}."


def case_sentences(study: StressStudy, row: StressRow) -> Iterator[str]:
    """Yield the F-scores of the cases of lists."""
    by_ladder = grouped(reconstructions(row), lambda cell: cell.ladder)
    for ladder in study.ladders:
        if not ladder.is_list or ladder.name == UNPERTURBED:
            continue
        scores = []
        for level, cells in grouped(by_ladder.get(ladder.name, []), lambda cell: cell.level).items():
            known = [cell.fscore for cell in cells if cell.fscore is not None]
            if known:
                scores.append(f"{median(known):.2g} for {ladder.level_text(level)}")
        if scores:
            yield f"{row.name}, {ladder.title}: F-score {join_words(scores, len(scores))}."


def reconstructions(row: StressRow) -> list[ReconstructionCell]:
    """Return the cells of a row of reconstructions."""
    return [cell for cell in row.cells if isinstance(cell, ReconstructionCell)]


def _failures(cells: Sequence[ReconstructionCell]) -> str:
    """Return what failed runs of one level did: the kinds of failure, with a score or the first message."""
    return join_words([_failure(outcome, group) for outcome, group in grouped(cells, lambda c: c.outcome).items()])


def _failure(outcome: str, cells: Sequence[ReconstructionCell]) -> str:
    message = next((cell.message for cell in cells if cell.message), "")
    known = [cell.fscore for cell in cells if cell.fscore is not None]
    cloud = f"a cloud with F-score {median(known):.2g}" if known else "a cloud that cannot be measured"
    words = {
        DEGRADED: f"delivers {cloud}, without a warning",
        WARNED: f"delivers {cloud}, and warns",
        REFUSED: "refuses",
        CRASH: "crashes",
        TIME_OUT: "runs out of time",
    }[outcome]
    return f"{words} ({_reason(message)})" if message and outcome not in (DEGRADED, WARNED) else words


def _reason(message: str) -> str:
    """Return the start of a message, up to the first detail: the rest differs between levels."""
    text = re.split("[;:] ", message)[0].rstrip(".")
    return text if len(text) <= _MAX_MESSAGE_LETTERS else f"{text[:_MAX_MESSAGE_LETTERS].rsplit(' ', 1)[0]} ..."
