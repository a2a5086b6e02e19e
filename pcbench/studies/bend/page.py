"""The article of the experiment: what deforms the scene, failed solutions, the table and the picture."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

from pcbench.measure.wording import pluralize
from pcbench.report.article import Article, ArticleSection, Block, Bullets, DataTable, Figure, Paragraph
from pcbench.report.words import join_words
from pcbench.studies.bend.findings import failures, table
from pcbench.studies.bend.results import BendStudy, measured_bends

_LEGEND = (
    "error px: mean reprojection error; lens px: RMS error of the lens; bend RMS: deformation beyond affine against the"
    " truth{unit}; detectable: RMS of the smallest dome that would have been stated{unit}; to the first: deformation"
    " against the first solution{unit}; (?): verdict that holds if the pose is right; the registration is doubtful."
)
_CAPTION = (
    "Vertical displacement by distance from the centre; deformation by error of the lens; maps of vertical displacement"
    " of each solution"
)


def article(study: BendStudy, figures: Sequence[str] = ()) -> Article:
    """Return the experiment as an article.

    Args:
        study: the experiment.
        figures: files of its pictures, relative to the folder of the experiment.
    """
    unit = f" [{study.unit}]" if study.unit else ""
    blocks: list[Block] = [
        *(Figure(file, _CAPTION) for file in figures),
        DataTable("Deformation of each solution", list(table(study))),
        Paragraph(_LEGEND.format(unit=unit)),
    ]
    sections = [ArticleSection("Solutions", blocks)]
    if notes := _by_text((row.name, note) for row in study.rows for note in row.notes):
        sections.append(ArticleSection("Notes of the reconstructor", [Bullets(notes)], pluralize(len(notes), "note")))
    return Article(
        kind="Causes of deformation",
        title=f"What deforms the clouds of {Path(study.scene.path).name}",
        answer=study.sentences,
        warnings=list(_warnings(study)),
        setup=[
            f"{pluralize(len(study.rows), 'solution')} of {pluralize(study.scene.images, 'image')} by {study.plugin},"
            f" with different settings; the deformation of {len(measured_bends(study.rows))} of them could be measured,"
            " against the truth and against the first solution."
        ],
        sections=sections,
    )


def _warnings(study: BendStudy) -> list[str]:
    """Return failures, and warnings of the tests for deformation."""
    doubts = ((row.name, text) for row in study.rows if row.truth is not None for text in row.truth.warnings)
    return [*failures(study), *_by_text(doubts)]


def _by_text(named: Iterable[tuple[str, str]]) -> list[str]:
    """Return one sentence for each text, with the names of all solutions that have it."""
    names: dict[str, list[str]] = {}
    for name, text in named:
        names.setdefault(text, []).append(repr(name))
    return [f"{join_words(solutions)}: {text}" for text, solutions in names.items()]
