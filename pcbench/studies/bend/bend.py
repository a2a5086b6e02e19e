"""`pcbench experiment bend`: solve the same images with different settings and find what deforms the result.

The classic case (James & Robson 2014): nadir images of a drone, taken through a lens whose distortion differs from the
one that the solution assumes. Images and shape can then be wrong together: the scene deforms into a dome or a bowl
while the reprojection errors stay small. The truth is known here, so the setting that causes this can be identified.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from pcbench.errors import InputError, ReconstructionError, record_error
from pcbench.geometry.cameras import Camera, Intrinsics
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.mesh import MeshIndex
from pcbench.geometry.transform import robust_similarity
from pcbench.geometry.visibility import in_frame
from pcbench.io import read_cloud, write_cloud
from pcbench.io.colmap_model import read_colmap_cameras, write_colmap_model
from pcbench.io.meshes import read_mesh
from pcbench.plugins import find_plugin
from pcbench.plugins.run import ReconstructionJob, describe, run
from pcbench.plugins.stages import stage
from pcbench.progress import Step
from pcbench.report.document import provenance
from pcbench.scenes import Scene, read_scene
from pcbench.studies.bend.figure import draw_bend
from pcbench.studies.bend.findings import MEASURE_S, Solution, Variant, csv_text, explain, measure_solutions
from pcbench.studies.bend.page import article
from pcbench.studies.bend.results import KIND, BendStudy, Lens, SurveyedScene
from pcbench.studies.frame.folder import check_folder, study_folder, write_files
from pcbench.studies.frame.publish import StudyOutcome, draw_here, publish

PLUGIN = "sfm"
_INTRINSICS_FOLDER, _PICTURE = "lenses", "bend.png"
DISTORTION = (-0.03, 0.0, 0.0, 0.0)  # lens distortion of synthetic scenes
_FOV_DEG = 60.0  # vertical field of view, typical of a drone
_TRUTH_POINTS = 400_000  # number of points of the synthetic truth
_MAX_NADIR_DEG = 10.0  # largest angle between a nadir image and the vertical
_MIN_IMAGES = 6
_MARK_SIGMA_PX = 0.5  # standard deviation of a control point's mark in an image
_SOLVE_S = 60.0  # rough duration of a solution, for progress bars
_SURVEY_SIGMA = 0.01  # standard deviation of a control point's position, in the truth's unit
_RAY_OFFSET = 1e-4  # from the surface to the start of lines of sight, in the truth's unit
_CONTROL_MARGIN = 0.05  # share of the image's sides within which no control point is marked
# SIFT at the images' own size takes a third of the time and finds enough points.
_COMMON_SETTINGS = {"poses": "solve", "upsample": "false", "matching": "exhaustive"}


@dataclass(frozen=True)
class SurveySettings:
    """Settings of the synthetic survey that is created if no scene is given."""

    images: int = 42
    width: int = 800
    height: int = 600
    seed: int = 0


def run_bend(
    out: Path,
    scene: Path | None,
    settings: SurveySettings,
    *,
    figures: bool = True,
    step: Callable[[str], None] = lambda _: None,
) -> StudyOutcome[BendStudy]:
    """Run the experiment and write report.html, experiment.json, experiment.csv, bend.png and the clouds to a folder.

    Intermediate results (scene/, runs/, work/) stay there; a later run with the same settings reuses them.

    Args:
        out: output folder.
        scene: folder of `pcbench synth city` with truth/mesh.ply and truth/cloud.ply; None creates a scene.
        settings: settings of the created scene, and the seed.
        figures: whether to draw the picture.
        step: progress callback.

    Raises:
        InputError: the scene has no truth, or too few images or cameras; `out` holds something else, or another run is
            writing there.
        PcbenchError: the scene cannot be created.
        OSError: a file cannot be written.
    """
    check_folder(out, KIND)
    if missing := find_plugin(PLUGIN).missing:
        raise InputError(missing)
    if scene is None and settings.images < 2 * _MIN_IMAGES:
        raise InputError(f"expected at least {2 * _MIN_IMAGES} images, got {settings.images}")
    given = None if scene is None else _Survey.read(scene)
    with study_folder(out, KIND, settings):
        survey = given or _Survey.read(_synthetic_scene(out, settings, step))
        return _run(out, survey, settings.seed, figures, step)


@dataclass(frozen=True, eq=False)
class _Survey:
    """A scene with its truth, and the variants to solve."""

    folder: Path
    scene: Scene
    plan: tuple[Variant, ...]
    truth: Cloud
    surface: MeshIndex

    @classmethod
    def read(cls, folder: Path) -> _Survey:
        """Read a scene and its truth.

        Raises:
            InputError: the scene has no truth, or too few images or cameras.
        """
        scene = read_scene(folder)
        plan = tuple(variants(scene))
        truth = read_cloud(_truth_file(folder, "cloud.ply"))
        return cls(folder, scene, plan, truth, MeshIndex(read_mesh(_truth_file(folder, "mesh.ply"))))


def _run(out: Path, survey: _Survey, seed: int, figures: bool, step: Callable[[str], None]) -> StudyOutcome[BendStudy]:
    data, plan, truth = survey.scene, survey.plan, survey.truth
    inputs = _SolveInputs(out, survey.folder, data, seed, describe(PLUGIN).sha256)
    inputs.write(survey.surface, truth)
    solutions = []
    for number, variant in enumerate(plan, 1):
        left = _SOLVE_S * (len(plan) - number) + MEASURE_S * len(plan)
        step(Step(f"solving {number} of {len(plan)}: {variant.name}", _SOLVE_S, left))
        solutions.append(_solve(inputs, variant, survey.surface))
    intrinsics = data.cameras[data.images[0]].intrinsics
    rows = measure_solutions(solutions, truth, intrinsics, seed, step)
    study = BendStudy(
        scene=SurveyedScene(str(survey.folder), len(data), Lens.from_intrinsics(intrinsics), truth.unit),
        plugin=PLUGIN,
        rows=rows,
        sentences=tuple(explain(rows, truth.unit or "")),
        provenance=provenance(seed),
    )
    for solution in solutions:
        file = out / f"{file_stem(solution.variant.name)}.ply"
        if solution.cloud is not None:
            write_cloud(file, solution.cloud)
        else:
            file.unlink(missing_ok=True)

    def draw() -> list[Path]:
        step("drawing the picture")
        draw_bend(study, out / _PICTURE)
        return [out / _PICTURE]

    texts = {"experiment.csv": csv_text(study)}
    drawn = partial(draw_here, draw) if figures else None
    return publish(out, KIND, study, texts, drawn, partial(article, study), study.provenance)


def variants(scene: Scene) -> Iterator[Variant]:
    """Yield the variants to solve, from the best known settings to the least known; one setting changes at a time."""
    nadir, oblique = _split_nadir(scene)
    down = "nadir" if oblique else "all"
    yield Variant("true lens", down, "true", "true", control=False)
    yield Variant("no distortion", down, "true", "zero", control=False)
    yield Variant("no distortion, focal length free", down, "free", "zero", control=False)
    yield Variant("no distortion, control points", down, "true", "zero", control=True)
    yield Variant("distortion free", down, "true", "free", control=False)
    yield Variant("lens free", down, "free", "free", control=False)
    yield Variant("lens free, control points", down, "free", "free", control=True)
    yield Variant("lens unknown", down, "guessed", "free", control=False)
    if len(nadir) >= 2 * _MIN_IMAGES:
        yield Variant("lens free, every second image", "half", "free", "free", control=False)
    if oblique:
        yield Variant("no distortion, oblique images too", "oblique", "true", "zero", control=False)
        yield Variant("lens free, oblique images too", "oblique", "free", "free", control=False)


def file_stem(name: str) -> str:
    """Return a variant's name as a file name."""
    return "-".join("".join(c if c.isalnum() else " " for c in name).split())


