"""Run reconstructors on perturbed photographs, and measure their clouds.

Each reconstruction is a child process with a time limit, as in `pcbench bench`. Without workers only one runs at a
time, because it may use all CPUs. Each run has a record, so that a study that was killed goes on after its last
complete run.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from pcbench.deformation.parts import round_to_six_digits
from pcbench.errors import InputError, RegistrationError, record_error
from pcbench.plugins import Reconstruction
from pcbench.plugins.run import Description, ReconstructionJob, absolute, run
from pcbench.plugins.stages import library_versions
from pcbench.progress import Step
from pcbench.scenes.synthetic.files import SceneSettings
from pcbench.studies.bench.score import EvaluationProtocol, score
from pcbench.studies.frame.cells import map_cells
from pcbench.studies.frame.records import read_record, write_record
from pcbench.studies.stress.cells import RECORDS, RunPlan
from pcbench.studies.stress.descriptions import PhotographInfo
from pcbench.studies.stress.reconstructors.ladders import PHOTO_LADDERS, PhotoLadder
from pcbench.studies.stress.reconstructors.reconstruction import (
    RECONSTRUCTION,
    UNPERTURBED,
    ReconstructionCell,
    settle,
)
from pcbench.studies.stress.reconstructors.scenes import (
    base_settings,
    perturbed_photographs,
    photograph_info,
    protocol_of,
    read_scene_truth,
    rendered_scene,
    write_photographs,
)
from pcbench.studies.stress.results import RENDERED
from pcbench.studies.stress.runs import WORK
from pcbench.studies.stress.subject import CRASH, REFUSED, RIGHT, TIME_OUT
from pcbench.tasks import Workers

SCENE = "photographs"
_RUN_S = 10.0  # rough duration of a run, for progress bars
# Outcome of a run without a cloud, by the status of the reconstruction.
_FAILED = {"failed": REFUSED, "refused": REFUSED, "crashed": CRASH, "garbage": CRASH, "timeout": TIME_OUT}


@dataclass(frozen=True)
class ReconstructorMethod:
    """A reconstructor of the study.

    Attributes:
        name: name in cells, tables and charts.
        spec: specification for `pcbench.plugins.find_plugin`.
        settings: settings as text, without the seed.
        description: what the reconstructor reports about itself.
    """

    name: str
    spec: str
    settings: Mapping[str, str]
    description: Description

    def settings_of(self, seed: int) -> dict[str, str]:
        """Return the settings of a run."""
        return {**self.settings, **({"seed": str(seed)} if "seed" in self.description.settings else {})}


@dataclass(frozen=True)
class PhotoRuns:
    """Settings that all runs of a study share.

    Attributes:
        out: folder of the study.
        time_limit_s: time limit of a reconstruction, in seconds.
        quick: whether scenes are those of the quick plan.
    """

    out: Path
    time_limit_s: float
    quick: bool

    def key(self, plan: RunPlan, method: ReconstructorMethod) -> dict[str, Any]:
        """Return all inputs that a run's result depends on."""
        return {
            "plan": asdict(plan),
            "scene": asdict(self.scene(plan)),
            "plugin": method.spec,
            "plugin_sha256": method.description.sha256,
            "settings": method.settings_of(plan.seed),
            "versions": library_versions(),
            "time_limit_s": self.time_limit_s,
        }

    def scene(self, plan: RunPlan) -> SceneSettings:
        """Return the settings of the scene of a run."""
        base = base_settings(plan.seed, quick=self.quick)
        ladder = PHOTO_LADDERS.get(plan.ladder)
        return base if ladder is None else ladder.scene(base, plan.level)

    def rendered(self, settings: SceneSettings) -> Path:
        """Return the folder of a scene, rendered if it is missing."""
        folder = self.out / RENDERED
        folder.mkdir(exist_ok=True)
        return rendered_scene(folder, settings)

    def info(self, seed: int) -> PhotographInfo:
        """Return the description of the unperturbed scene of a seed."""
        return _scene_info(self, seed)


def plan_photo_runs(
    ladders: Sequence[PhotoLadder], methods: Iterable[str], *, quick: bool, seeds: range
) -> list[RunPlan]:
    """Return all runs of a study: first the unperturbed ones, then level by level, so that methods share photographs.

    Args:
        ladders: ladders to run.
        methods: names of the methods.
        quick: whether to run the levels of the quick plan.
        seeds: seeds of the runs.
    """
    names = list(methods)
    places = [(UNPERTURBED, 0.0)]
    places += [(ladder.name, level) for ladder in ladders for level in ladder.info(quick=quick).levels]
    return [
        RunPlan(RECONSTRUCTION.name, SCENE, ladder, level, None, name, seed, base_settings(seed, quick=quick).points)
        for seed in seeds
        for ladder, level in places
        for name in names
    ]


