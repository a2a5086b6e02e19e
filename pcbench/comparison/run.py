"""Compute a comparison, in memory or in tiles, and write its report; a failed run writes nothing."""

from __future__ import annotations

import os
import shutil
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

from pcbench.comparison.check_points import with_check_points
from pcbench.comparison.in_memory import compare_in_memory
from pcbench.comparison.plan import CloudsOnDisk, choose_tiles
from pcbench.comparison.request import Input, Request, TilingChoice
from pcbench.comparison.result import Comparison
from pcbench.comparison.workspace import default_workspaces, first_free_workspace
from pcbench.errors import InputError
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.crs import check_lengths
from pcbench.geometry.datums import StatedSystem
from pcbench.geometry.mesh import Mesh
from pcbench.geometry.splats import filter_splats, splat_model
from pcbench.io import CloudLike
from pcbench.io.contents import changed_error, digest
from pcbench.io.source import Source
from pcbench.measure.settings import Settings, with_changes
from pcbench.measure.tiled.settings import TilingSettings
from pcbench.progress import ProgressPlan
from pcbench.report.folder import report_folder, write_report
from pcbench.report.inputs import InputFile, Inputs
from pcbench.report.manifest import MAPS
from pcbench.report.plot import draw_if_possible, drawing_seconds
from pcbench.report.viewing import CAMERAS_FILE, SceneFolder, SceneLike, ViewingCameras, viewing_cameras

_WRITING_SAMPLES_S = 5.0  # writing the report of a tiled comparison, whose maps are samples


@dataclass(frozen=True)
class Outputs:
    """The outputs of a comparison: a report folder, if any, and whether to draw pictures."""

    folder: Path | None = None
    figures: bool = True


@dataclass(frozen=True, eq=False)
class ComparisonOutcome:
    """A comparison, the warnings of reading its inputs, and why its page or its pictures could not be made, if so."""

    comparison: Comparison
    reader_warnings: tuple[str, ...] = ()
    without_page: str | None = None
    without_figures: str | None = None


def compare(
    reference: Mesh | CloudLike,
    candidates: Sequence[Mesh | CloudLike] | Mapping[str, Any] | Mesh | CloudLike,
    settings: Settings | None = None,
    *,
    scene: SceneLike | None = None,
    tiling: TilingSettings | None = None,
    workspace: str | Path | None = None,
    on_step: Callable[[str], None] | None = None,
    **changed: Any,
) -> Comparison:
    """Compare candidate clouds with a reference: register, measure in both directions, map, and test for deformation.

    Args:
        reference: a cloud, an (N, 3) array, a mesh, or the path of a file with a cloud or a mesh. A mesh is sampled
            uniformly by area, with the normals of its faces.
        candidates: one cloud, (N, 3) array, mesh or path; several; or several by name. A file's name is its stem. A
            mesh is sampled too, more densely than the reference's points, or measured at its `vertices`.
        settings: the settings; default: `pcbench.Settings()`.
        scene: a scene with cameras in the coordinates of the reference, or its folder. They show which way is up and
            select the views of pictures; no metric depends on them. A report records a folder, not a `Scene`.
        tiling: compute in tiles, for clouds that do not fit into memory; all clouds must be paths. None: in memory.
        workspace: folder for sorted copies and finished tiles, from which the same call continues after a failure;
            None: one in the system's temporary folder.
        on_step: called with a short text before each step that takes time.
        changed: settings by name that replace those of `settings`: `compare(a, b, register="similarity", seed=1)`.

    Returns:
        The comparison. Warnings of file readers are in its `inputs`, and are also given by `warnings.warn`.

    Raises:
        InputError: a file, a cloud, a setting or a region is invalid; or the scene has no cameras that see the
            reference.
        RegistrationError: a candidate does not overlap the reference.
    """
    step = on_step or (lambda _: None)
    choice = None
    if tiling is not None:
        choice = TilingChoice(tiling, workspace=None if workspace is None else Path(workspace))
    request = Request.of(reference, candidates, with_changes(settings, changed), scene=scene, tiles=choice)
    if tiling is not None and not request.are_files:
        raise InputError("expected the paths of all clouds to compare in tiles, got a cloud in memory")
    outcome = run(request, step=step, on_notice=step)
    for text in outcome.reader_warnings:
        warnings.warn(text, stacklevel=2)
    return outcome.comparison