def _synthetic_scene(out: Path, settings: SurveySettings, step: Callable[[str], None]) -> Path:
    """Create a city with nadir and some oblique drone images, taken through a lens with distortion."""
    from pcbench.scenes.synthetic.files import SceneSettings, write_scene
    from pcbench.scenes.synthetic.plan import CitySettings

    intrinsics = replace(Intrinsics.from_fov(settings.width, settings.height, _FOV_DEG), distortion=DISTORTION)
    town = CitySettings(seed=settings.seed)
    made = SceneSettings(town, settings.images, intrinsics, "drone", points=_TRUTH_POINTS)
    key = {"settings": repr(made)}
    return stage(out, "scene", key, lambda folder: write_scene(folder, made, step))


def _truth_file(folder: Path, name: str) -> Path:
    path = folder / "truth" / name
    if not path.is_file():
        raise InputError(
            f"{path}: no such file; the experiment needs a scene with truth, as pcbench synth city creates it"
        )
    return path


def _split_nadir(scene: Scene) -> tuple[list[str], list[str]]:
    """Return the names of the nadir images and of the oblique ones; all images count as nadir if hardly any is.

    Raises:
        InputError: an image has no camera, the intrinsics differ, or there are too few images.
    """
    if bare := [name for name in scene.images if name not in scene.cameras]:
        raise InputError(f"{scene.folder}: expected true cameras for all images, got none for {bare[0]}")
    if len({camera.intrinsics for camera in scene.cameras.values()}) > 1:
        raise InputError(f"{scene.folder}: expected images of one lens, got several")
    if len(scene) < _MIN_IMAGES:
        raise InputError(f"{scene.folder}: expected at least {_MIN_IMAGES} images, got {len(scene)}")
    down = [name for name in scene.images if -scene.cameras[name].direction[2] >= np.cos(np.radians(_MAX_NADIR_DEG))]
    if len(down) < _MIN_IMAGES:
        return list(scene.images), []
    return down, [name for name in scene.images if name not in set(down)]