def run_photo_plans(
    plans: Sequence[RunPlan],
    methods: Mapping[str, ReconstructorMethod],
    settings: PhotoRuns,
    step: Callable[[str], None] = lambda _: None,
    workers: Workers | None = None,
) -> list[ReconstructionCell]:
    """Run all plans that have no record yet, and return the cells of all, in their order.

    Args:
        plans: runs of the study.
        methods: methods by name.
        settings: settings that all runs share.
        step: progress callback.
        workers: where runs go on at the same time, each with one thread; None: one after another in this process.

    Raises:
        MissingExtra, NoFiguresError: images cannot be rendered on this machine.
        OSError: a record cannot be written.
    """
    (settings.out / RECORDS).mkdir(exist_ok=True)
    shutil.rmtree(settings.out / WORK, ignore_errors=True)
    keys = {plan: settings.key(plan, methods[plan.method]) for plan in plans}
    cells = {plan: read_record(plan.record(settings.out), keys[plan], ReconstructionCell) for plan in plans}
    missing = [(plan, methods[plan.method], keys[plan]) for plan in plans if cells[plan] is None]
    if workers is not None:  # each scene is rendered once, before several runs need it
        for seed in {plan.seed for plan, _, _ in missing}:
            settings.info(seed)
        for plan, _, _ in missing:
            settings.rendered(settings.scene(plan))
    made = map_cells(_run_plan, settings, missing, out=settings.out, workers=workers, step=step, cell_seconds=_RUN_S)
    for (plan, _, _), cell in zip(missing, made, strict=True):
        cells[plan] = cell
    shutil.rmtree(settings.out / WORK, ignore_errors=True)
    return settle([cell for cell in cells.values() if cell is not None])


def _run_plan(
    settings: PhotoRuns, run_of: tuple[RunPlan, ReconstructorMethod, dict[str, Any]], step: Callable[[str], None]
) -> ReconstructionCell:
    """Reconstruct and measure, and write the record; the outcome of a cloud is `right` until `settle` decides."""
    plan, method, key = run_of
    ladder = PHOTO_LADDERS.get(plan.ladder)
    level = "" if ladder is None else f" {ladder.info(quick=False).level_text(plan.level)}"
    step(Step(f"{plan.method}, {plan.ladder}{level}", _RUN_S))
    work = settings.out / WORK / plan.stem
    try:
        cell = _reconstruct(plan, method, settings, work)
    finally:
        shutil.rmtree(work, ignore_errors=True)
    write_record(plan.record(settings.out), key, cell)
    return cell


def _reconstruct(plan: RunPlan, method: ReconstructorMethod, settings: PhotoRuns, work: Path) -> ReconstructionCell:
    scene = settings.rendered(settings.scene(plan))
    photographs, workspace = work / "photographs", work / "workspace"
    photographs.mkdir(parents=True)
    perturbed = perturbed_photographs(scene, plan.ladder, plan.level, plan.seed)
    write_photographs(photographs, perturbed)
    job = ReconstructionJob(absolute(method.spec), photographs, method.settings_of(plan.seed))
    result = run(job, workspace, settings.time_limit_s)
    cell = ReconstructionCell(
        plan.scene, plan.ladder, plan.level, None, plan.method, plan.seed, _FAILED.get(result.status, RIGHT),
        message=result.message, cpu_s=result.cpu_s, memory_bytes=result.peak_rss_bytes, wall_s=result.wall_s,
        images=len(perturbed.cameras),
    )  # fmt: skip
    if result.reconstruction is not None:
        cell = _measured(cell, result.reconstruction, _protocol(settings, scene, plan.seed), workspace)
        cell = replace(cell, notes=(*result.warnings, *cell.notes))
    rounded: ReconstructionCell = round_to_six_digits(cell)
    return rounded


def _measured(
    cell: ReconstructionCell, result: Reconstruction, protocol: EvaluationProtocol, workspace: Path
) -> ReconstructionCell:
    cell = replace(cell, points=len(result.cloud), cameras=len(result.cameras), notes=tuple(result.notes))
    try:
        values = score(protocol, result, workspace)
    except (InputError, RegistrationError) as error:
        return replace(cell, message=f"the cloud cannot be measured: {record_error(error)}")
    except (ValueError, ArithmeticError, np.linalg.LinAlgError) as error:  # degenerate clouds fail in many ways
        return replace(cell, message=f"the cloud cannot be measured: {type(error).__name__}: {record_error(error)}")
    return replace(
        cell,
        fscore=values.fscore if values.fscore_visible is None else values.fscore_visible,
        precision=values.precision,
        recall=values.recall if values.recall_visible is None else values.recall_visible,
        threshold=values.threshold,
        rms=float(np.sqrt(values.d1_c2r)),
        registration=values.registration,
    )


@lru_cache(maxsize=2)
def _scene_info(settings: PhotoRuns, seed: int) -> PhotographInfo:
    base = base_settings(seed, quick=settings.quick)
    return photograph_info(base, read_scene_truth(settings.rendered(base)))


@lru_cache(maxsize=1)
def _protocol(settings: PhotoRuns, scene: Path, seed: int) -> EvaluationProtocol:
    """Return how clouds of a scene are measured; all scenes of a seed have the threshold of the unperturbed one."""
    info = settings.info(seed)
    return protocol_of(read_scene_truth(scene), info.extent, info.threshold)
