"""Run a bench: reconstruct, measure and write the results, one run after another; each is stored when it is done."""

from __future__ import annotations

import hashlib
import json
import os
import platform
import re
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from pcbench.errors import InputError, PcbenchError, RegistrationError, record_error
from pcbench.extras import import_problem
from pcbench.geometry.cameras import Camera
from pcbench.io.contents import digest
from pcbench.plugins.run import PLUGIN, Description, ReconstructionJob, absolute, describe, read_reconstruction, run
from pcbench.plugins.stages import library_versions
from pcbench.progress import Step
from pcbench.regular_files import is_regular_file
from pcbench.report.document import provenance
from pcbench.report.html import InputRow
from pcbench.report.markup import csv_text
from pcbench.report.plot import Drawn, draw_if_possible
from pcbench.scenes import Scene, read_scene
from pcbench.studies.bench.charts import CHARTS
from pcbench.studies.bench.page import article
from pcbench.studies.bench.pareto import with_front
from pcbench.studies.bench.plan import Axis, Method, Trial, labels, trials
from pcbench.studies.bench.results import (
    COLUMNS,
    KIND,
    MEASURED,
    Bench,
    BenchInput,
    BenchReference,
    BenchRow,
    RunRecord,
    Score,
)
from pcbench.studies.bench.score import EvaluationProtocol, Rules, score
from pcbench.studies.bench.truth import mesh_of, read_truth
from pcbench.studies.frame.cells import map_cells
from pcbench.studies.frame.folder import check_folder, study_folder
from pcbench.studies.frame.publish import StudyOutcome, publish
from pcbench.studies.frame.records import read_record, write_record
from pcbench.systems import cpu_count
from pcbench.tasks import Workers

_MEASURE_VERSION = 2  # increased when the measurement changes, so that stored scores are computed again
_EXPECTED_RUN_S = 60.0  # rough duration of a run, for progress bars
_RUNS_FOLDER, _RUN_FILE, _SCORE_FILE = "runs", "run.json", "score.json"


@dataclass(frozen=True)
class BenchJob:
    """A bench to run.

    Args:
        scene: folder of photographs.
        reference: cloud or mesh in the frame of the scene's cameras.
        methods: specifications for `pcbench.plugins.find_plugin`.
        axes: settings that vary or are set.
        seeds: number of runs for each method that has a setting `seed`.
        cameras: cameras for the methods, as for `read_scene`. With `none`, the cameras of the scene still register the
            clouds.
        masks: folder of masks, as for `read_scene`.
        mesh: mesh of the reference's surface, for accuracy and visibility. None: the scene's own mesh, if the reference
            is in the same folder `truth`.
        time_limit_s: time limit of a run, in seconds.
        rules: how each cloud is measured.
    """

    scene: Path
    reference: Path
    methods: Sequence[str]
    axes: Sequence[Axis] = ()
    seeds: int = 1
    cameras: str = "auto"
    masks: Path | None = None
    mesh: Path | None = None
    time_limit_s: float | None = None
    rules: Rules = field(default_factory=Rules)


@dataclass(frozen=True)
class FinishedRun:
    """A finished run.

    Args:
        row: its row of bench.json.
        number: its index, from 1.
        of: number of all runs.
        kept: whether an earlier bench made the run.
    """

    row: BenchRow
    number: int
    of: int
    kept: bool

    @property
    def summary(self) -> str:
        """Result of the run in one line."""
        run, score = self.row.run, self.row.score
        end = f"{run.status}: {run.message}" if score is None else f"F-score {score.fscore:.4g}"
        points = "" if run.points is None else f"{run.points:,} points, "
        kept = " (from an earlier bench)" if self.kept else ""
        return f"{self.row.title}: {run.wall_s:.1f} s, {points}{end}{kept}"


