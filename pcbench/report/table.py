"""All metrics of a comparison as table lines, Markdown, HTML and rows of `metrics.csv`."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from html import escape
from typing import NamedTuple

from pcbench.measure.quantities import quantities
from pcbench.measure.quantity import Quantity
from pcbench.measure.results import ARROWS, CANDIDATE_TO_REFERENCE, REFERENCE_TO_CANDIDATE
from pcbench.report.answer import answer
from pcbench.report.inputs import FinishedComparison
from pcbench.report.layout import Line, LineCell, arrange, label_of
from pcbench.report.markup import markdown_row
from pcbench.report.notes import details, remarks, warnings
from pcbench.report.words import number, title

_DIRECTIONS = {CANDIDATE_TO_REFERENCE: "accuracy", REFERENCE_TO_CANDIDATE: "completeness"}
_LEGEND = (
    "c→r: candidate to reference (accuracy); r→c: reference to candidate (completeness). Lengths in {unit}, mean"
    " squares in its square, [95 % confidence interval]. The sampling floor is the score of independent, error-free"
    " points of the same surface: a value near it reflects point spacing, not error."
)


class Row(NamedTuple):
    """A row of metrics.csv, identified by (candidate, metric, variant, threshold, direction)."""

    candidate: str
    metric: str
    variant: str
    threshold: float | None
    direction: str
    definition: str
    value: float | None
    unit: str
    ci_low: float | None
    ci_high: float | None


def rows(comparison: FinishedComparison) -> Iterator[Row]:
    """Yield each number of a comparison as a row of metrics.csv."""
    unit = comparison.reference.unit or "unit"
    for candidate in comparison.candidates:
        for q in quantities(candidate):
            name = (candidate.name, q.metric, q.variant, q.threshold, q.direction)
            yield Row(*name, q.definition, q.value, q.unit_name(unit), *(q.interval or (None, None)))


def lines(comparison: FinishedComparison) -> Iterator[Line | None]:
    """Yield all lines of the table, with 95 % confidence intervals; None separates groups."""
    candidates = comparison.candidates
    registrations = [c.registration for c in candidates]
    yield Line.of_texts("points", (f"{c.points:,}" for c in candidates))
    yield Line.of_texts("points in region", (f"{c.points_in_region:,}" for c in candidates))
    yield Line.of_texts("registration", (r.method.partition(":")[0] for r in registrations))
    yield Line.of_texts("rmse", (number(r.rmse) for r in registrations), 1)
    yield Line.of_texts("overlap", (f"{r.overlap:.1%}" for r in registrations), 1)
    group = ""
    for line in arrange(candidates, lambda quantity: label_of(quantity) is not None):
        label = label_of(line.first)
        assert label is not None
        if line.first.group != group:
            yield None
            group = line.first.group
            if group == "deformation":
                yield Line.of_texts("deformation", (c.deformation.label for c in candidates))
        yield Line(label.text, line.cells(_cell), label.level)


def _cell(quantity: Quantity) -> LineCell:
    interval = quantity.interval
    return LineCell(number(quantity.value), None if interval is None else (number(interval.low), number(interval.high)))


def markdown(comparison: FinishedComparison) -> str:
    """Return `table.md`: answer, warnings, all metrics with 95 % intervals, legend, and differences."""
    header = ["", *(f"{candidate.name} {arrow}" for candidate in comparison for arrow in ARROWS.values())]
    text = [
        f"# {title(comparison)}",
        "",
        " ".join(answer(comparison)),
        "",
        *(f"- {sentence}" for sentence in remarks(comparison)),
        *(f"- warning: {' '.join(warning.splitlines())}" for warning in warnings(comparison)),
        "",
        markdown_row(header),
        markdown_row(["---"] + ["---:"] * (len(header) - 1)),
    ]
    for line in filter(None, lines(comparison)):
        cells = (cell.with_interval for pair in line.cells for cell in pair)
        text.append(markdown_row([f"{'&nbsp;&nbsp;' * line.level}{line.label}", *cells]))
    text += ["", _legend(comparison), "", *(f"- {sentence}" for sentence in details(comparison))]
    return "\n".join(text).rstrip() + "\n"


def html(comparison: FinishedComparison) -> str:
    """Return the table of a notebook: answer, warnings, all metrics, and differences, with escaped names."""
    number_style, label_style = "text-align:right;padding:1px 10px", "text-align:left;padding:1px 10px"
    names = "".join(f'<th colspan="2" style="text-align:center">{escape(c.name)}</th>' for c in comparison)
    directions = "".join(
        f'<th style="{number_style}">{_DIRECTIONS[direction]} {arrow}</th>'
        for _ in comparison
        for direction, arrow in ARROWS.items()
    )
    body = []
    for line in filter(None, lines(comparison)):
        style = f"{label_style};font-weight:normal;padding-left:2em;opacity:0.75" if line.level else label_style
        cells = "".join(f'<td style="{number_style}">{escape(text)}</td>' for text in line.with_intervals.texts)
        body.append(f'<tr><th scope="row" style="{style}">{escape(line.label)}</th>{cells}</tr>')
    sentences = [
        *answer(comparison),
        *remarks(comparison),
        *(f"warning: {warning}" for warning in warnings(comparison)),
    ]
    return (
        f"<p><b>{escape(title(comparison))}</b></p>{_list(sentences)}"
        f"<table><thead><tr><th></th>{names}</tr><tr><th></th>{directions}</tr></thead><tbody>{''.join(body)}</tbody></table>"
        f"{_list(details(comparison))}<p>{escape(_legend(comparison))}</p>"
    )


def _list(sentences: Iterable[str]) -> str:
    return f"<ul>{''.join(f'<li>{escape(sentence)}</li>' for sentence in sentences)}</ul>"


def _legend(comparison: FinishedComparison) -> str:
    return _LEGEND.format(unit=comparison.reference.unit or "the files' unit")
