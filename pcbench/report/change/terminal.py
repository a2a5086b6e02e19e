"""A measured change on the terminal: the answer, the warnings, the table of volumes, and what the intervals assume."""

from __future__ import annotations

from collections.abc import Iterator

from pcbench.report.change.document import ChangeDocument
from pcbench.report.change.tables import MOST_PARTS, series_rows, text_table, volume_rows
from pcbench.report.change.words import answer, error_sentences, extent_sentences, uncertainty_sentence


def change_lines(document: ChangeDocument) -> Iterator[str]:
    """Yield the lines that `pcbench change` prints."""
    yield from answer(document)
    for warning in document.warnings:
        yield f"warning: {warning}"
    for change in document.changes:
        yield ""
        if len(document.changes) > 1:
            yield f"until {change.epoch}:"
        yield from text_table(volume_rows(document, change))
        if change.part_count > MOST_PARTS:
            yield f"the largest {MOST_PARTS} of {change.part_count:,} parts; volumes.csv of --out lists more"
    if len(document.changes) > 1 or document.places:
        yield ""
        yield from text_table(series_rows(document))
    yield ""
    yield uncertainty_sentence(document)
    for change in document.changes:
        yield from error_sentences(document, change)
    yield from extent_sentences(document)