@dataclass(frozen=True)
class _SolveInputs:
    """Inputs that all solutions share: the scene, its intrinsics, and control points."""

    out: Path
    folder: Path
    scene: Scene
    seed: int
    plugin_sha256: str | None

    def images(self, variant: Variant) -> list[str]:
        nadir, oblique = _split_nadir(self.scene)
        return {"oblique": [*nadir, *oblique], "half": nadir[::2]}.get(variant.images, nadir)

    def cameras(self, variant: Variant) -> str:
        """Return the job's argument `cameras`: `none`, or a model with the intrinsics (its poses are not used)."""
        if variant.focal == "guessed":
            return "none"
        return str(self.out / _INTRINSICS_FOLDER / ("true" if variant.distortion == "true" else "undistorted"))

    def settings(self, variant: Variant) -> dict[str, str]:
        focal, distortion = variant.focal != "true", variant.distortion == "free"
        refine = {(True, True): "all", (True, False): "focal", (False, True): "distortion"}.get((focal, distortion))
        values = {**_COMMON_SETTINGS, "refine": refine or "none", "seed": str(self.seed)}
        control = str((self.out / "control.txt").absolute())
        return {**values, "control": control, "align": "control"} if variant.control else {**values, "align": "none"}

    def write(self, mesh: MeshIndex, truth: Cloud) -> None:
        """Write the intrinsics and the control points."""
        cameras = [self.scene.cameras[name] for name in self.scene.images]
        plain = [replace(c, intrinsics=replace(c.intrinsics, distortion=(0.0, 0.0, 0.0, 0.0))) for c in cameras]
        (self.out / _INTRINSICS_FOLDER).mkdir(exist_ok=True)
        write_colmap_model(self.out / _INTRINSICS_FOLDER / "true", cameras)
        write_colmap_model(self.out / _INTRINSICS_FOLDER / "undistorted", plain)
        lines = list(_control_lines(cameras, mesh, truth, self.seed))
        write_files(self.out, {"control.txt": "\n".join(["# NAME X Y Z IMAGE U V", *lines, ""])})


def _control_lines(cameras: Sequence[Camera], mesh: MeshIndex, truth: Cloud, seed: int) -> Iterator[str]:
    """Yield nine control points on level ground or roofs, with the errors of a survey and of marking in images."""
    if truth.normals is None:
        raise InputError("expected normals in truth/cloud.ply, got none; control points need level ground")
    rng = np.random.default_rng([seed, 21])
    positions = np.array([camera.position for camera in cameras])[:, :2]
    middle, half_size = (positions.min(axis=0) + positions.max(axis=0)) / 2, 0.4 * np.ptp(positions, axis=0)
    level = truth.select(np.flatnonzero(truth.normals[:, 2] > 0.95))
    assert level.normals is not None
    for number in range(9):
        target = middle + half_size * (np.array(divmod(number, 3)) - 1)
        near = np.argsort(np.square(level.points[:, :2] - target).sum(axis=1))[:50]
        points, starts = level.points[near], level.points[near] + _RAY_OFFSET * level.normals[near]
        seen = [
            in_frame(camera, points, beyond=-_CONTROL_MARGIN)
            & ~mesh.is_occluded(starts, camera.position - starts, limit=1.0)
            for camera in cameras
        ]
        visible = np.stack(seen, axis=1)
        best = int(visible.sum(axis=1).argmax())
        if visible[best].sum() < 3:
            continue
        coordinates = " ".join(repr(float(x)) for x in points[best] + rng.normal(0, _SURVEY_SIGMA, 3))
        for index in np.flatnonzero(visible[best]).tolist():
            u, v = cameras[index].project(points[best : best + 1])[0][0] + rng.normal(0, _MARK_SIGMA_PX, 2)
            yield f"P{number + 1} {coordinates} {cameras[index].name} {float(u)!r} {float(v)!r}"


