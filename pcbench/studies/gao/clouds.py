"""Reconstruct the clouds of one scene, each in a separate process; they are saved for later runs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from pcbench.errors import InputError, ReconstructionError, record_error
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.crop import points_inside
from pcbench.geometry.region_text import as_region
from pcbench.io import read_cloud, write_cloud
from pcbench.io.colmap_model import write_colmap_model
from pcbench.io.json_values import from_json, to_json
from pcbench.plugins.run import ReconstructionJob, describe, run
from pcbench.plugins.stages import stage, stage_key
from pcbench.progress import Step
from pcbench.regular_files import read_json
from pcbench.scenes import Scene
from pcbench.studies.gao.plan import SPARSE, SURFACE, CloudMethod, GaoJob, methods
from pcbench.studies.gao.results import CAMERAS_FOLDER, CLOUD_FILE, CloudResult

_RUN_FILE, _RUNS_FOLDER, WORK_FOLDER = "run.json", "runs", "work"
_EXPECTED_S = {"sfm": 60.0, "mvs": 240.0, "splat": 240.0, "field": 240.0}  # rough durations, for progress bars


def make_clouds(
    job: GaoJob,
    scene: Scene,
    path: Path,
    out: Path,
    unit: str | None,
    step: Callable[[Step], None],
    *,
    beside_others: bool = False,
) -> list[CloudResult]:
    """Reconstruct all clouds of a scene, in the order of `methods`; a failure becomes a result with its reason.

    Args:
        job: the experiment.
        scene: scene to reconstruct.
        path: its folder, as given to `read_scene`.
        out: existing folder for all results.
        unit: unit of the scene's cameras, if known, for clouds without one.
        step: progress callback; the remaining seconds are those of this scene.
        beside_others: whether other scenes are processed at the same time.

    Raises:
        InputError: the crop holds no point of the sparse cloud, which is reconstructed first.
        OSError: a file cannot be written.
    """
    maker = _CloudMaker(job, scene, path, out, unit, step, beside_others)
    done: dict[str, CloudResult] = {}
    for number, method in enumerate(plan := methods(job)):
        seconds = _EXPECTED_S[method.plugin]
        later = sum(_EXPECTED_S[m.plugin] for m in plan[number + 1 :])
        step(Step(f"{scene.name}: {method.name}", seconds, later))
        same_workspace = [done[other.name] for other in plan[:number] if other.workspace == method.workspace]
        cloud = maker.make(method, done.get(SPARSE), same_workspace)
        if method.name == SPARSE and cloud.file is not None:
            sparse = read_cloud(cloud.file)
            maker = replace(maker, unit=sparse.unit)  # GPS makes solved cameras metric
            if job.crop is not None:
                check_crop(job.crop, sparse, f"{scene.name}: the sparse cloud's")
        done[method.name] = cloud
    return list(done.values())


def check_crop(crop: str, cloud: Cloud, label: str) -> None:
    """Check that a region holds points of a cloud.

    Raises:
        InputError: the region holds none, so that nothing could be measured in it.
    """
    points_inside(cloud.points, as_region(crop, cloud), crop, label)


@dataclass(frozen=True)
class _CloudMaker:
    """Reconstructs the clouds of one scene."""

    job: GaoJob
    scene: Scene
    path: Path
    out: Path
    unit: str | None
    step: Callable[[Step], None]
    beside_others: bool

    def make(
        self, method: CloudMethod, sparse: CloudResult | None, same_workspace: Sequence[CloudResult]
    ) -> CloudResult:
        """Return the cloud of a method, without evaluations; `same_workspace` are earlier clouds of its workspace."""
        if sparse is not None and self.job.poses == "solve" and sparse.folder is None:
            return _failed(method, f"no cameras: {sparse.failure}")
        if failed := next((cloud for cloud in same_workspace if cloud.failure), None):
            return _failed(method, failed.failure)
        solved = sparse.folder if sparse is not None and self.job.poses == "solve" else None
        for folder_name in (_RUNS_FOLDER, WORK_FOLDER):
            (self.out / folder_name).mkdir(exist_ok=True)
        key = {
            "plugin": describe(method.plugin).sha256,
            "settings": method.settings,
            "scene": self.scene.fingerprint(),
            "cameras": None if solved is None else stage_key(solved),
            "unit": self.unit,
        }
        try:
            folder = stage(self.out / _RUNS_FOLDER, method.name, key, lambda target: self._run(method, solved, target))
        except (InputError, ReconstructionError) as error:  # not saved: the next run tries again
            return _failed(method, record_error(error))
        return replace(from_json(CloudResult, read_json(folder / _RUN_FILE)), folder=folder)

    def _run(self, method: CloudMethod, solved: Path | None, target: Path) -> None:
        workspace = self.out / WORK_FOLDER / method.workspace
        start_mark = self.out / WORK_FOLDER / f"{method.name}.begun"
        resumed = start_mark.exists()
        start_mark.touch()
        cameras = "auto" if solved is None else str(solved / CAMERAS_FOLDER)
        scale = self.scene.image_scale
        outcome = run(
            ReconstructionJob(method.plugin, self.path, method.settings, cameras=cameras, image_scale=scale),
            workspace,
            self.job.time_limit,
            lambda text: self.step(Step(f"{self.scene.name}: {method.name}: {text}")),
        )
        result = outcome.require_reconstruction()
        cloud = result.cloud
        if cloud.unit is None and result.gauge == "georeferenced":
            cloud = replace(cloud, unit=self.unit)
        write_cloud(target / CLOUD_FILE, cloud)
        write_colmap_model(target / CAMERAS_FOLDER, list(result.cameras.values()))
        record = CloudResult(
            name=method.name,
            points=len(cloud),
            seconds=outcome.wall_s,
            resumed=resumed,
            memory_bytes=outcome.peak_rss_bytes,
            extra=method.name == SURFACE,
            notes=(*outcome.warnings, *result.notes),
            beside_others=self.beside_others,
        )
        (target / _RUN_FILE).write_text(to_json(record), encoding="utf-8")


def _failed(method: CloudMethod, reason: str) -> CloudResult:
    return CloudResult(method.name, extra=method.name == SURFACE, failure=reason)
