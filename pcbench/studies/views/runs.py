"""`pcbench views`: rendered views of scenes, made where they are not there yet, measured, as table and pictures."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from pcbench.errors import InputError, Notice, PcbenchError, ReconstructionError, recorded
from pcbench.io.files import atomic_write
from pcbench.plugins.run import ReconstructionJob, run
from pcbench.progress import Step
from pcbench.scenes.views import find_views
from pcbench.scratch import claim
from pcbench.studies.views.scores import DOCUMENT, ViewStudy, score_views, write_scores
from pcbench.studies.views.table import markdown

_RUNS = "runs"
_MAKING_S = 300.0  # that one scene takes, roughly, for progress bars


@dataclass(frozen=True)
class ViewsJob:
    """What is measured, and how views are made where there are none.

    Attributes:
        scenes: scenes as `read_scene` reads them, folders of rendered views, or workspaces that have one.
        method: the reconstructor that makes views of a scene.
        settings: of the reconstructor.
        cameras, image_scale: as for `read_scene`.
        time_limit: seconds, of one scene.
    """

    scenes: tuple[Path, ...]
    method: str = "splat"
    settings: Mapping[str, str] = field(default_factory=dict)
    cameras: str = "auto"
    image_scale: float = 1.0
    time_limit: float | None = None


def run_views(job: ViewsJob, out: Path, step: Callable[[str], None] = lambda _: None) -> ViewStudy:
    """Make the rendered views that are not there yet, one scene after the other, and measure all of them.

    A scene of which none can be made is a note; the others are measured. What is made is kept in `out`, from where the
    same call goes on; `scores.json`, `scores.csv` and `views.md` are written there.

    Raises:
        InputError: `out` is something else, another run is writing there, or a folder is neither a scene nor views.
        ReconstructionError: no scene has views.
        OSError: a file cannot be written.
    """
    _check(job, out)
    out.absolute().parent.mkdir(parents=True, exist_ok=True)
    with claim(out):
        (out / _RUNS).mkdir(parents=True, exist_ok=True)
        folders, failed = [], []
        for number, (name, scene) in enumerate(_named(job.scenes).items(), 1):
            if (found := find_views(scene)) is not None:
                folders.append(found)
                continue
            step(Step(f"{job.method} {number} of {len(job.scenes)}: {name}", _MAKING_S))
            try:
                folders.append(_make(job, scene, out / _RUNS / name, step))
            except PcbenchError as error:
                failed.append(Notice("no-views", f"{scene}: {recorded(error)}"))
        if not folders:
            raise ReconstructionError(f"no scene has rendered views: {failed[0]}")
        study = score_views(folders, step)
        study = ViewStudy(study.scenes, (*failed, *study.notes))
        with atomic_write(out / "views.md") as file:
            file.write(markdown(study).encode())
        write_scores(out, study)
    return study


def _make(job: ViewsJob, scene: Path, workspace: Path, step: Callable[[str], None]) -> Path:
    """The folder of views that the reconstructor makes of one scene.

    Raises:
        InputError: the reconstructor writes no views.
        PcbenchError: it fails.
    """
    asked = ReconstructionJob(job.method, scene, job.settings, cameras=job.cameras, image_scale=job.image_scale)
    run(asked, workspace, job.time_limit, lambda text: step(f"{job.method}, {scene.name}: {text}")).required()
    found = find_views(workspace)
    if found is None:
        raise InputError(f"{job.method} made a cloud but no rendered views (pcbench.scenes.views.write_views)")
    return found


def _check(job: ViewsJob, out: Path) -> None:
    if not job.scenes:
        raise InputError("expected at least one scene or folder of rendered views")
    if job.settings.get("hold_out") == "none":  # before hours of work
        raise InputError("expected hold_out=every or hold_out=blocks, got none: views are measured of held-out images")
    if missing := [path for path in job.scenes if not path.exists()]:
        raise InputError(f"{missing[0]}: no such file or folder: expected a scene or a folder of rendered views")
    if out.exists() and not out.is_dir():
        raise InputError(f"{out}: expected a folder, got a file")
    ours = (out / _RUNS).is_dir() or (out / DOCUMENT).is_file()
    if out.is_dir() and any(out.iterdir()) and not ours:
        raise InputError(f"{out}: the folder is not empty and holds no such study: choose another one, or empty it")


def _named(scenes: Sequence[Path]) -> dict[str, Path]:
    """By the names of their folders, numbered where several are alike."""
    named: dict[str, Path] = {}
    for scene in scenes:
        stem = scene.resolve().name or "scene"
        alike = sum(name == stem or name.startswith(f"{stem}_") for name in named)
        named[f"{stem}_{alike + 1}" if alike else stem] = scene
    return named