def run(
    request: Request,
    outputs: Outputs | None = None,
    *,
    step: Callable[[str], None] = lambda _: None,
    on_notice: Callable[[str], None] = lambda _: None,
    on_comparison: Callable[[Comparison], None] = lambda _: None,
) -> ComparisonOutcome:
    """Compute a comparison and write its report.

    Args:
        request: the inputs and settings.
        outputs: what is written; None: nothing.
        step: called with a short text before each step that takes time.
        on_notice: called with one line if the size of the clouds decides that they are compared in tiles, and if files
            of a run are kept or removed.
        on_comparison: called with the comparison before its report is written, which takes longest for the pictures.

    Raises:
        PcbenchError, OSError: an input, a setting or an output is invalid; nothing was written.
    """
    outputs = outputs or Outputs()
    if request.tiles is not None:
        step("reading the headers")
    clouds = choose_tiles(request, on_notice, draws=outputs.folder is not None and outputs.figures)
    plan = ProgressPlan(step, _expected_seconds(request, outputs, clouds))
    with _workspace(request, clouds, outputs.folder, on_notice) as workspace:  # kept until the report is complete
        if outputs.folder is None:
            outcome = _compute(request, plan, workspace)
            on_comparison(outcome.comparison)
            return outcome
        with report_folder(outputs.folder, keep=request.files) as folder:
            outcome = _compute(request, plan, workspace, folder / MAPS)
            on_comparison(outcome.comparison)
            plan("writing the report")
            outcome = replace(outcome, without_page=write_report(folder, outcome.comparison, request.figures))
            if outputs.figures:
                plan("drawing the pictures")
                outcome = replace(outcome, without_figures=draw_if_possible(folder, figures=request.figures).problem)
    return outcome


class _Workspace(NamedTuple):
    """The locked workspace of a tiled comparison: its folder, the key of the comparison, and the clouds."""

    folder: Path
    key: str
    clouds: CloudsOnDisk


@contextmanager
def _workspace(
    request: Request, clouds: CloudsOnDisk | None, out: Path | None, on_notice: Callable[[str], None]
) -> Iterator[_Workspace | None]:
    """Yield the locked workspace of a tiled comparison; None if it is computed in memory."""
    if clouds is None or request.tiles is None:
        yield None
        return
    key = clouds.key(request.settings, request.tiles.settings)
    folders = default_workspaces(out, key) if request.tiles.workspace is None else [request.tiles.workspace]
    folder = folders[0]  # the others have the same parent
    if out is not None and _overlap(out, folder):
        raise InputError(
            f"{folder}: the workspace is removed at the end, so that it cannot contain the report ({out}) or lie in"
            " it: choose another folder"
        )
    for path in request.files:
        if path.resolve().is_relative_to(folder.resolve()):
            raise InputError(f"{folder}: the workspace would replace the input {path}: choose another folder")
    with first_free_workspace(folders, key, on_notice) as workspace:
        yield _Workspace(workspace, key, clouds)


def _overlap(one: Path, other: Path) -> bool:
    """Return whether one of two folders is in the other."""
    paths = one.resolve(), other.resolve()
    return paths[0].is_relative_to(paths[1]) or paths[1].is_relative_to(paths[0])