def bench(
    job: BenchJob,
    out: Path,
    *,
    workers: Workers | None = None,
    figures: bool = True,
    on_row: Callable[[FinishedRun], None] = lambda _: None,
    on_step: Callable[[str], None] = lambda _: None,
    on_warning: Callable[[str], None] = lambda _: None,
) -> StudyOutcome[Bench]:
    """Run each method with each combination of settings and measure its clouds. A failed run is recorded as a row.

    `bench.csv`, `bench.json`, `bench.md` and `report.html` are written after each run, and charts after the last. A
    stored run is used again if its inputs (images, cameras, method, settings, versions, machine) are unchanged. Its
    scores are used again if the reference and the rules are unchanged.

    Args:
        job: bench to run.
        out: output folder.
        workers: where the runs go on at the same time, each with one thread; None: one after another in this process.
        figures: whether to draw charts.
        on_row: called with each finished run.
        on_step: progress callback.
        on_warning: called with each warning, one line.

    Raises:
        InputError: the scene, the reference or an option is not usable, or `out` is not the folder of a bench.
        OSError: the folder cannot be written.
    """
    check_folder(out, KIND)
    on_step("reading the scene")
    scene = read_scene(job.scene, cameras=job.cameras, masks=job.masks, on_warning=on_warning)
    on_step("inspecting the methods")
    limit = min(120.0, job.time_limit_s or 120.0)
    specs = zip(labels(job.methods), job.methods, strict=True)
    methods = [Method(label, spec, describe(absolute(spec), limit)) for label, spec in specs]
    planned, notes = trials(methods, job.axes, job.seeds)
    on_step("reading the reference")
    if job.mesh is None:
        job = replace(job, mesh=mesh_of(job.scene, job.reference))
    truth = read_truth(job.reference, job.mesh, _true_cameras(job, scene, on_warning), on_warning)
    on_step("computing what the cameras saw")
    protocol = EvaluationProtocol.from_rules(truth, job.rules)
    if truth.visible is None:
        notes.append(f"recall_visible is missing: {truth.visibility}")
    inputs = _Inputs.from_job(job, scene, protocol)
    with study_folder(out, KIND, job):
        (out / _RUNS_FOLDER).mkdir(exist_ok=True)
        shared = _Shared(job, inputs, protocol, out, beside_others=workers is not None)
        cells = map_cells(
            _run_trial, shared, planned, out=out, workers=workers, step=on_step, cell_seconds=_EXPECTED_RUN_S
        )
        rows: list[BenchRow] = []
        for number, (row, kept) in enumerate(cells, 1):
            rows.append(row)
            study = _study(job, inputs, protocol, methods, notes, rows)
            _publish(out, study)  # to read while the bench runs
            on_row(FinishedRun(row, number, len(planned), kept))
        stale = {p.name for p in (out / _RUNS_FOLDER).iterdir()} - {_folder_name(trial) for trial in planned}
        if stale:
            text = f"{len(stale)} runs in {out / _RUNS_FOLDER} have other settings and are not in the tables"
            study = replace(study, notes=(*study.notes, text))
        on_step("drawing the charts" if figures else "writing the page")
        return _publish(out, study, partial(draw_if_possible, out, CHARTS) if figures else None)


def _true_cameras(job: BenchJob, scene: Scene, warn: Callable[[str], None]) -> Mapping[str, Camera]:
    """Return the cameras of the scene, also if they are withheld from the methods."""
    if job.cameras != "none":
        return scene.cameras
    try:
        return read_scene(job.scene, masks=job.masks, on_warning=lambda _: None).cameras
    except InputError as error:
        warn(f"no cameras to register clouds with: {error}")
        return {}


@dataclass(frozen=True)
class _Inputs:
    """Inputs that decide whether a stored reconstruction (`run`) or a stored score (`score`) is still valid."""

    run: Mapping[str, Any]
    score: Mapping[str, Any]

    @classmethod
    def from_job(cls, job: BenchJob, scene: Scene, protocol: EvaluationProtocol) -> _Inputs:
        truth = protocol.truth
        points = scene.points.points.tobytes() if scene.points is not None else b""
        true = b"".join(truth.cameras[name].cam_from_world.matrix.tobytes() for name in sorted(truth.cameras))
        run = {
            "scene": scene.fingerprint(),
            "sparse_points": hashlib.sha256(points).hexdigest(),
            "versions": library_versions(),
            "machine": f"{platform.node()} {platform.machine()}, {cpu_count()} cores",
        }
        measured = {
            "reference": digest(job.reference),
            "mesh": None if job.mesh is None else digest(job.mesh),
            "cameras": hashlib.sha256(true).hexdigest(),
            "rules": asdict(job.rules),
            "measures": _MEASURE_VERSION,
            "named_files": [digest(path) for path in protocol.files],
            "global": import_problem("kiss_matcher") is None,
        }
        return cls(run, measured)


