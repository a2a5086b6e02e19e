"""The page of the trade-off study: the answer first, then charts and tables."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from pcbench.report.markup import markdown_table
from pcbench.studies.tradeoff.results import Tradeoff
from pcbench.studies.tradeoff.table import LEGEND, error_rows, table_rows
from pcbench.studies.tradeoff.words import answer, bias_sentences, caveats, percent, verdict_sentences

CAPTIONS = {
    "errors.png": "Error of each metric beside CPU seconds",
    "bias.png": "Bias of mean distances to thinned clouds, with and without the correction by the floor",
}


def page(study: Tradeoff, figures: Sequence[str] = ()) -> str:
    """Return the text of tradeoff.md; `figures` are the names of the charts in `figures/`."""
    exact = study.exact
    unit = f" {exact.unit}" if exact.unit else ""
    threshold = "" if exact.threshold is None else f" F-score at {exact.threshold:.4g}{unit}."
    setup = (
        f"Reference of {exact.points[0]:,} and candidate of {exact.points[1]:,} points; the exact comparison takes"
        f" {exact.cpu_s:.3g} CPU s. {study.settings.seeds} rounds with different seeds; intervals are 95 % prediction"
        f" intervals of one run.{threshold}"
    )
    parts = [
        f"# What cheaper comparisons cost, at a tolerance of {percent(study.settings.tolerance)}",
        _bullets(answer(study)),
        setup,
        _image("errors.png", figures),
        markdown_table(table_rows(study), 1),
        f"{LEGEND[0].upper()}{LEGEND[1:]}.",
        "## Bias of mean distances",
        _bullets(bias_sentences(study)),
        _image("bias.png", figures),
        "## The verdict on deformation",
        _bullets(verdict_sentences(study)),
        "## Errors of all metrics in %",
        markdown_table(error_rows(study), 1),
    ]
    if notes := _bullets(caveats(study)):
        parts += ["## Left out", notes]
    return "\n\n".join(filter(None, parts)) + "\n"


def _image(name: str, figures: Sequence[str]) -> str:
    return f"![{CAPTIONS[name]}](figures/{name})" if name in figures else ""


def _bullets(sentences: Iterable[str]) -> str:
    return "\n".join(f"- {sentence}" for sentence in sentences)