def _solve(inputs: _SolveInputs, variant: Variant, surface: MeshIndex) -> Solution:
    """Solve one variant and register its cloud to the truth; the reconstruction is saved for later runs."""
    images = inputs.images(variant)
    cameras_from = inputs.cameras(variant)
    job = ReconstructionJob(PLUGIN, inputs.folder, inputs.settings(variant), cameras=cameras_from, images=tuple(images))
    control = (inputs.out / "control.txt").read_text(encoding="utf-8") if variant.control else ""
    key = {
        "job": job.to_json(),
        "scene": inputs.scene.fingerprint(),
        "control": control,
        "plugin": inputs.plugin_sha256,
    }
    runs = inputs.out / "runs"
    runs.mkdir(exist_ok=True)

    def make(folder: Path) -> None:
        # Variants with the same images share features and matches.
        made = run(job, inputs.out / "work" / variant.images).require_reconstruction()
        write_cloud(folder / "cloud.ply", made.cloud)
        write_colmap_model(folder / "cameras", list(made.cameras.values()))
        (folder / "notes.json").write_text(json.dumps(list(made.notes)), encoding="utf-8")

    try:
        folder = stage(runs, file_stem(variant.name), key, make)
        cameras = {camera.name: camera for camera in read_colmap_cameras(folder / "cameras")}
        cloud = register_by_rays(read_cloud(folder / "cloud.ply"), cameras, inputs.scene.cameras, surface)
    except (InputError, ReconstructionError) as error:  # not saved: the next run tries again
        return Solution(variant, len(images), failure=record_error(error).removeprefix("failed: "))
    notes = json.loads((folder / "notes.json").read_text(encoding="utf-8"))
    intrinsics = next(iter(cameras.values())).intrinsics
    return Solution(variant, len(images), len(cameras), cloud, intrinsics, tuple(notes))


def register_by_rays(
    cloud: Cloud, solved: Mapping[str, Camera], truth: Mapping[str, Camera], surface: MeshIndex
) -> Cloud:
    """Register a cloud to the truth by rays of the true cameras.

    Each point's pixel is cast from the true camera onto the true surface; a robust similarity maps the points to the
    hits. Camera positions would not do: those of a survey lie in one plane, and a wrong focal length changes their
    distance to the ground.

    Args:
        cloud: cloud in the frame of its cameras.
        solved: solved cameras by image name.
        truth: true cameras by image name.
        surface: true surface.

    Raises:
        InputError: hardly any point is visible.
    """
    names = sorted(set(solved) & set(truth))
    middle = [0.5 * truth[names[0]].intrinsics.width, 0.5 * truth[names[0]].intrinsics.height]
    # Use the camera that shows the point nearest to its image centre, where intrinsics differ least.
    center_distances, origins, rays = (
        np.full(len(cloud), min(middle)),
        np.zeros((len(cloud), 3)),
        np.zeros((len(cloud), 3)),
    )
    for name in names:
        pixels, _ = solved[name].project(cloud.points)
        distance = np.where(in_frame(solved[name], cloud.points), np.linalg.norm(pixels - middle, axis=1), np.inf)
        closer, camera = distance < center_distances, truth[name]
        center_distances[closer], origins[closer] = distance[closer], camera.position
        rays[closer] = camera.intrinsics.directions(pixels[closer]) @ camera.cam_from_world.rotation
    seen = np.flatnonzero(center_distances < min(middle))
    hits = surface.cast(origins[seen], rays[seen])
    hit = hits.faces >= 0
    points = cloud.points[seen[hit]]
    targets = origins[seen[hit]] + hits.distances[hit, None] * rays[seen[hit]]
    fit = robust_similarity(points, targets)  # robust, because some rays hit another surface than the point's own
    attributes = {k: v for k, v in cloud.attributes.items() if k == "reprojection_error"}
    return replace(cloud.transformed(fit), attributes=attributes)
