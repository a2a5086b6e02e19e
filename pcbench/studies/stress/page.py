"""The article of the stress study: the answer first, then sentences, tables and pictures by subject."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import PurePath

from pcbench.measure.wording import pluralize
from pcbench.report.article import Article, ArticleSection, Block, Bullets, DataTable, Figure, Heading, Paragraph
from pcbench.studies.frame.canvas import FIGURES
from pcbench.studies.stress.results import (
    ALL_SUBJECTS,
    CHANGES,
    METRICS,
    RECONSTRUCTION,
    REGISTRATION,
    VERDICTS,
    PhotographInfo,
    StressStudy,
)
from pcbench.studies.stress.table import (
    LIMITS_LEGEND,
    OUTCOMES_LEGENDS,
    limits_table,
    outcome_table,
    preset_table,
)
from pcbench.studies.stress.words import (
    answer,
    change_sentences,
    metric_sentences,
    reconstruction_sentences,
    registration_sentences,
    verdict_sentences,
    warnings,
)
from pcbench.studies.stress.worst import failure_title

_SENTENCES: dict[str, Callable[[StressStudy], Iterator[str]]] = {
    REGISTRATION: registration_sentences,
    METRICS: metric_sentences,
    VERDICTS: verdict_sentences,
    CHANGES: change_sentences,
    RECONSTRUCTION: reconstruction_sentences,
}
_TITLES = {
    REGISTRATION: "Registration",
    METRICS: "Metrics and their intervals",
    VERDICTS: "Verdicts on deformation",
    CHANGES: "Changes",
    RECONSTRUCTION: "Reconstructors",
}
_CAPTIONS = {
    "outcomes_": "Outcomes of each method",
    "matrix_": "Failed runs by method and perturbation",
    "recall": "Recall against the pose error",
    "basin_": "Right poses by rotation and offset of the start",
    "profiles": "Performance profiles",
    "speed": "Success and errors with confidence beside CPU seconds",
    "sizes": "Detected deformations, and measured sizes",
    "coverage": "Coverage of the 95 % intervals",
    "severity_": "Success against severity",
    "scores_": "F-score, RMS error and CPU seconds against severity",
}
_PICTURES = {
    REGISTRATION: ("outcomes_registration", "matrix_registration", "recall", "basin_", "profiles", "speed"),
    METRICS: ("outcomes_metrics", "matrix_metrics", "coverage"),
    VERDICTS: ("outcomes_verdicts", "matrix_verdicts", "sizes"),
    CHANGES: ("outcomes_changes", "matrix_changes"),
    RECONSTRUCTION: ("outcomes_reconstruction", "scores_", "matrix_reconstruction"),
}


def article(study: StressStudy, figures: Sequence[str] = ()) -> Article:
    """Return the study as an article.

    Args:
        study: the study.
        figures: files of its pictures, relative to the folder of the study.
    """
    title = "Where reconstructors break" if study.photographs else "Where registration, metrics and verdicts break"
    sections = [
        ArticleSection(_TITLES[subject], list(_blocks(study, subject, figures)))
        for subject in ALL_SUBJECTS
        if study.cells(subject)
    ]
    if study.worst:
        sections.append(ArticleSection("The worst silent failures", list(_worst_blocks(study, figures))))
    return Article("Stress test", title, list(answer(study)), list(warnings(study)), [_setup(study)], sections)


def _blocks(study: StressStudy, subject: str, figures: Sequence[str]) -> Iterator[Block]:
    yield from _pictures(figures, _PICTURES[subject][:1])
    yield DataTable(f"Outcomes, {_TITLES[subject]}", outcome_table(study, subject))
    yield Paragraph(f"Shares of all runs in %; {OUTCOMES_LEGENDS[subject]}.")
    yield Bullets(list(_SENTENCES[subject](study)))
    yield Heading("Safe levels")
    yield DataTable(f"Safe levels, {_TITLES[subject]}", limits_table(study, subject))
    yield Paragraph(f"Each cell: {LIMITS_LEGEND}.")
    if subject == REGISTRATION and (presets := preset_table(study)):
        yield Heading("Recall by the criteria of benchmarks")
        yield DataTable("Recall by the criteria of benchmarks", presets)
    yield from _pictures(figures, (*_PICTURES[subject][1:], f"severity_{subject}_"))


def _worst_blocks(study: StressStudy, figures: Sequence[str]) -> Iterator[Block]:
    yield Paragraph("Wrong poses without a warning that the pose may be wrong, those with the largest relative errors.")
    for number, failure in enumerate(study.worst, 1):
        title = f"{number}. {failure_title(study, failure)}"
        file = f"{FIGURES}/worst_{number}.png"
        yield Figure(file, title) if file in figures else Paragraph(f"{title}.")


def _pictures(figures: Sequence[str], stems: Sequence[str]) -> Iterator[Figure]:
    """Yield the pictures whose names begin with given stems, with their captions."""
    for stem in stems:
        for file in figures:
            name = PurePath(file).stem
            if name.startswith(stem):
                caption = next(text for start, text in _CAPTIONS.items() if name.startswith(start))
                kind = name.rpartition("_")[2]
                yield Figure(file, f"{caption} ({kind})" if stem.startswith(("severity_", "scores_")) else caption)


def _setup(study: StressStudy) -> str:
    """Return the size of the study in sentences."""
    if study.photographs is not None:
        return _photograph_setup(study, study.photographs)
    runs = sum(len(study.cells(subject)) for subject in ALL_SUBJECTS)
    scenes = "; ".join(
        f"{scene.name}: {scene.points[0]:,} and {scene.points[1]:,} points, extent"
        f" {scene.extent:.3g} {scene.unit}, spacing {scene.spacing:.3g} {scene.unit}".rstrip()
        for scene in study.scenes
    )
    counts = ", ".join(pluralize(count, noun) for count, noun in (
        (len(study.registrations), "registration"), (len(study.metrics), "metric value"),
        (len(study.verdicts), "verdict"), (len(study.changes), "search for changes"),
    ) if count)  # fmt: skip
    return (
        f"{pluralize(runs, 'result')} ({counts}) on {pluralize(len(study.ladders), 'ladder')} of perturbations."
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
