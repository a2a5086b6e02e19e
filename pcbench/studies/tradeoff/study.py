"""`pcbench tradeoff`: measure what cheaper comparisons of a pair cost in accuracy, and recommend one.

Rounds of the exact comparison and of each approximation give errors with intervals, CPU seconds and memory. The
recommended approximation is the cheapest whose errors stay within a tolerance.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path

from pcbench.errors import InputError
from pcbench.geometry.mesh import Mesh
from pcbench.geometry.mesh_samples import sample_candidate
from pcbench.geometry.neighbors import Index
from pcbench.geometry.sampling import median_spacing
from pcbench.io import CloudLike
from pcbench.io.meshes import to_shape
from pcbench.measure.settings import Settings
from pcbench.report.document import provenance
from pcbench.report.plot import Drawn
from pcbench.studies.frame.folder import check_folder, study_folder
from pcbench.studies.frame.publish import StudyOutcome, draw_here, publish
from pcbench.studies.tradeoff.approximations import Pair, plan
from pcbench.studies.tradeoff.charts import draw_charts
from pcbench.studies.tradeoff.errors import exact_answer, rows
from pcbench.studies.tradeoff.page import article
from pcbench.studies.tradeoff.results import KIND, Tradeoff, TradeoffSettings
from pcbench.studies.tradeoff.runs import check_pair, run_all
from pcbench.studies.tradeoff.table import tradeoff_csv, tradeoff_table
from pcbench.studies.tradeoff.words import answer

CSV, TABLE, RECORDS = "tradeoff.csv", "tradeoff.txt", "runs"
_THRESHOLD_SPACINGS = 2.0  # threshold of the F-score over the spacing of the reference, the second default of `compare`


def run_tradeoff(
    reference: CloudLike | Mesh,
    candidate: CloudLike | Mesh,
    settings: TradeoffSettings | None = None,
    *,
    out: Path | None = None,
    figures: bool = True,
    step: Callable[[str], None] = lambda _: None,
) -> StudyOutcome[Tradeoff]:
    """Run the study of a pair; with `out`, write report.html, tradeoff.json, .csv, .txt, .md and charts to a folder.

    The records of all runs stay in its folder `runs`; a later run of the same pair does not repeat finished rounds.

    Args:
        reference: reference cloud or mesh.
        candidate: candidate cloud.
        settings: settings of the study; None: the defaults.
        out: output folder, or None.
        figures: whether to draw charts into the folder.
        step: progress callback.

    Raises:
        InputError: a cloud or a setting is not usable, the exact comparison fails, or `out` holds something else, or
            another run is writing there,
            or the folder holds the study of another pair.
        OSError: a file cannot be written.
    """
    settings = TradeoffSettings() if settings is None else settings
    if out is not None:
        check_folder(out, KIND)
    step("preparing the approximations")
    pair = make_pair(reference, candidate, settings)
    if out is not None:
        check_pair(pair, out / RECORDS)
    approximations, skipped = plan(pair, settings)
    with nullcontext() if out is None else study_folder(out, KIND, settings):
        records = None if out is None else out / RECORDS
        if records is not None:
            records.mkdir(exist_ok=True)
        runs = list(run_all(pair, approximations, settings, records, step))
        exact = exact_answer(pair, runs)
        compared = tuple(rows(approximations, runs, exact))
        study = Tradeoff(settings, exact, compared, tuple(skipped), provenance=provenance(settings.seed))
        study = replace(study, sentences=tuple(answer(study)))
        if out is None:
            return StudyOutcome(study)

        def draw() -> Drawn:
            step("drawing charts")
            return draw_here(lambda: draw_charts(study, out))

        texts = {CSV: tradeoff_csv(study), TABLE: f"{tradeoff_table(study)}\n"}
        return publish(out, KIND, study, texts, draw if figures else None, partial(article, study), study.provenance)


def make_pair(reference: CloudLike | Mesh, candidate: CloudLike | Mesh, settings: TradeoffSettings) -> Pair:
    """Return the pair with the settings of its exact comparison: those of `compare`, with one fixed threshold.

    Raises:
        InputError: a cloud is not usable.
    """
    given = to_shape(reference)
    cloud = sample_candidate(to_shape(candidate), given, settings.seed)
    measured = cloud if isinstance(given, Mesh) else given
    if min(len(measured), len(cloud)) < 2:
        raise InputError("expected clouds of at least two points, got one")
    index = Index(measured.points - measured.points.mean(axis=0))
    spacing = median_spacing(index, index.nearest_other())
    thresholds = (_THRESHOLD_SPACINGS * spacing,) if spacing > 0 else None
    return Pair(given, cloud, Settings(register=settings.register, thresholds=thresholds, seed=settings.seed))
