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
from pathlib import Path
from typing import Any

import numpy as np

from pcbench.errors import InputError, PcbenchError, RegistrationError, record_error
from pcbench.extras import import_problem
from pcbench.geometry.cameras import Camera
from pcbench.io.contents import digest
from pcbench.io.json_values import to_json
from pcbench.plugins.run import PLUGIN, Description, ReconstructionJob, absolute, describe, read_reconstruction, run
from pcbench.plugins.stages import library_versions
from pcbench.progress import Step
from pcbench.regular_files import is_regular_file
from pcbench.report.document import provenance
from pcbench.report.markup import csv_text
from pcbench.report.plot import Drawn, draw_if_possible
from pcbench.scenes import Scene, read_scene
from pcbench.studies.bench.charts import CHARTS
from pcbench.studies.bench.page import article
from pcbench.studies.bench.pareto import choice_text, mark_front
from pcbench.studies.bench.plan import Axis, Method, Trial, labels, trials
from pcbench.studies.bench.score import EvaluationProtocol, Rules, score
from pcbench.studies.bench.table import row_title
from pcbench.studies.bench.truth import mesh_of, read_truth
from pcbench.studies.frame.cells import map_cells
from pcbench.studies.frame.folder import StudyKind, check_folder, study_folder
from pcbench.studies.frame.publish import write_report, write_results
from pcbench.studies.frame.records import read_record, write_record
from pcbench.systems import cpu_count
from pcbench.tasks import Workers

SCHEMA = "pcbench.bench/1"
KIND = StudyKind("bench", "bench.json", SCHEMA, dict, "bench.md")
COLUMNS = (
    "method",
    "settings",
    "seed",
    "status",
    "wall_s",
    "cpu_s",
    "peak_rss_bytes",
    "gpu_bytes",
    "points",
    "registration",
    "accuracy_to",
    "mean_c2r",
    "mean_c2r_floor",
    "mean_r2c",
    "mean_r2c_floor",
    "d1_c2r",
    "d1_r2c",
    "chamfer",
    "hausdorff",
    "threshold",
    "pixels",
    "precision",
    "precision_floor",
    "recall",
    "recall_floor",
    "fscore",
    "recall_visible",
    "recall_visible_floor",
    "fscore_visible",
    "pareto",
    "beside_others",
    "message",
)
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

    row: Mapping[str, Any]
    number: int
    of: int
    kept: bool

    @property
    def summary(self) -> str:
        """Result of the run in one line."""
        row = self.row
        end = f"F-score {row['fscore']:.4g}" if row["status"] == "ok" else f"{row['status']}: {row['message']}"
        points = "" if row["points"] is None else f"{row['points']:,} points, "
        kept = " (from an earlier bench)" if self.kept else ""
        return f"{row_title(row)}: {row['wall_s']:.1f} s, {points}{end}{kept}"


@dataclass(frozen=True, eq=False)
class BenchOutcome:
    """The document of bench.json, and why requested charts or the page are missing, or None."""

    document: dict[str, Any]
    without_figures: str | None = None
    without_page: str | None = None


def bench(
    job: BenchJob,
    out: Path,
    *,
    workers: Workers | None = None,
    figures: bool = True,
    on_row: Callable[[FinishedRun], None] = lambda _: None,
    on_step: Callable[[str], None] = lambda _: None,
    on_warning: Callable[[str], None] = lambda _: None,
) -> BenchOutcome:
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
    todo, notes = trials(methods, job.axes, job.seeds)
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
        rows: list[dict[str, Any]] = []
        shared = _Shared(job, inputs, protocol, out, beside_others=workers is not None)
        cells = map_cells(
            _run_trial, shared, todo, out=out, workers=workers, step=on_step, cell_seconds=_EXPECTED_RUN_S
        )
        for number, (row, kept) in enumerate(cells, 1):
            rows.append(row)
            mark_front(rows)
            doc = _document(job, inputs, protocol, methods, rows, notes)
            _write(out, doc)
            on_row(FinishedRun(row, number, len(todo), kept))
        stale = {p.name for p in (out / _RUNS_FOLDER).iterdir()} - {_folder_name(trial) for trial in todo}
        if stale:
            notes.append(f"{len(stale)} runs in {out / _RUNS_FOLDER} have other settings and are not in the tables")
            doc = _document(job, inputs, protocol, methods, rows, notes)
            _write(out, doc)
        on_step("drawing the charts" if figures else "writing the page")
        drawn = draw_if_possible(out, CHARTS) if figures else Drawn([])
        without_page = _write_report(out, doc, drawn.relative_to(out))
    return BenchOutcome(doc, drawn.problem, without_page)


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
            "named_files": [digest(path) for path in _named_files(job.rules)],
            "global": import_problem("kiss_matcher") is None,
        }
        return cls(run, measured)