@dataclass(frozen=True)
class _Shared:
    """Arguments that all runs of a bench share.

    Args:
        job: the bench.
        inputs: what decides whether stored results are still valid.
        protocol: how clouds are measured.
        out: folder of the bench.
        beside_others: whether several runs go on at the same time, each with one thread.
    """

    job: BenchJob
    inputs: _Inputs
    protocol: EvaluationProtocol
    out: Path
    beside_others: bool


def _run_trial(shared: _Shared, trial: Trial, step: Callable[[str], None]) -> tuple[BenchRow, bool]:
    """Return the row of a trial, and whether both its run and its score were stored."""
    step(Step(trial.title, _EXPECTED_RUN_S))
    folder = shared.out / _RUNS_FOLDER / _folder_name(trial)
    run_record, run_reused = _reconstruct(shared, trial, folder)
    name = str(folder.relative_to(shared.out))
    row = BenchRow(trial.method.label, dict(trial.choices), trial.seed, run_record, name)
    if run_record.status != MEASURED:
        return row, run_reused
    measured, score_reused = _measure(shared.inputs, shared.protocol, folder, run_record.id)
    row = replace(row, score=measured.score) if measured.score is not None else row.unmeasured(measured.problem)
    return row, run_reused and score_reused


def _reconstruct(shared: _Shared, trial: Trial, folder: Path) -> tuple[RunRecord, bool]:
    job = shared.job
    key = {
        **shared.inputs.run,
        "plugin": trial.method.spec,
        "plugin_sha256": trial.method.description.sha256,
        "origin": trial.method.description.origin,
        "image_scale": trial.image_scale,
        "settings": trial.settings,
        "named_files": {key: digest(Path(text)) for key, text in trial.settings.items() if is_regular_file(text)},
    }
    stored = read_record(folder / _RUN_FILE, key, RunRecord)
    if stored is not None and _is_still_valid(stored, job.time_limit_s, folder):
        return stored, True
    # Start from an empty folder: the time of a resumed run would be too short.
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    reconstruction_job = ReconstructionJob(
        trial.method.spec,
        job.scene,
        trial.settings,
        cameras=job.cameras,
        masks=job.masks,
        image_scale=trial.image_scale,
    )
    result = run(reconstruction_job, folder, job.time_limit_s)
    reconstruction = result.reconstruction
    record = RunRecord(
        id=os.urandom(8).hex(),
        status=result.status,
        message=result.message,
        wall_s=result.wall_s,
        cpu_s=result.cpu_s,
        peak_rss_bytes=result.peak_rss_bytes,
        gpu_bytes=result.gpu_bytes,
        beside_others=shared.beside_others,
        time_limit_s=job.time_limit_s,
        settings=dict(result.settings),
        points=None if reconstruction is None else len(reconstruction.cloud),
        gauge=None if reconstruction is None else reconstruction.gauge,
        cameras=None if reconstruction is None else len(reconstruction.cameras),
        survey=reconstruction.residuals.plain() if reconstruction is not None and reconstruction.residuals else None,
        reconstruction_notes=(*result.warnings, *(() if reconstruction is None else reconstruction.notes)),
    )
    folder.mkdir(parents=True, exist_ok=True)  # a plugin may have removed it
    if reconstruction is not None:
        shutil.rmtree(folder / PLUGIN, ignore_errors=True)  # gigabytes of intermediate files
    write_record(folder / _RUN_FILE, key, record)
    return record, False


def _is_still_valid(record: RunRecord, limit: float | None, folder: Path) -> bool:
    """Return whether a new run with the same inputs would end as the stored one did."""
    # A missing library may be installed by now. A full disk or low memory may have caused a crash.
    if record.status in ("refused", "crashed"):
        return False
    if record.status == "timeout":
        return limit is not None and record.time_limit_s is not None and limit <= record.time_limit_s
    if limit is not None and limit != record.time_limit_s and record.wall_s > limit:
        return False
    if record.status != MEASURED:
        return True
    try:
        read_reconstruction(folder)
    except (PcbenchError, OSError, ValueError):  # its files were removed
        return False
    return True


