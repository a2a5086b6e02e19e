"""`pcbench experiment gao`: the results of Gao et al. 2025 for any scenes, with the truth as a second reference."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import cycle
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pcbench.errors import InputError, ReconstructionError
from pcbench.geometry.cameras import Intrinsics
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.region_text import as_region, parse_region
from pcbench.io import read_cloud
from pcbench.io.json_values import to_json
from pcbench.plugins import find_plugin
from pcbench.plugins.stages import stage
from pcbench.progress import Step
from pcbench.report.article import Article
from pcbench.report.document import provenance
from pcbench.report.html import PAGE
from pcbench.report.plot import Drawn, draw_if_possible
from pcbench.scenes import Scene, read_scene
from pcbench.scenes.views import find_views
from pcbench.studies.frame.cells import map_cells
from pcbench.studies.frame.folder import MARK, check_folder, folders_by_name, study_folder, write_files
from pcbench.studies.frame.publish import StudyOutcome, publish
from pcbench.studies.gao.cameras import camera_errors, cameras_in_cloud_frame
from pcbench.studies.gao.clouds import WORK_FOLDER, check_crop, make_clouds
from pcbench.studies.gao.evaluation import CloudEvaluation, draw_maps, evaluate_against, visible_truth
from pcbench.studies.gao.figures import PICTURES
from pcbench.studies.gao.injection import inject_deformations
from pcbench.studies.gao.page import article
from pcbench.studies.gao.plan import (
    FIELD,
    MVS,
    SPARSE,
    SPLAT,
    SURFACE,
    Cities,
    GaoJob,
    default_region,
    focus_point,
    methods,
)
from pcbench.studies.gao.results import (
    KIND,
    TRUTH,
    GaoStudy,
    InjectedDeformation,
    NewViews,
    ReferenceEvaluation,
    SceneResult,
)
from pcbench.studies.gao.sentences import sentences
from pcbench.studies.gao.table import csv_text, failures
from pcbench.studies.views.pictures import PICTURES as VIEW_PICTURES
from pcbench.studies.views.scores import KIND as SCORES
from pcbench.studies.views.scores import ScoredScene, ViewStudy, score_views, scores_csv
from pcbench.tasks import Workers

_SCENES_FOLDER, _VIEWS_FOLDER = "scenes", "views"
_RESERVED_NAMES = (_SCENES_FOLDER, _VIEWS_FOLDER, "figures", MARK, PAGE)  # names that a scene's folder cannot have
_TRUTH_POINTS = 1_000_000  # number of points of a synthetic truth
_FOV_DEG = 40.0  # vertical field of view
_MAKING_S, _MEASURING_S, _INJECTING_S, _DRAWING_S = (
    60.0,
    90.0,
    90.0,
    60.0,
)  # rough durations per scene, for progress bars
_SCENE_S = 600.0
_MIN_IMAGES = 9  # so that one in eight can be held out

# Density, median building height and relief of the synthetic cities, which also differ in their seeds: a usual city, a
# low one with wide gaps, and a high one on hills.
_CITY_KINDS = ((0.85, 9.0, 2.0), (0.5, 6.0, 2.0), (0.85, 14.0, 3.0))


@dataclass(frozen=True, eq=False)
class GaoOutcome(StudyOutcome[GaoStudy]):
    """The outcome of the experiment, with the scores of its novel views."""

    views: ViewStudy | None = None


def run_gao(
    job: GaoJob,
    out: Path,
    *,
    workers: Workers | None = None,
    figures: bool = True,
    step: Callable[[str], None] = lambda _: None,
) -> GaoOutcome:
    """Run the experiment and write its results to a folder.

    They are report.html, experiment.json, experiment.csv, gao.md, figures/, one folder per scene with its clouds and
    the reports against both references, and views/ with the scores of novel views. Intermediate results stay in the
    folder; a later run with the same settings reuses them.

    Args:
        job: the experiment.
        out: output folder.
        workers: where scenes are processed at the same time, each with one thread; None: one after another in this
            process.
        figures: whether to draw pictures.
        step: progress callback.

    Raises:
        InputError: a scene, the crop or a setting is not usable; `out` holds something else, or another run is writing
            there.
        ReconstructionError: no scene has a cloud that could be measured.
        PcbenchError: a scene cannot be created.
        OSError: a file cannot be written.
    """
    check_folder(out, KIND)
    for method in methods(job):  # checked before hours of work
        plugin = find_plugin(method.plugin)
        if plugin.missing:
            raise InputError(plugin.missing)
        plugin.configure(method.settings)
    if job.crop is not None:
        parse_region(job.crop, Cloud(np.arange(30.0).reshape(10, 3)))  # checks the syntax only; any points will do
    given = {path: _read_checked_scene(job, path, job.image_scale) for path in job.scenes}
    if not given and job.cities.images < _MIN_IMAGES:
        raise InputError(f"expected at least {_MIN_IMAGES} images, got {job.cities.images}")
    with study_folder(out, KIND, job):
        return _run(job, given, out, workers, figures, step)


def _run(
    job: GaoJob,
    given: Mapping[Path, Scene],
    out: Path,
    workers: Workers | None,
    figures: bool,
    step: Callable[[str], None],
) -> GaoOutcome:
    made = (
        {path: _read_checked_scene(job, path) for path in _synthetic_scenes(job.cities, out, job.seed, step)}
        if not given
        else {}
    )
    all_scenes = {**given, **made}
    named = folders_by_name(all_scenes, _RESERVED_NAMES)
    cells = [_SceneCell(name, path, all_scenes[path], out / name, workers is not None) for name, path in named.items()]
    outcomes = map_cells(_run_scene, job, cells, out=out, workers=workers, step=step, cell_seconds=_SCENE_S)
    scenes: list[SceneResult] = []
    reports: list[Path] = []
    rendered: dict[tuple[str, str], Path] = {}
    for scene_outcome in outcomes:
        scenes.append(scene_outcome.result)
        reports += scene_outcome.reports
        rendered |= {(scene_outcome.result.name, name): views for name, views in scene_outcome.views.items()}
    views = _score_views(list(rendered.values()), out, step)
    scored = {} if views is None else dict(zip(rendered, views.scenes, strict=True))
    of_splats = {name: _new_views(scene) for (name, workspace), scene in scored.items() if workspace == SPLAT}
    scenes = [replace(scene, views=of_splats.get(scene.name)) for scene in scenes]
    splat = next(method.settings for method in methods(job) if method.name == SURFACE)
    study = GaoStudy(job.poses, splat, tuple(scenes), provenance=provenance(job.seed))
    study = replace(study, sentences=tuple(sentences(study)))
    of_views = Drawn([])

    def draw() -> Drawn:
        nonlocal of_views
        drawn, of_views = _draw(out, reports, views, step)
        return drawn

    def make(drawn: Sequence[str]) -> Article:
        folders = [folder.relative_to(out).as_posix() for folder in reports]
        return article(study, views, drawn, of_views.relative_to(out), folders)

    texts = {"experiment.csv": csv_text(study)}
    outcome = publish(out, KIND, study, texts, draw if figures else None, make, study.provenance)
    if not reports:
        raise ReconstructionError(f"{out}: no cloud could be measured: {next(failures(study), '')}")
    return GaoOutcome(study, outcome.without_figures or of_views.problem, outcome.without_page, views)


class _SceneCell(NamedTuple):
    name: str
    path: Path
    scene: Scene
    out: Path  # folder of its results
    beside_others: bool  # whether several scenes are processed at the same time


@dataclass(frozen=True)
class _SceneOutcome:
    result: SceneResult
    reports: list[Path]
    views: dict[str, Path]  # folders of rendered views, by workspace


def _run_scene(job: GaoJob, cell: _SceneCell, scene_step: Callable[[str], None]) -> _SceneOutcome:
    """Run one scene, without the scores of its views."""
    name, path, scene, out, beside_others = cell
    out.mkdir(exist_ok=True)
    truth = _truth_file(path)
    unit = read_cloud(truth).unit if truth.is_file() else "m" if scene.origin is not None else None
    clouds = make_clouds(job, scene, path, out, unit, scene_step, beside_others=beside_others)
    made = {cloud.name: cloud for cloud in clouds}
    solved = made[SPARSE].cameras() if job.poses == "solve" else {}
    cameras = list(cameras_in_cloud_frame(solved, scene.cameras).values())
    crop = job.crop or default_region(cameras)
    files = {cloud.name: cloud.file for cloud in clouds if cloud.file is not None}
    if SPARSE in files:
        unit = read_cloud(files[SPARSE]).unit  # GPS makes solved cameras metric
    evaluations: dict[str, CloudEvaluation] = {}
    references = {MVS: files.get(MVS), TRUTH: visible_truth(truth, out) if truth.is_file() else None}
    for reference, file in references.items():
        others = {cloud: candidate for cloud, candidate in files.items() if cloud != reference}
        if file is None or not others:
            continue
        scene_step(Step(f"{name}: measuring against {reference}", _MEASURING_S))
        evaluations[reference] = evaluate_against(file, reference, others, crop, out, job.seed)
    injected: tuple[InjectedDeformation, ...] = ()
    if (mvs := files.get(MVS)) is not None and len(files) > 1:
        scene_step(Step(f"{name}: deforming clouds on purpose", _INJECTING_S))
        others = {cloud: file for cloud, file in files.items() if cloud != MVS}
        injected = inject_deformations(mvs, others, crop, out, job.seed)
    focus = focus_point(cameras)
    result = SceneResult(
        name=name,
        path=str(path),
        unit=unit,
        images=len(scene),
        positions=tuple(tuple(camera.position.tolist()) for camera in cameras),
        looked_at=None if focus is None else tuple(focus.tolist()),
        region=crop,
        cameras=camera_errors(solved, scene.cameras, _crop_truth(references[TRUTH], crop)) if solved else None,
        references={
            reference: evaluation.counts
            for reference, evaluation in evaluations.items()
            if evaluation.counts is not None
        },
        clouds=tuple(replace(cloud, against=_against(cloud.name, evaluations)) for cloud in clouds),
        injected=injected,
    )
    rendering = [
        method.workspace for method in methods(job) if method.name in files and method.workspace in (SPLAT, FIELD)
    ]
    views = {workspace: find_views(out / WORK_FOLDER / workspace) for workspace in rendering}
    reports = [evaluation.folder for evaluation in evaluations.values() if evaluation.folder is not None]
    return _SceneOutcome(result, reports, {workspace: folder for workspace, folder in views.items() if folder})


def _crop_truth(truth: Path | None, crop: str) -> Cloud | None:
    """Return the part of the truth inside the crop; None if the truth is unknown."""
    if truth is None:
        return None
    cloud = read_cloud(truth)
    region = as_region(crop, cloud)
    return cloud if region is None else cloud.select(np.flatnonzero(region.contains(cloud.points)))


def _against(name: str, evaluations: Mapping[str, CloudEvaluation]) -> tuple[ReferenceEvaluation, ...]:
    """Return the evaluations of one cloud, one per reference."""
    return tuple(evaluation.clouds[name] for evaluation in evaluations.values() if name in evaluation.clouds)


def _score_views(folders: Sequence[Path], out: Path, step: Callable[[str], None]) -> ViewStudy | None:
    """Score the novel views of folders, in their order."""
    if not folders:
        return None
    study = score_views(folders, step)
    (out / _VIEWS_FOLDER).mkdir(exist_ok=True)
    texts = {"scores.csv": scores_csv(study), SCORES.document: to_json(SCORES.values(study))}
    write_files(out / _VIEWS_FOLDER, texts)
    return study


def _new_views(scored: ScoredScene) -> NewViews:
    train, test = (len(scored.select(test=kind)) for kind in (False, True))
    return NewViews(scored.mean(test=False), scored.mean(test=True), train, test, scored.standard_error())


def _draw(
    out: Path, reports: Sequence[Path], views: ViewStudy | None, step: Callable[[str], None]
) -> tuple[Drawn, Drawn]:
    """Draw the pictures of the experiment and its reports, and those of novel views; return both."""
    step(Step("drawing the pictures", _DRAWING_S))
    own = draw_if_possible(out, PICTURES)
    problems = [own.problem, *map(draw_maps, reports)]
    of_views = Drawn([]) if views is None else draw_if_possible(out / _VIEWS_FOLDER, VIEW_PICTURES)
    return Drawn(own.files, next(filter(None, problems), None)), of_views


def _read_checked_scene(job: GaoJob, path: Path, image_scale: float = 1.0) -> Scene:
    """Read a scene and check that the experiment can use it.

    Raises:
        InputError: it has too few images, lacks cameras that are not solved, or its truth has no point in the crop.
    """
    scene = read_scene(path, image_scale=image_scale)
    if job.poses == "given" and len(scene.cameras) < len(scene):
        bare = next(name for name in scene.images if name not in scene.cameras)
        raise InputError(f"{path}: expected cameras of all images, got none for {bare}; or set --poses solve")
    if len(scene) < _MIN_IMAGES:
        raise InputError(
            f"{path}: expected at least {_MIN_IMAGES} images, of which one in 8 is held out, got {len(scene)}"
        )
    if job.crop is not None and (truth := _truth_file(path)).is_file():
        check_crop(job.crop, read_cloud(truth), f"{truth}: the truth's")
    return scene


def _truth_file(path: Path) -> Path:
    """Return the path of a scene's true cloud, which need not exist."""
    return path / "truth" / "cloud.ply"


def _synthetic_scenes(cities: Cities, out: Path, seed: int, step: Callable[[str], None]) -> Iterator[Path]:
    """Create cities of different kinds with cameras on the paper's seven circles."""
    from pcbench.scenes.synthetic.files import SceneSettings, write_scene
    from pcbench.scenes.synthetic.plan import CitySettings

    (out / _SCENES_FOLDER).mkdir(exist_ok=True)
    intrinsics = Intrinsics.from_fov(cities.width, cities.height, _FOV_DEG)
    for number, (density, height, relief) in zip(range(cities.count), cycle(_CITY_KINDS), strict=False):
        town = CitySettings(cities.extent, density, height, relief, seed=seed + number)
        made = SceneSettings(town, cities.images, intrinsics, "circles", points=_TRUTH_POINTS)
        step(Step(f"photographing city {number + 1} of {cities.count}", _MAKING_S, _SCENE_S * cities.count))
        key = {"settings": repr(made)}

        def make(folder: Path, made: SceneSettings = made) -> None:
            write_scene(folder, made)

        yield stage(out / _SCENES_FOLDER, f"city_{number + 1}", key, make)