def _compute(
    request: Request, step: ProgressPlan, workspace: _Workspace | None, map_files: Path | None = None
) -> ComparisonOutcome:
    """Compare in memory, or in tiles in a workspace.

    Args:
        request: the comparison.
        step: called before each step.
        workspace: workspace of a comparison in tiles; None: in memory.
        map_files: folder for the map files of a tiled comparison; None: there is no report.
    """
    texts: tuple[str, ...] = ()
    if workspace is None:
        comparison, texts = _compute_in_memory(request, step)
    else:
        comparison = _compute_in_tiles(request, step, workspace, map_files)
    comparison = with_check_points(request, comparison, step)
    for file in request.setting_files:
        if digest(Path(file.path)) != file.sha256:
            raise changed_error(Path(file.path))
    if comparison.inputs is None:
        return ComparisonOutcome(comparison, texts)
    inputs = _with_changed_inputs(request, comparison, comparison.inputs)
    texts = tuple(text for file in inputs.all_files() for text in file.warnings)
    return ComparisonOutcome(replace(comparison, inputs=inputs), texts)


def _compute_in_memory(request: Request, step: ProgressPlan) -> tuple[Comparison, tuple[str, ...]]:
    """Read the inputs and compare them; also return the warnings that have no input file to be recorded with."""
    reference, reference_file = _read(request.reference, step)
    cameras, texts = None, list[str]()
    if request.scene is not None:
        step("reading the cameras")
        cameras = viewing_cameras(request.scene, reference, texts.append)
    candidates, files = {}, {}
    for name, given in request.candidates.items():
        candidates[name], file = _read(given, step)
        if file is not None:
            files[name] = file
    reference, candidates = _without_transparent_splats(reference, candidates, request.settings)
    comparison = compare_in_memory(reference, candidates, request.settings, step.within())
    if reference_file is None or files.keys() != candidates.keys():  # a cloud came from memory
        return replace(comparison, cameras=cameras), tuple(texts)
    reference_file = replace(reference_file, warnings=(*reference_file.warnings, *texts))
    return replace(comparison, inputs=_inputs(request, reference_file, files, None), cameras=cameras), ()


def _compute_in_tiles(
    request: Request, step: ProgressPlan, workspace: _Workspace, map_files: Path | None
) -> Comparison:
    """Compare clouds on disk in tiles."""
    from pcbench.comparison.in_tiles import compare_in_tiles

    assert request.tiles is not None
    reference, candidates = workspace.clouds.input_files()
    maps = None if map_files is None else workspace.folder / MAPS
    comparison = compare_in_tiles(
        workspace.clouds,
        request.settings,
        request.tiles.settings,
        key=workspace.key,
        workspace=workspace.folder,
        maps=maps,
        on_step=step.within(),
    )
    cameras = None
    if request.scene is not None:
        sample, texts = comparison.candidates[0].completeness.points, list[str]()
        try:
            cameras = viewing_cameras(request.scene, Cloud(sample, crs=comparison.reference.crs), texts.append)
        except InputError as error:  # hours of computing do not depend on the views
            texts.append(str(error))
        reference = replace(reference, warnings=(*reference.warnings, *texts))
    has_map_files = maps is not None and map_files is not None and _link_maps(maps, map_files)
    inputs = _inputs(request, reference, candidates, request.tiles.settings)
    return replace(comparison, inputs=inputs, cameras=cameras, has_map_files=has_map_files)


def _read(given: Input, step: Callable[[str], None]) -> tuple[Cloud | Mesh, InputFile | None]:
    """Return a shape, and the record of its file if it is read from one.

    Raises:
        InputError: the file cannot be read, or its coordinates are no lengths. The message starts with the path.
        PcbenchError: the file changed while it was read.
    """
    if not isinstance(given, Source):
        return given, None
    step(f"reading {given.path}")
    texts: list[str] = []
    shape, sha256 = given.read_with_digest(texts.append)
    check_lengths(shape, str(given.path))
    return shape, InputFile(str(given.path), sha256, tuple(texts), StatedSystem.of(shape.crs, shape.unit))


def _inputs(
    request: Request, reference: InputFile, candidates: Mapping[str, InputFile], tiling: TilingSettings | None
) -> Inputs:
    """Return the records of all input files, and how the comparison was computed in tiles, if it was."""
    scene = request.scene if isinstance(request.scene, SceneFolder) else None
    return Inputs(reference, candidates, request.setting_files, scene, tiling)