@dataclass(frozen=True)
class _Measured:
    """The score of a cloud, or why it cannot be measured."""

    score: Score | None
    problem: str = ""


def _measure(inputs: _Inputs, protocol: EvaluationProtocol, folder: Path, identity: str) -> tuple[_Measured, bool]:
    key = {"run": identity, **inputs.score}
    stored = read_record(folder / _SCORE_FILE, key, _Measured)
    if stored is not None:
        return stored, True
    try:
        reconstruction = read_reconstruction(folder)
    except (PcbenchError, OSError, ValueError, MemoryError) as error:  # not stored: the next run tries again
        return _temporary(error), False
    try:
        measured = _Measured(score(protocol, reconstruction, folder))
    except (InputError, RegistrationError) as error:
        measured = _Measured(None, record_error(error))
    except (PcbenchError, MemoryError) as error:  # may be temporary: not stored, the next run measures the cloud again
        return _temporary(error), False
    except (ValueError, ArithmeticError, np.linalg.LinAlgError) as error:  # degenerate clouds fail in many ways
        measured = _Measured(None, f"{type(error).__name__}: {' '.join(record_error(error).split())}")
    write_record(folder / _SCORE_FILE, key, measured)
    return measured, False


def _temporary(error: BaseException) -> _Measured:
    return _Measured(None, " ".join(record_error(error).split()) or "not enough memory")


def _folder_name(trial: Trial) -> str:
    """Return a readable folder name, unique for each trial."""
    identity = json.dumps([trial.method.spec, dict(trial.choices), trial.seed])
    words = re.sub(r"[^\w.=+-]+", "_", trial.title)[:80].strip("_.")
    return f"{words}_{hashlib.sha256(identity.encode()).hexdigest()[:6]}"


def _study(
    job: BenchJob,
    inputs: _Inputs,
    protocol: EvaluationProtocol,
    methods: Sequence[Method],
    notes: Sequence[str],
    rows: Sequence[BenchRow],
) -> Bench:
    truth, visible = protocol.truth, protocol.visible_points
    return Bench(
        scene=BenchInput(str(job.scene), inputs.run["scene"]),
        reference=BenchReference(
            path=str(job.reference),
            sha256=inputs.score["reference"],
            points=len(truth.cloud),
            unit=truth.cloud.unit,
            mesh=None if job.mesh is None else BenchInput(str(job.mesh), inputs.score["mesh"]),
            visible_share=None if truth.visible is None else float(truth.visible.mean()),
            visibility=truth.visibility,
            pixel=truth.pixel,
            seen_points=None if visible is None else len(visible),
            seen_spacing=protocol.visible_spacing,
        ),
        methods=tuple({"method": m.label, "spec": m.spec, **_description_values(m.description)} for m in methods),
        settings={
            "axes": [asdict(axis) for axis in job.axes],
            "seeds": job.seeds,
            "cameras": job.cameras,
            "masks": None if job.masks is None else str(job.masks),
            "time_limit_s": job.time_limit_s,
            **asdict(job.rules),
        },
        provenance={**provenance(None), "versions": inputs.run["versions"]},
        notes=tuple(notes),
        rows=with_front(rows),
    )


def _description_values(description: Description) -> dict[str, Any]:
    return {name: getattr(description, name) for name in ("settings", "origin", "sha256", "problem")}


def _publish(out: Path, study: Bench, draw: Callable[[], Drawn] | None = None) -> StudyOutcome[Bench]:
    """Write all files of the bench."""
    table = csv_text(COLUMNS, ([row.value(column) for column in COLUMNS] for row in study.rows))
    files = {"scene": study.scene, "reference": study.reference, "true surface": study.reference.mesh}
    inputs = [InputRow(role, file.path, file.sha256) for role, file in files.items() if file is not None]
    return publish(out, KIND, study, {"bench.csv": table}, draw, partial(article, study), study.provenance, inputs)
