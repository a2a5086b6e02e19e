"""`pcbench views`: render missing views of scenes, measure all views, and write tables."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from pcbench.errors import InputError, Notice, ReconstructionError, record_error
from pcbench.plugins.run import JOB, PLUGIN, ReconstructionJob, run
from pcbench.progress import Step
from pcbench.report.document import provenance
from pcbench.report.plot import draw_if_possible
from pcbench.scenes.views import find_views
from pcbench.studies.frame.folder import check_folder, folders_by_name, study_folder
from pcbench.studies.frame.publish import StudyOutcome, publish
from pcbench.studies.views.page import article
from pcbench.studies.views.pictures import PICTURES
from pcbench.studies.views.scores import KIND, ViewStudy, score_views, scores_csv

_RUNS_FOLDER = "runs"
_EXPECTED_SCENE_S = 300.0  # rough duration of rendering a scene, for progress bars


@dataclass(frozen=True)
class ViewsJob:
    """Scenes to measure, and how to render views if they have none.

    Attributes:
        scenes: scenes for `read_scene`, folders of rendered views, or workspaces that contain one.
        method: reconstructor that renders views of a scene.
        settings: settings of the reconstructor.
        cameras: cameras, as for `read_scene`.
        image_scale: image scale, as for `read_scene`.
        time_limit: time limit per scene, in seconds.
    """

    scenes: tuple[Path, ...]
    method: str = "splat"
    settings: Mapping[str, str] = field(default_factory=dict)
    cameras: str = "auto"
    image_scale: float = 1.0
    time_limit: float | None = None


def run_views(
    job: ViewsJob, out: Path, *, figures: bool = True, step: Callable[[str], None] = lambda _: None
) -> StudyOutcome[ViewStudy]:
    """Render missing views, one scene after another, and measure all views.

    A scene without views becomes a note; the others are measured. Renderings stay in `out` and are used again by a
    later call. `scores.json`, `scores.csv`, `views.md`, pictures and `report.html` are written there.

    Args:
        job: scenes to measure.
        out: output folder.
        figures: whether to draw pictures.
        step: progress callback.

    Raises:
        InputError: `out` holds something else, another run is writing there, or a workspace has no views.
        ReconstructionError: no scene has views.
        MissingExtra: a library that measures views is not installed.
        OSError: a file cannot be written.
    """
    _check_job(job, out)
    with study_folder(out, KIND, job):
        (out / _RUNS_FOLDER).mkdir(exist_ok=True)
        folders, failed = [], []
        for number, (name, scene) in enumerate(folders_by_name(job.scenes).items(), 1):
            if (rendered := find_views(scene)) is not None:
                folders.append(rendered)
                continue
            step(Step(f"{job.method} {number} of {len(job.scenes)}: {name}", _EXPECTED_SCENE_S))
            try:
                folders.append(_render_views(job, scene, out / _RUNS_FOLDER / name, step))
            except (InputError, ReconstructionError) as error:
                failed.append(Notice("no-views", f"{scene}: {record_error(error)}"))
        if not folders:
            raise ReconstructionError(f"no scene has rendered views: {failed[0]}")
        study = score_views(folders, step)
        study = ViewStudy(study.scenes, (*failed, *study.notes))
        step("drawing the pictures" if figures else "writing the page")
        draw = partial(draw_if_possible, out, PICTURES) if figures else None
        texts = {"scores.csv": scores_csv(study)}
        return publish(out, KIND, study, texts, draw, partial(article, study), provenance(None))


def _render_views(job: ViewsJob, scene: Path, workspace: Path, step: Callable[[str], None]) -> Path:
    """Reconstruct one scene and return its folder of rendered views.

    Raises:
        InputError: the reconstructor writes no views.
        PcbenchError: the reconstruction fails.
    """
    wanted = ReconstructionJob(job.method, scene, job.settings, cameras=job.cameras, image_scale=job.image_scale)
    run(
        wanted, workspace, job.time_limit, lambda text: step(f"{job.method}, {scene.name}: {text}")
    ).require_reconstruction()
    rendered = find_views(workspace)
    if rendered is None:
        raise InputError(f"{job.method} wrote a cloud but no rendered views (pcbench.scenes.views.write_views)")
    return rendered


def _check_job(job: ViewsJob, out: Path) -> None:
    if not job.scenes:
        raise InputError("expected at least one scene or folder of rendered views")
    if job.settings.get("hold_out") == "none":  # checked before hours of work
        raise InputError("expected hold_out=every or hold_out=blocks, got none; the scores need held-out images")
    if missing := [path for path in job.scenes if not path.exists()]:
        raise InputError(f"{missing[0]}: no such file or folder: expected a scene or a folder of rendered views")
    for path in job.scenes:
        if find_views(path) is None and (path / JOB).is_file() and (path / PLUGIN).is_dir():
            raise InputError(
                f"{path}: the workspace holds no rendered views; give the folder of photographs, or render them with"
                " `pcbench reconstruct splat PHOTOS -o CLOUD --set hold_out=every`"
            )
    check_folder(out, KIND)