def _named_files(rules: Rules) -> list[Path]:
    """Return the files with matrices, point pairs and polygons that the rules name."""
    paths = [Path(text.partition(":")[2]) for text in (rules.register, rules.crop)]
    return [path for path in paths if is_regular_file(path)]


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


def _run_trial(shared: _Shared, trial: Trial, step: Callable[[str], None]) -> tuple[dict[str, Any], bool]:
    """Return the row of a trial, and whether both its run and its score were stored."""
    step(Step(trial.title, _EXPECTED_RUN_S))
    folder = shared.out / _RUNS_FOLDER / _folder_name(trial)
    record, run_reused = _reconstruct(shared, trial, folder)
    row = {
        "method": trial.method.label,
        "choices": dict(trial.choices),
        "seed": trial.seed,
        **record,
        "folder": str(folder.relative_to(shared.out)),
    }
    if record["status"] != "ok":
        return row, run_reused
    measured, score_reused = _measure(shared.inputs, shared.protocol, folder, record["id"])
    return {**row, **measured}, run_reused and score_reused


def _reconstruct(shared: _Shared, trial: Trial, folder: Path) -> tuple[dict[str, Any], bool]:
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
    stored = read_record(folder / _RUN_FILE, key, dict[str, Any])
    if stored is not None and _is_still_valid(stored, job.time_limit_s, folder):
        return {"beside_others": False, **stored}, True
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
    record = {
        "id": os.urandom(8).hex(),
        "status": result.status,
        "message": result.message,
        "wall_s": result.wall_s,
        "cpu_s": result.cpu_s,
        "peak_rss_bytes": result.peak_rss_bytes,
        "gpu_bytes": result.gpu_bytes,
        "beside_others": shared.beside_others,
        "time_limit_s": job.time_limit_s,
        "settings": dict(result.settings),
        "points": None if reconstruction is None else len(reconstruction.cloud),
        "gauge": None if reconstruction is None else reconstruction.gauge,
        "cameras": None if reconstruction is None else len(reconstruction.cameras),
        "survey": reconstruction.residuals.plain() if reconstruction is not None and reconstruction.residuals else None,
        "reconstruction_notes": [*result.warnings, *(() if reconstruction is None else reconstruction.notes)],
    }
    folder.mkdir(parents=True, exist_ok=True)  # a plugin may have removed it
    if reconstruction is not None:
        shutil.rmtree(folder / PLUGIN, ignore_errors=True)  # gigabytes of intermediate files
    write_record(folder / _RUN_FILE, key, record)
    return record, False


def _is_still_valid(record: Mapping[str, Any], limit: float | None, folder: Path) -> bool:
    """Return whether a new run with the same inputs would end as the stored one did."""
    # A missing library may be installed by now. A full disk or low memory may have caused a crash.
    if record["status"] in ("refused", "crashed"):
        return False
    if record["status"] == "timeout":
        return limit is not None and limit <= record["time_limit_s"]
    if limit is not None and limit != record["time_limit_s"] and record["wall_s"] > limit:
        return False
    if record["status"] != "ok":
        return True
    try:
        read_reconstruction(folder)
    except (PcbenchError, OSError, ValueError):  # its files were removed
        return False
    return True