def _without_transparent_splats(
    reference: Cloud | Mesh, candidates: dict[str, Cloud | Mesh], settings: Settings
) -> tuple[Cloud | Mesh, dict[str, Cloud | Mesh]]:
    """Return the clouds, with models of Gaussian splats filtered by opacity and largest axis.

    Raises:
        InputError: the settings filter splats, but no cloud is a splat model; or a filtered model has no splat.
    """
    limits = settings.min_opacity, settings.max_axis
    if limits == (None, None):
        return reference, candidates
    if not any(_is_splat_model(cloud) for cloud in (reference, *candidates.values())):
        raise InputError(
            "a minimum opacity and a maximum axis filter Gaussian splats, but none of the clouds is a splat model"
        )

    def filtered(name: str, cloud: Cloud | Mesh) -> Cloud | Mesh:
        try:
            return filter_splats(cloud, *limits) if isinstance(cloud, Cloud) and _is_splat_model(cloud) else cloud
        except InputError as error:
            raise InputError(f"{name}: {error}") from error

    return filtered("the reference", reference), {name: filtered(name, cloud) for name, cloud in candidates.items()}


def _is_splat_model(cloud: Cloud | Mesh) -> bool:
    return isinstance(cloud, Cloud) and splat_model(cloud) is not None


def _with_changed_inputs(request: Request, comparison: Comparison, inputs: Inputs) -> Inputs:
    """Return the inputs with a warning for each that has changed since its settings were written."""

    def checked(file: InputFile) -> InputFile:
        if request.recorded.digests.get(file.path, file.sha256) == file.sha256:
            return file
        text = f"{file.path}: the file has changed since the settings were written"
        return replace(file, warnings=(*file.warnings, text))

    reference, *files = (checked(file) for file in (inputs.reference, *inputs.files))
    texts = [text for file in files for text in file.warnings]
    if isinstance(request.scene, ViewingCameras):
        texts.append(f"the scene no longer exists: the views follow the cameras in the report's {CAMERAS_FILE}")
    elif (recorded := request.recorded.cameras) and comparison.cameras and not comparison.cameras.equals(recorded):
        texts.append("the cameras of the scene have changed since the settings were written: the views may differ")
    return replace(
        inputs,
        reference=replace(reference, warnings=(*reference.warnings, *texts)),
        candidates={name: checked(file) for name, file in inputs.candidates.items()},
        files=tuple(files),
    )


def _expected_seconds(request: Request, outputs: Outputs, clouds: CloudsOnDisk | None) -> list[float]:
    """Return a rough duration of each announced step, in seconds, for the progress bar."""
    if clouds is not None:  # tiles estimate their own time
        writing = _WRITING_SAMPLES_S if outputs.folder is not None else 0.0
        checking = [] if request.settings.checkpoints is None else [sum(s.reading_seconds for s in request.sources)]
        return [0.0, *checking, writing, drawing_seconds(len(request.candidates))]
    reading = [source.reading_seconds for source in request.sources]
    total = sum(reading) + reading[0] * max(len(reading) - 2, 0) if reading else 0.0  # of all pairs
    writing = total if outputs.folder is not None else 0.0
    scene = [] if request.scene is None else [0.5]
    measuring = 2.0 * len(request.candidates) + 20 * total
    checking = [] if request.settings.checkpoints is None else [sum(reading)]
    return [*reading[:1], *scene, *reading[1:], measuring, *checking, writing, drawing_seconds(len(request.candidates))]


def _link_maps(maps: Path, folder: Path) -> bool:
    """Put the map files of a workspace into a report folder, and return whether there are any.

    They are linked where the file system allows it, and copied elsewhere, so that the workspace stays complete until
    the report is.
    """
    if not maps.is_dir() or not any(maps.iterdir()):
        return False
    shutil.copytree(maps, folder, copy_function=_link)
    return True


def _link(source: str, target: str) -> str:
    try:
        os.link(source, target)
    except OSError:
        shutil.copy2(source, target)
    return target
