"""All metrics of a comparison as table lines, Markdown, HTML and rows of `metrics.csv`."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Iterator, Sequence
from html import escape
from typing import NamedTuple

from pcbench.measure.quantities import quantities
from pcbench.measure.quantity import Quantity
from pcbench.measure.results import ARROWS, CANDIDATE_TO_REFERENCE, REFERENCE_TO_CANDIDATE, Candidate
from pcbench.report.answer import answer
from pcbench.report.inputs import SourcedComparison
from pcbench.report.markup import markdown_row
from pcbench.report.notes import details, remarks, warnings
from pcbench.report.words import UNKNOWN, number, title

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


def rows(comparison: SourcedComparison) -> Iterator[Row]:
    """Yield each number of a comparison as a row of metrics.csv."""
    unit = comparison.reference.unit or "unit"
    for candidate in comparison.candidates:
        for q in quantities(candidate):
            name = (candidate.name, q.metric, q.variant, q.threshold, q.direction)
            yield Row(*name, q.definition, q.value, q.unit_name(unit), *(q.interval or (None, None)))


class Line(NamedTuple):
    """A line of the table: a label, and two cells for each candidate.

    Attributes:
        label: name of the metric.
        cells: (c→r, r→c) for each candidate; the second is empty if a number has no direction.
    """

    label: str
    cells: list[tuple[str, str]]


def lines(comparison: SourcedComparison, *, intervals: bool = False) -> Iterator[Line | None]:
    """Yield all lines of the table, with 95 % confidence intervals on request; None separates sections."""
    candidates = comparison.candidates
    registered = [c.registration for c in candidates]
    yield Line("points", [(f"{c.points:,}", "") for c in candidates])
    yield Line("points in region", [(f"{c.points_in_region:,}", "") for c in candidates])
    yield Line("registration", [(r.method.partition(":")[0], "") for r in registered])
    yield Line("  rmse", [(number(r.rmse), "") for r in registered])
    yield Line("  overlap", [(f"{r.overlap:.1%}", "") for r in registered])
    section = ""
    for row in across(candidates, lambda quantity: bool(quantity.label)):
        first = row.first
        if first.section != section:
            yield None
            section = first.section
            if section == "deformation":
                yield Line("deformation", [(c.deformation.label, "") for c in candidates])
        yield Line(first.label, row.cells(lambda q: number(q.value, q.interval if intervals else None)))


class Across(NamedTuple):
    """The quantities of one line: two columns per candidate."""

    pairs: list[list[Quantity | None]]

    @property
    def first(self) -> Quantity:
        """The first quantity; all have the same label."""
        return next(quantity for pair in self.pairs for quantity in pair if quantity is not None)

    def cells(self, text: Callable[[Quantity], str]) -> list[tuple[str, str]]:
        """Return the texts of both columns for each candidate; a column without any quantity is empty."""
        empty = ["" if all(pair[k] is None for pair in self.pairs) else UNKNOWN for k in (0, 1)]
        left, right = ([empty[k] if (q := pair[k]) is None else text(q) for pair in self.pairs] for k in (0, 1))
        return list(zip(left, right, strict=True))


def across(candidates: Sequence[Candidate], is_shown: Callable[[Quantity], bool]) -> list[Across]:
    """Return the quantities of several candidates side by side, in the order of `quantities`."""
    found: dict[Hashable, Across] = {}
    for k, candidate in enumerate(candidates):
        for quantity in filter(is_shown, quantities(candidate)):
            row = found.setdefault(quantity.row, Across([[None, None] for _ in candidates]))
            row.pairs[k][quantity.column] = quantity
    return list(found.values())


def markdown(comparison: SourcedComparison) -> str:
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
    for line in lines(comparison, intervals=True):
        if line is not None:
            label = f"&nbsp;&nbsp;{line.label.strip()}" if line.label.startswith("  ") else line.label
            text.append(markdown_row([label, *(text for cell in line.cells for text in cell)]))
    text += ["", _legend(comparison), "", *(f"- {sentence}" for sentence in details(comparison))]
    return "\n".join(text).rstrip() + "\n"


def html(comparison: SourcedComparison) -> str:
    """Return the table of a notebook: answer, warnings, all metrics, and differences, with escaped names."""
    right, left = "text-align:right;padding:1px 10px", "text-align:left;padding:1px 10px"
    names = "".join(f'<th colspan="2" style="text-align:center">{escape(c.name)}</th>' for c in comparison)
    directions = "".join(
        f'<th style="{right}">{_DIRECTIONS[direction]} {arrow}</th>'
        for _ in comparison
        for direction, arrow in ARROWS.items()
    )
    body = []
    for line in lines(comparison):
        if line is not None:
            is_detail = line.label.startswith("  ")
            style = f"{left};font-weight:normal;padding-left:2em;opacity:0.75" if is_detail else left
            cells = "".join(f'<td style="{right}">{escape(text)}</td>' for pair in line.cells for text in pair)
            body.append(f'<tr><th scope="row" style="{style}">{escape(line.label.strip())}</th>{cells}</tr>')
    first = [
        *answer(comparison),
        *remarks(comparison),
        *(f"warning: {warning}" for warning in warnings(comparison)),
    ]
    return (
        f"<p><b>{escape(title(comparison))}</b></p>{_list(first)}"
        f"<table><thead><tr><th></th>{names}</tr><tr><th></th>{directions}</tr></thead><tbody>{''.join(body)}</tbody></table>"
        f"{_list(details(comparison))}<p>{escape(_legend(comparison))}</p>"
    )


def _list(sentences: Iterable[str]) -> str:
    return f"<ul>{''.join(f'<li>{escape(sentence)}</li>' for sentence in sentences)}</ul>"


def _legend(comparison: SourcedComparison) -> str:
    return _LEGEND.format(unit=comparison.reference.unit or "the files' unit")