def _measure(inputs: _Inputs, protocol: EvaluationProtocol, folder: Path, identity: str) -> tuple[dict[str, Any], bool]:
    key = {"run": identity, **inputs.score}
    stored = read_record(folder / _SCORE_FILE, key, dict[str, Any])
    if stored is not None:
        return stored, True
    try:
        reconstruction = read_reconstruction(folder)
    except (PcbenchError, OSError, ValueError, MemoryError) as error:  # not stored: the next run tries again
        return {"status": "unmeasured", "message": " ".join(record_error(error).split()) or "not enough memory"}, False
    try:
        values = score(protocol, reconstruction, folder).row()
    except (InputError, RegistrationError) as error:
        values = {"status": "unmeasured", "message": record_error(error)}
    except (ValueError, ArithmeticError, np.linalg.LinAlgError) as error:  # degenerate clouds fail in many ways
        values = {"status": "unmeasured", "message": f"{type(error).__name__}: {' '.join(record_error(error).split())}"}
    except (PcbenchError, MemoryError) as error:  # may be temporary: not stored, the next run measures the cloud again
        return {"status": "unmeasured", "message": " ".join(record_error(error).split()) or "not enough memory"}, False
    write_record(folder / _SCORE_FILE, key, values)
    return values, False


def _folder_name(trial: Trial) -> str:
    """Return a readable folder name, unique for each trial."""
    identity = json.dumps([trial.method.spec, dict(trial.choices), trial.seed])
    words = re.sub(r"[^\w.=+-]+", "_", trial.title)[:80].strip("_.")
    return f"{words}_{hashlib.sha256(identity.encode()).hexdigest()[:6]}"


def _document(
    job: BenchJob,
    inputs: _Inputs,
    protocol: EvaluationProtocol,
    methods: Sequence[Method],
    rows: Sequence[Mapping[str, Any]],
    notes: Sequence[str],
) -> dict[str, Any]:
    truth = protocol.truth
    return {
        "schema": SCHEMA,
        "scene": {"path": str(job.scene), "sha256": inputs.run["scene"]},
        "reference": {
            "path": str(job.reference),
            "sha256": inputs.score["reference"],
            "points": len(truth.cloud),
            "unit": truth.cloud.unit,
            "mesh": None if job.mesh is None else {"path": str(job.mesh), "sha256": inputs.score["mesh"]},
            "visible_share": None if truth.visible is None else float(truth.visible.mean()),
            "visibility": truth.visibility,
            "pixel": truth.pixel,
            "seen_points": None if protocol.visible_points is None else len(protocol.visible_points),
            "seen_spacing": protocol.visible_spacing,
        },
        "methods": [{"method": m.label, "spec": m.spec, **_description_values(m.description)} for m in methods],
        "settings": {
            "axes": [asdict(axis) for axis in job.axes],
            "seeds": job.seeds,
            "cameras": job.cameras,
            "masks": None if job.masks is None else str(job.masks),
            "time_limit_s": job.time_limit_s,
            **asdict(job.rules),
        },
        "provenance": {**provenance(None), "versions": inputs.run["versions"]},
        "notes": list(notes),
        "rows": list(rows),
    }


def _description_values(description: Description) -> dict[str, Any]:
    return {name: getattr(description, name) for name in ("settings", "origin", "sha256", "problem")}


def _write(out: Path, doc: dict[str, Any]) -> None:
    rows = [{**row, "settings": choice_text(row["choices"])} for row in doc["rows"]]
    texts = {
        "bench.csv": csv_text(COLUMNS, ([row.get(column) for column in COLUMNS] for row in rows)),
        "bench.json": to_json(doc),
    }
    write_results(out, KIND, texts)
    _write_report(out, doc)  # to read while the bench runs


def _write_report(out: Path, doc: dict[str, Any], figures: Sequence[str] = ()) -> str | None:
    inputs = [(role, doc[role]["path"], doc[role]["sha256"]) for role in ("scene", "reference")]
    if (mesh := doc["reference"]["mesh"]) is not None:
        inputs.append(("true surface", mesh["path"], mesh["sha256"]))
    return write_report(out, KIND, lambda: article(doc, figures), doc["provenance"], inputs)
