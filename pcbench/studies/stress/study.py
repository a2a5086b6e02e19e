"""`pcbench stress`: find out where registration, metrics and verdicts break, and whether they say so.

Each ladder of perturbations is climbed from nothing to certain failure, on pairs with a known truth, by our methods and
by those of other libraries. Wrong with confidence and withheld although right are counted apart.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np

from pcbench.errors import InputError, did_you_mean
from pcbench.geometry.cloud import Cloud
from pcbench.io.contents import digest
from pcbench.report.document import provenance
from pcbench.report.plot import Drawn
from pcbench.studies.frame.folder import check_folder, study_folder
from pcbench.studies.frame.publish import StudyOutcome, draw_here, publish
from pcbench.studies.stress.cells import RunPlan, load_pair, plan_runs, save_pair
from pcbench.studies.stress.charts import draw_charts
from pcbench.studies.stress.descriptions import MethodInfo, MissingMethod, SceneInfo
from pcbench.studies.stress.ladders import Ladder, selected
from pcbench.studies.stress.page import article
from pcbench.studies.stress.results import DOCUMENT, KIND, RENDERED, StressSettings, StressStudy
from pcbench.studies.stress.runs import RunSettings, run_all
from pcbench.studies.stress.scenes import (
    GIVEN,
    POINTS,
    QUICK_POINTS,
    SCENES,
    WOODED,
    StressPair,
    given_pair,
    scene_pair,
)
from pcbench.studies.stress.subject import RunResult
from pcbench.studies.stress.subjects import PAIR_SUBJECTS
from pcbench.studies.stress.table import stress_csv, stress_table
from pcbench.studies.stress.words import answer, warnings
from pcbench.studies.stress.worst import save_worst
from pcbench.tasks import Workers

CSV, TABLE = "stress.csv", "stress.txt"
_GIVEN_FILE = "given.npz"
# What a study perturbs.
SYNTHETIC_SCENES, GIVEN_PAIR, PHOTOGRAPHS = "the built-in scenes", "a pair of clouds", "photographs"


@dataclass(frozen=True, eq=False)
class GivenClouds:
    """A pair of clouds to stress instead of the built-in scenes."""

    reference: Cloud
    candidate: Cloud


@dataclass(frozen=True)
class StressPlan:
    """Plan of a study: ladders and methods.

    Attributes:
        ladders: ladders.
        methods: names of the methods by the name of their subject.
        missing: methods that are left out, with the reason.
        points: number of points of the reference of a built-in scene.
    """

    ladders: tuple[Ladder, ...]
    methods: Mapping[str, tuple[str, ...]]
    missing: tuple[MissingMethod, ...]
    points: int

    @classmethod
    def of(cls, settings: StressSettings) -> StressPlan:
        """Return the plan of settings, without methods that are not installed.

        Raises:
            InputError: there is no such ladder or method, or none of the named methods is installed.
        """
        ladders = selected(settings.only, quick=settings.quick)
        available = [name for subject in PAIR_SUBJECTS.values() for name in subject.methods]
        if unknown := [name for name in settings.methods if name not in available]:
            hint = did_you_mean(unknown[0], available)
            raise InputError(f"unknown method {unknown[0]!r}: expected one of {', '.join(available)}{hint}")
        missing: list[MissingMethod] = []
        methods: dict[str, tuple[str, ...]] = {}
        for subject in PAIR_SUBJECTS.values():
            reasons = {m.name: m.missing() for m in subject.chosen(settings.methods, quick=settings.quick)}
            missing += [reason for reason in reasons.values() if reason is not None]
            methods[subject.name] = tuple(name for name, reason in reasons.items() if reason is None)
        if not any(methods.values()):
            raise InputError(missing[0].reason)
        return cls(ladders, methods, tuple(missing), QUICK_POINTS if settings.quick else POINTS)

    def infos(self) -> tuple[MethodInfo, ...]:
        """Return the descriptions of the methods."""
        return tuple(
            subject.methods[name].info(subject.name)
            for subject in PAIR_SUBJECTS.values()
            for name in self.methods[subject.name]
        )


def run_stress(
    out: Path,
    settings: StressSettings,
    clouds: GivenClouds | None = None,
    *,
    plan: StressPlan | None = None,
    figures: bool = True,
    step: Callable[[str], None] = lambda _: None,
) -> StudyOutcome[StressStudy]:
    """Run the study and write report.html, stress.json, stress.csv, stress.txt, stress.md and charts to a folder.

    The records of all runs stay in its folder `runs`; a later run with the same settings resumes from
    them.

    Args:
        out: output folder.
        settings: settings of the study.
        clouds: pair of clouds to stress; None for the built-in scenes.
        plan: plan of the study; by default that of the settings.
        figures: whether to draw charts.
        step: progress callback.

    Raises:
        InputError: a setting is not usable, the given pair has no pose without doubt, or `out` holds something else,
            or another run is writing there.
        OSError: a file cannot be written.
    """
    check_study(out, SYNTHETIC_SCENES if clouds is None else GIVEN_PAIR)
    plan = StressPlan.of(settings) if plan is None else plan
    pair = None
    if clouds is not None:
        step("registering the given pair")
        pair = given_pair(clouds.reference, clouds.candidate, settings.register)
    runs = list(
        plan_runs(
            plan.ladders,
            plan.methods,
            quick=settings.quick,
            seeds=range(settings.seed, settings.seed + settings.seeds),
            points=plan.points,
            given=pair,
        )
    )
    if not runs:
        raise InputError(
            "expected ladders and methods that apply to this pair: metrics and verdicts need the built-in scenes,"
            " start-map needs a method with a start, such as icp, and missing-vegetation needs a reference with enough"
            " points of the classes 3, 4 and 5"
            if pair is not None
            else "expected methods for these ladders, got none: see --methods"
        )
    with study_folder(out, KIND, settings):
        run_settings = _run_settings(out, settings, pair)
        results = run_all(runs, run_settings, step, settings.chosen_workers or Workers())
        step("writing the results")
        study = _study(settings, plan, pair, runs, results, None if clouds is None else clouds.reference.unit)
        study = replace(study, worst=save_worst(out, study, runs, results, pair))
        return write_study(out, study, figures=figures, step=step)


def check_study(out: Path, subject: str) -> None:
    """Check that a study may write to a folder, and that studies of something else do not lose their results there.

    Args:
        out: output folder.
        subject: what the study perturbs: `SYNTHETIC_SCENES`, `GIVEN_PAIR` or `PHOTOGRAPHS`.

    Raises:
        InputError: `out` is a file, or holds something other than a study of this subject.
    """
    check_folder(out, KIND)
    held = None
    if (out / _GIVEN_FILE).exists():
        held = GIVEN_PAIR
    elif (out / RENDERED).exists():
        held = PHOTOGRAPHS
    elif (out / DOCUMENT).exists():
        held = SYNTHETIC_SCENES
    if held not in (None, subject):
        raise InputError(f"{out}: expected a folder for a study of {subject}, got one of {held}: choose another folder")


def write_study(
    out: Path, study: StressStudy, *, figures: bool = True, step: Callable[[str], None] = lambda _: None
) -> StudyOutcome[StressStudy]:
    """Write all files of a study to its folder.

    Args:
        out: folder of the study.
        study: the study; its sentences are computed here.
        figures: whether to draw charts.
        step: progress callback.

    Raises:
        OSError: a file cannot be written.
    """
    study = replace(study, sentences=(*answer(study), *warnings(study)))

    def draw() -> Drawn:
        step("drawing charts")
        return draw_here(lambda: draw_charts(study, out))

    texts = {CSV: stress_csv(study), TABLE: f"{stress_table(study)}\n"}
    return publish(out, KIND, study, texts, draw if figures else None, partial(article, study), study.provenance)


def _run_settings(out: Path, settings: StressSettings, pair: StressPair | None) -> RunSettings:
    if pair is None:
        return RunSettings(out, settings.time_limit_s)
    file = out / _GIVEN_FILE
    if file.is_file() and not _is_same(pair, file):
        raise InputError(f"{out}: the folder holds a study of another pair, or of another pose: choose another folder")
    save_pair(file, pair)
    return RunSettings(out, settings.time_limit_s, file, digest(file))


def _is_same(pair: StressPair, file: Path) -> bool:
    """Return whether a file holds the same clouds within a point spacing of the same pose, or is damaged."""
    try:
        held = load_pair(file)
    except (OSError, KeyError, ValueError, BadZipFile):
        return True
    is_same_reference = np.array_equal(held.reference, pair.reference)
    is_same_shape = held.points.shape == pair.points.shape
    return is_same_reference and is_same_shape and np.allclose(held.points, pair.points, rtol=0, atol=pair.spacing)


def _study(
    settings: StressSettings,
    plan: StressPlan,
    pair: StressPair | None,
    runs: Sequence[RunPlan],
    results: Sequence[RunResult],
    unit: str | None,
) -> StressStudy:
    used = {run.ladder for run in runs}
    cells: dict[str, Any] = {
        subject.key: tuple(
            subject.settle(
                [c for run, result in zip(runs, results, strict=True) if run.subject == name for c in result.cells]
            )
        )
        for name, subject in PAIR_SUBJECTS.items()
    }
    return StressStudy(
        settings=settings,
        scenes=tuple(_scene_infos(runs, pair, unit)),
        ladders=tuple(ladder.info(quick=settings.quick) for ladder in plan.ladders if ladder.name in used),
        methods=plan.infos(),
        missing=plan.missing,
        provenance=provenance(settings.seed),
        **cells,
    )


def _scene_infos(runs: Iterable[RunPlan], pair: StressPair | None, unit: str | None) -> list[SceneInfo]:
    """Return the scenes of the runs; degenerate surfaces are not listed."""
    first: dict[str, RunPlan] = {}
    for run in runs:
        first.setdefault(run.scene, run)
    infos = []
    for name, run in first.items():
        if name == GIVEN and pair is not None:
            infos.append(pair.info(name, unit or ""))
        elif name in (*SCENES, WOODED):
            infos.append(scene_pair(name, run.seed, run.points).info(name))
    return infos
