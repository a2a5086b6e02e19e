"""`pcbench.compare` and `Comparison`: a measured comparison that can be saved as a report and shown in notebooks."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pcbench.errors import InputError
from pcbench.geometry.cloud import Cloud, as_cloud
from pcbench.geometry.mesh import Mesh
from pcbench.geometry.splats import filter_splats, splat_model
from pcbench.io import CloudLike, is_path
from pcbench.measure import comparison, results
from pcbench.measure.settings import Settings, with_changes
from pcbench.measure.tiled.settings import TilingSettings
from pcbench.progress import ProgressPlan
from pcbench.report import exports, plot
from pcbench.report.figures import WINDOW_SIZE, Figures
from pcbench.report.folder import report_folder, write_report
from pcbench.report.inputs import InputFile, Inputs, SceneFolder, SourcedComparison
from pcbench.report.names import names_of
from pcbench.report.on_disk import CloudsOnDisk, TilingChoice, choose_tiles
from pcbench.report.reading import (
    SceneLike,
    as_scene,
    check_named_files,
    named_files,
    read_input,
    viewing_cameras,
)
from pcbench.report.table import html
from pcbench.report.viewing import ViewingCameras
from pcbench.report.workspace import default_workspaces, first_free_workspace

if TYPE_CHECKING:
    from pcbench.scenes import Scene


@dataclass(frozen=True, eq=False, repr=False)
class Comparison(SourcedComparison):
    """A reference, its candidates, and the differences between them; `comparison["a"]` is the candidate named a.

    Attributes:
        inputs: the input files; None if a cloud came from memory.
        cameras: the cameras of the scene, which select the views; None if unknown.
        has_map_files: whether the folder `maps` of the report has the deviation maps of all points.
    """

    @classmethod
    def of(
        cls,
        measured: results.CandidateComparisons,
        inputs: Inputs | None = None,
        cameras: ViewingCameras | None = None,
    ) -> Comparison:
        """Return a measured comparison with its input files and the cameras of its scene."""
        return cls(
            measured.settings,
            measured.reference,
            measured.candidates,
            measured.differences,
            measured.tiling,
            inputs,
            cameras,
        )

    def save(self, folder: str | Path, *, figures: bool | Figures = True) -> None:
        """Write a report: report.html, comparison.json, metrics.csv, table.md, deviation clouds, matrices and pictures.

        Args:
            folder: the folder, created if necessary. A report in it is replaced.
            figures: whether to draw pictures, or their appearance. If these or the page cannot be made, a warning says
                why, and everything else is written.

        Raises:
            InputError: the folder has other files, or an input of the comparison; or a candidate's name cannot be part
                of file names.
            OSError: the folder cannot be written.
        """
        with report_folder(Path(folder), keep=[] if self.inputs is None else self.inputs.paths()) as scratch:
            style = figures if isinstance(figures, Figures) else Figures()
            problems = [write_report(scratch, self, style)]
            problems += [plot.draw_if_possible(scratch, figures=style).problem] if figures else []
        for problem in filter(None, problems):
            warnings.warn(problem, stacklevel=2)

    def plot(
        self,
        name: str | None = None,
        scalar: str = "plane_distance",
        *,
        range: float | None = None,
        off_screen: bool | None = None,
        window_size: tuple[int, int] = WINDOW_SIZE,
        background: str = "dark",
        lighting: bool = True,
    ) -> Any:
        """Return a plotter of one candidate, with the frame and the colour ranges of the report's pictures.

        Args:
            name: name of the candidate; None: the only one.
            scalar: a scalar of its deviation map, coloured, with the reference as a ghost; `m3c2_distance`;
                `completeness`: the reference, coloured by its distance to the candidate; or `deformation`: arrows.
            range: distance at which the colour range ends; default: as in the pictures. Not for `deformation`.
            off_screen: as in `pcbench.plot.cloud`.
            window_size: as in `pcbench.plot.cloud`.
            background: as in `pcbench.plot.cloud`.
            lighting: as in `pcbench.plot.cloud`.

        Returns:
            A `pyvista.Plotter` that is not yet shown: `.show()` opens a window, `.screenshot(file)` writes a picture.

        Raises:
            KeyError: no candidate has that name.
            InputError: the candidate has no such map or no displacements, an option is invalid, or there are several
                candidates and none is named.
            MissingExtra: pyvista is not installed.
            NoFiguresError: there is neither a display nor EGL nor OSMesa.
        """
        from pcbench.report.plot import maps
        from pcbench.report.plotters.candidates import CandidateMaps
        from pcbench.report.plotters.displacements import Displacements
        from pcbench.report.plotters.stage import Stage, Window

        if name is None:
            if len(self) > 1:
                raise InputError(f"expected the name of a candidate: {', '.join(c.name for c in self)}")
            name = self.candidates[0].name
        candidate, window = self[name], Window(off_screen, window_size, background, lighting)
        if scalar == "deformation":
            field = candidate.deformation.field
            if field is None or not field.displacements.any():
                raise InputError(f"{name}: no deformation was found, so there are no displacements")
            points = candidate.deviation.points
            shared = maps.frame(None, {name: Cloud(points)}, self.cameras)
            stage = Stage(shared, self.reference.unit, window)
            Displacements.of(name, points, field.places, field.displacements).show(stage)
            return stage.plotter
        measured = CandidateMaps.of_comparison(self, Figures(range=range).range)
        stage = measured.stage(name, scalar, window)
        measured.show(stage, name, scalar)
        return stage.plotter

    def to_dataframe(self) -> Any:
        """Return all metrics as a `pandas.DataFrame` with the columns of metrics.csv, one number per row.

        Raises:
            MissingExtra: pandas is not installed.
        """
        return exports.data_frame(self)

    def _repr_html_(self) -> str:
        """Return the table for a notebook."""
        return html(self)


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
    given, step = None if scene is None else as_scene(scene), on_step or (lambda _: None)
    settings = with_changes(settings, changed)
    if tiling is None:
        compared = compare_inputs(reference, candidates, settings, step, given)
    else:
        named = _by_name(candidates)
        if not is_path(reference) or not all(map(is_path, named.values())):
            raise InputError("expected the paths of all clouds to compare in tiles, got a cloud in memory")
        paths = {name: Path(path) for name, path in named.items()}
        choice = TilingChoice(tiling)
        clouds = choose_tiles(Path(reference), paths, settings, choice, step)
        assert clouds is not None  # it is always computed in tiles
        key = clouds.key(settings, tiling)
        folders = default_workspaces(None, key) if workspace is None else [Path(workspace)]
        with first_free_workspace(folders, key, step) as locked:
            compared = compare_tiled(clouds, settings, tiling, step, workspace=locked, maps=None, scene=given)
    for file in () if compared.inputs is None else compared.inputs.all_files():
        for text in file.warnings:
            warnings.warn(text, stacklevel=2)
    return compared


def compare_inputs(
    reference: Mesh | CloudLike,
    candidates: Sequence[Mesh | CloudLike] | Mapping[str, Any] | Mesh | CloudLike,
    settings: Settings,
    step: Callable[[str], None],
    scene: Scene | SceneFolder | ViewingCameras | None = None,
) -> Comparison:
    """Compare like `compare`, but only record the warnings of file readers, without `warnings.warn`.

    Args:
        reference: as in `compare`.
        candidates: as in `compare`.
        settings: the settings.
        step: called with a short text before each step that takes time.
        scene: the scene or its folder, as in `compare`, or its cameras.
    """
    files: dict[str, InputFile] = {}
    reference_file, setting_files = None, named_files(settings)
    if isinstance(reference, str | os.PathLike):
        step(f"reading {reference}")
        reference, reference_file = read_input(Path(reference), settings)
    cameras, scene_warnings = None, list[str]()
    if scene is not None:
        reference = reference if isinstance(reference, Mesh) else as_cloud(reference)
        step("reading the cameras")
        cameras = viewing_cameras(scene, reference, scene_warnings.append)
    named = _by_name(candidates)
    for name, given in named.items():
        if is_path(given):
            step(f"reading {given}")
            named[name], files[name] = read_input(Path(given), settings, vertices=settings.vertices)
    filtered, named = _without_transparent_splats(reference, named, settings)
    within = step.within() if isinstance(step, ProgressPlan) else step
    measured = comparison.compare(filtered, named, settings, on_step=within)
    check_named_files(setting_files)
    inputs = None
    if reference_file is not None and files.keys() == named.keys():  # all clouds came from files
        reference_file = replace(reference_file, warnings=(*reference_file.warnings, *scene_warnings))
        inputs = Inputs(reference_file, files, setting_files, scene if isinstance(scene, SceneFolder) else None)
    else:
        for text in scene_warnings:
            warnings.warn(text, stacklevel=3)
    return Comparison.of(measured, inputs, cameras)


def compare_tiled(
    clouds: CloudsOnDisk,
    settings: Settings,
    tiling: TilingSettings,
    step: Callable[[str], None],
    *,
    workspace: Path,
    maps: Path | None,
    scene: Scene | SceneFolder | ViewingCameras | None = None,
) -> Comparison:
    """Compare clouds on disk in tiles, like `compare_inputs` in memory.

    Args:
        clouds: the clouds.
        settings: the settings.
        tiling: settings of the tiles.
        step: called with a short text before each step that takes time.
        workspace: folder for intermediate files.
        maps: folder for the deviation maps of all points; None: they are not written.
        scene: the scene or its folder, as in `compare`, or its cameras.
    """
    from pcbench.measure.tiled.compare import compare_on_disk

    setting_files = named_files(settings)
    reference, candidates = clouds.input_files()
    measured = compare_on_disk(
        clouds.reference.path,
        {name: cloud.path for name, cloud in clouds.candidates.items()},
        settings,
        tiling,
        workspace=workspace,
        contents=clouds.contents,
        maps=maps,
        on_step=step.within() if isinstance(step, ProgressPlan) else step,
    )
    check_named_files(setting_files)
    cameras = None
    if scene is not None:
        sample, texts = measured.candidates[0].completeness.points, list[str]()
        try:
            cameras = viewing_cameras(scene, Cloud(sample, crs=measured.reference.crs), texts.append)
        except InputError as error:  # hours of computing do not depend on the views
            texts.append(str(error))
        reference = replace(reference, warnings=(*reference.warnings, *texts))
    folder = scene if isinstance(scene, SceneFolder) else None
    return Comparison.of(measured, Inputs(reference, candidates, setting_files, folder, tiling), cameras)


def _without_transparent_splats(
    reference: Any, candidates: dict[str, Any], settings: Settings
) -> tuple[Any, dict[str, Any]]:
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

    def filtered(name: str, cloud: Any) -> Any:
        try:
            return filter_splats(cloud, *limits) if _is_splat_model(cloud) else cloud
        except InputError as error:
            raise InputError(f"{name}: {error}") from error

    return filtered("the reference", reference), {name: filtered(name, cloud) for name, cloud in candidates.items()}


def _is_splat_model(cloud: Any) -> bool:
    return isinstance(cloud, Cloud) and splat_model(cloud) is not None


def _by_name(candidates: Any) -> dict[str, Any]:
    """Return candidates by name: the given name, the stem of the file, or a number."""
    if isinstance(candidates, Mapping):
        return dict(candidates)
    if isinstance(candidates, Cloud | Mesh | np.ndarray) or is_path(candidates):
        candidates = [candidates]
    if not isinstance(candidates, Sequence):
        raise InputError(f"expected one or several clouds as candidates, got {type(candidates).__name__}")
    stems = iter(names_of([Path(given) for given in candidates if is_path(given)]))
    names = [next(stems) if is_path(given) else f"candidate_{k}" for k, given in enumerate(candidates, 1)]
    if twice := [name for k, name in enumerate(names) if name in names[:k]]:
        raise InputError(f"two candidates are called {twice[0]!r}: pass them by name, as {{'name': cloud, ...}}")
    return dict(zip(names, candidates, strict=True))
