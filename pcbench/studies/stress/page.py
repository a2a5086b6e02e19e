"""The article of the stress study: the answer first, then tables and pictures by subject."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import PurePath
from typing import Any

from pcbench.measure.wording import pluralize
from pcbench.report.article import Article, ArticleSection, Block, DataTable, Figure, Heading, Paragraph
from pcbench.studies.frame.canvas import FIGURES
from pcbench.studies.stress.descriptions import PhotographInfo
from pcbench.studies.stress.registration import REGISTRATION
from pcbench.studies.stress.results import StressStudy
from pcbench.studies.stress.subject import Subject
from pcbench.studies.stress.table import LIMITS_LEGEND, limits_table, outcome_table, preset_table
from pcbench.studies.stress.words import answer, warnings
from pcbench.studies.stress.worst import failure_title

# Captions of charts by the start of their names.
_CAPTIONS = {
    "outcomes": "Outcomes of each method",
    "matrix": "Failed runs by method and perturbation",
    "recall": "Recall against the pose error",
    "basin": "Right poses by rotation and offset of the start",
    "profiles": "Performance profiles",
    "speed": "Success and errors with confidence beside CPU seconds",
    "sizes": "Detected deformations, and measured sizes",
    "coverage": "Coverage of the 95 % intervals",
    "severity": "Success against severity",
    "scores": "F-score, RMS error and CPU seconds against severity",
}
_BY_SUBJECT = ("outcomes", "matrix", "severity")  # charts whose names go on with the subject
_BY_KIND = ("severity", "scores")  # charts whose names end with the kind of the ladders


def article(study: StressStudy, figures: Sequence[str] = ()) -> Article:
    """Return the study as an article.

    Args:
        study: the study.
        figures: files of its pictures, relative to the folder of the study.
    """
    title = "Where reconstructors break" if study.photographs else "Where registration, metrics and verdicts break"
    sections = [ArticleSection(s.title, list(_blocks(study, s, figures))) for s in study.subjects()]
    if study.worst:
        sections.append(ArticleSection("The worst silent failures", list(_worst_blocks(study, figures))))
    return Article("Stress test", title, list(answer(study)), list(warnings(study)), [_setup(study)], sections)


def _blocks(study: StressStudy, subject: Subject[Any], figures: Sequence[str]) -> Iterator[Block]:
    first, *others = subject.charts
    yield from _pictures(figures, subject, first)
    yield DataTable(f"Outcomes, {subject.title}", outcome_table(study, subject))
    yield Paragraph(f"Shares of all runs in %; {subject.legend}.")
    yield Heading("Safe levels")
    yield DataTable(f"Safe levels, {subject.title}", limits_table(study, subject))
    yield Paragraph(f"Each cell: {LIMITS_LEGEND}.")
    if subject is REGISTRATION and (presets := preset_table(study)):
        yield Heading("Recall by the criteria of benchmarks")
        yield DataTable("Recall by the criteria of benchmarks", presets)
    for chart in others:
        yield from _pictures(figures, subject, chart)


def _worst_blocks(study: StressStudy, figures: Sequence[str]) -> Iterator[Block]:
    yield Paragraph("Wrong poses without a warning that the pose may be wrong, those with the largest relative errors.")
    for number, failure in enumerate(study.worst, 1):
        title = f"{number}. {failure_title(study, failure)}"
        file = f"{FIGURES}/worst_{number}.png"
        yield Figure(file, title) if file in figures else Paragraph(f"{title}.")


def _pictures(figures: Sequence[str], subject: Subject[Any], chart: str) -> Iterator[Figure]:
    """Yield the pictures of a chart of a subject with their captions."""
    stem = f"{chart}_{subject.name}" if chart in _BY_SUBJECT else chart
    for file in figures:
        name = PurePath(file).stem
        if name.startswith(stem):
            kind = f" ({name.rpartition('_')[2]})" if chart in _BY_KIND else ""
            yield Figure(file, f"{_CAPTIONS[chart]}{kind}")


def _setup(study: StressStudy) -> str:
    """Return the size of the study in sentences."""
    if study.photographs is not None:
        return _photograph_setup(study, study.photographs)
    counts = [(len(study.cells(subject)), subject.noun) for subject in study.subjects()]
    total = sum(count for count, _ in counts)
    nouns = ", ".join(pluralize(count, noun) for count, noun in counts)
    scenes = "; ".join(
        f"{scene.name}: {scene.points[0]:,} and {scene.points[1]:,} points, extent"
        f" {scene.extent:.3g} {scene.unit}, spacing {scene.spacing:.3g} {scene.unit}".rstrip()
        for scene in study.scenes
    )
    return (
        f"{pluralize(total, 'result')} ({nouns}) on {pluralize(len(study.ladders), 'ladder')} of perturbations."
        f" Scenes (reference and candidate): {scenes}. Shares have 95 % Wilson intervals in brackets."
    )


def _photograph_setup(study: StressStudy, info: PhotographInfo) -> str:
    """Return the size of a study of reconstructors in sentences."""
    width, height = info.size
    return (
        f"{pluralize(len(study.reconstructions), 'reconstruction')} on {pluralize(len(study.ladders) - 1, 'ladder')} of"
        f" perturbations. Each scene is a city of {info.extent:g} m with {pluralize(info.images, 'image')} of"
        f" {width} x {height} pixels; a pixel is {info.pixel:.3g} m on the surface. The F-score is measured at"
        f" {info.threshold:.3g} m, over the surface that three cameras of the unperturbed scene saw."
    )
