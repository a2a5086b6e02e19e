"""Compare files and write the report folder; a failed run writes nothing."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TypeVar

from pcbench.errors import InputError
from pcbench.io.files import estimate_reading_seconds, file_in_setting, input_files
from pcbench.measure.m3c2_settings import M3C2Settings
from pcbench.measure.settings import Settings
from pcbench.progress import ProgressPlan
from pcbench.report.comparison import Comparison, compare_inputs, compare_tiled
from pcbench.report.figures import Figures, recorded_figures
from pcbench.report.folder import read_settings, report_folder, write_report
from pcbench.report.inputs import InputFile, SceneFolder
from pcbench.report.manifest import MAPS
from pcbench.report.names import names_of
from pcbench.report.on_disk import CloudsOnDisk, TilingChoice, choose_tiles, filters_for, link_maps
from pcbench.report.plot import draw_if_possible, drawing_seconds
from pcbench.report.reading import paths_in
from pcbench.report.viewing import CAMERAS_FILE, ViewingCameras
from pcbench.report.workspace import default_workspaces, first_free_workspace

_FORMER_PREFIX = "parts:"  # of digests of earlier versions, which left out the middle of files
_WRITING_SAMPLES_S = 5.0  # writing the report of a tiled comparison, whose maps are samples
_Setting = TypeVar("_Setting")


@dataclass(frozen=True)
class ComparisonJob:
    """The files and settings of a comparison.

    Attributes:
        reference: path of the reference.
        candidates: path of each candidate, by name.
        settings: the settings.
        expected: recorded SHA-256 of files, by absolute path.
        figures: appearance of the pictures.
        scene: the scene whose cameras select the views, if any; or its cameras, if its folder no longer exists.
        recorded_cameras: the cameras in the report that is repeated, if any.
        tiles: when and how the comparison is computed in tiles; None: in memory.
    """

    reference: Path
    candidates: dict[str, Path]
    settings: Settings
    expected: dict[str, str]
    figures: Figures = field(default_factory=Figures)
    scene: SceneFolder | ViewingCameras | None = None
    recorded_cameras: ViewingCameras | None = None
    tiles: TilingChoice | None = None

    @property
    def inputs(self) -> list[Path]:
        """The input files: the clouds, the files named in settings, and the scene."""
        scene = self.scene.paths() if isinstance(self.scene, SceneFolder) else []
        return [self.reference, *self.candidates.values(), *paths_in(self.settings), *scene]

    @classmethod
    def of(
        cls,
        reference: Path,
        candidates: Sequence[Path],
        settings: Settings,
        figures: Figures | None = None,
        scene: SceneFolder | None = None,
        tiles: TilingChoice | None = None,
    ) -> ComparisonJob:
        """Return the job for files; candidates are named after their files."""
        named = dict(zip(names_of(candidates), candidates, strict=True))
        return cls(reference, named, settings, {}, figures or Figures(), scene, None, tiles)

    @classmethod
    def from_settings_file(cls, settings_file: Path) -> ComparisonJob:
        """Return the job that a report's settings.json describes."""
        settings, inputs = read_settings(settings_file)
        candidates = {name: Path(file.path) for name, file in inputs.candidates.items()}
        expected = {file.path: file.sha256 for file in inputs.all_files()}
        figures = recorded_figures(settings_file)
        scene: SceneFolder | ViewingCameras | None = inputs.scene
        file, recorded = settings_file.parent / CAMERAS_FILE, None
        if inputs.scene is not None and file.is_file():
            recorded = ViewingCameras.read(file)
            scene = inputs.scene if inputs.scene.path.exists() else recorded
        tiles = None if inputs.tiling is None else TilingChoice(inputs.tiling)
        return cls(Path(inputs.reference.path), candidates, settings, expected, figures, scene, recorded, tiles)

    def with_tiles(self, choice: TilingChoice) -> ComparisonJob:
        """Return a job of a settings.json with another choice of tiles, except for settings that change the numbers."""
        if self.tiles is None:
            return replace(self, tiles=choice)
        recorded, given = self.tiles.settings, choice.settings
        settings = replace(
            recorded,
            tile_points=given.tile_points or recorded.tile_points,
            memory=given.memory,
            workers=given.workers,
            cluster=given.cluster,
        )
        return replace(self, tiles=TilingChoice(settings, "always", choice.workspace))


@dataclass(frozen=True)
class Outputs:
    """The outputs of a comparison: a report folder, if any, and whether to draw pictures."""

    folder: Path | None = None
    figures: bool = True


@dataclass(frozen=True, eq=False)
class ComparisonOutcome:
    """A comparison, and the reasons why its page or its pictures could not be made, if any."""

    comparison: Comparison
    without_page: str | None = None
    without_figures: str | None = None


def compare_files(
    job: ComparisonJob,
    outputs: Outputs,
    step: Callable[[str], None],
    on_notice: Callable[[str], None] = lambda _: None,
) -> ComparisonOutcome:
    """Compare files and write the report.

    Args:
        job: the files and settings.
        outputs: what is written.
        step: called with a short text before each step that takes time.
        on_notice: called with one line if the size of the clouds decides that they are compared in tiles, and if files
            of a run are kept or removed.

    Raises:
        PcbenchError, OSError: an input, a setting or an output is invalid; nothing was written.
    """
    settings = replace(job.settings, register=_absolute(job.settings.register), crop=_absolute(job.settings.crop))
    if isinstance(settings.m3c2, M3C2Settings):
        settings = replace(settings, m3c2=settings.m3c2.absolute())
    paths = [job.reference, *job.candidates.values()]
    if (settings.classes or settings.returns) and not any(filters_for(path, settings) for path in paths):
        raise InputError("--classes and --returns filter LAS files, but none of the clouds is a LAS file")
    clouds = None
    if job.tiles is not None:
        step("reading the headers")
        draws = outputs.folder is not None and outputs.figures
        clouds = choose_tiles(job.reference, job.candidates, settings, job.tiles, on_notice, draws=draws)
    plan = ProgressPlan(step, _expected_seconds(job, outputs, clouds))
    with _workspace(job, settings, clouds, outputs.folder, on_notice) as workspace:  # kept until the report is complete
        if outputs.folder is None:
            return ComparisonOutcome(_run(job, settings, plan, clouds, workspace))
        with report_folder(outputs.folder, keep=job.inputs) as folder:
            comparison = _run(job, settings, plan, clouds, workspace, folder / MAPS)
            plan("writing the report")
            outcome = ComparisonOutcome(comparison, without_page=write_report(folder, comparison, job.figures))
            if outputs.figures:
                plan("drawing the pictures")
                outcome = replace(outcome, without_figures=draw_if_possible(folder, figures=job.figures).problem)
    return outcome


@contextmanager
def _workspace(
    job: ComparisonJob,
    settings: Settings,
    clouds: CloudsOnDisk | None,
    out: Path | None,
    on_notice: Callable[[str], None],
) -> Iterator[Path | None]:
    """Yield the locked workspace of a tiled comparison; None if it is computed in memory."""
    if clouds is None or job.tiles is None:
        yield None
        return
    key = clouds.key(settings, job.tiles.settings)
    folders = default_workspaces(out, key) if job.tiles.workspace is None else [job.tiles.workspace]
    folder = folders[0]  # the others have the same parent
    for path in (file for named in job.inputs for file in input_files(named)):
        if path.resolve().is_relative_to(folder.resolve()):
            raise InputError(f"{folder}: the workspace would replace the input {path}: choose another folder")
    with first_free_workspace(folders, key, on_notice) as workspace:
        yield workspace


def _run(
    job: ComparisonJob,
    settings: Settings,
    step: ProgressPlan,
    clouds: CloudsOnDisk | None,
    workspace: Path | None,
    map_files: Path | None = None,
) -> Comparison:
    """Compare in memory, or in tiles in a workspace.

    Args:
        job: the files.
        settings: settings with absolute paths.
        step: called before each step.
        clouds: the clouds to compare in tiles; None: in memory.
        workspace: folder for the intermediate files of tiles.
        map_files: folder for the map files of a tiled comparison; None: there is no report.
    """
    if clouds is None or workspace is None or job.tiles is None:
        return _with_changes(job, compare_inputs(job.reference, job.candidates, settings, step, job.scene))
    maps = None if map_files is None else workspace / MAPS
    tiling = job.tiles.settings
    measured = compare_tiled(clouds, settings, tiling, step, workspace=workspace, maps=maps, scene=job.scene)
    if maps is not None and map_files is not None:
        measured = replace(measured, has_map_files=link_maps(maps, map_files))
    return _with_changes(job, measured)


def _with_changes(job: ComparisonJob, measured: Comparison) -> Comparison:
    """Return the comparison with a warning for each input that has changed since its settings were written."""
    assert measured.inputs is not None  # all clouds come from files
    inputs = measured.inputs
    reference, *files = (_with_change(job, file) for file in (inputs.reference, *inputs.files))
    warnings = [text for file in files for text in file.warnings]
    if isinstance(job.scene, ViewingCameras):
        warnings.append(f"the scene no longer exists: the views follow the cameras in the report's {CAMERAS_FILE}")
    elif job.recorded_cameras and measured.cameras and not measured.cameras.equals(job.recorded_cameras):
        warnings.append("the cameras of the scene have changed since the settings were written: the views may differ")
    reference = replace(reference, warnings=(*reference.warnings, *warnings))
    candidates = {name: _with_change(job, file) for name, file in inputs.candidates.items()}
    return replace(measured, inputs=replace(inputs, reference=reference, candidates=candidates, files=tuple(files)))


def _with_change(job: ComparisonJob, file: InputFile) -> InputFile:
    """Return the file, with a warning if its content differs from the recorded one."""
    recorded = job.expected.get(file.path, file.sha256)
    if recorded == file.sha256 or recorded.startswith(_FORMER_PREFIX):
        return file
    return replace(
        file, warnings=(*file.warnings, f"{file.path}: the file has changed since the settings were written")
    )


def _expected_seconds(job: ComparisonJob, outputs: Outputs, clouds: CloudsOnDisk | None) -> list[float]:
    """Return a rough duration of each announced step, in seconds, for the progress bar."""
    if clouds is not None:  # tiles estimate their own time
        return [0.0, _WRITING_SAMPLES_S if outputs.folder is not None else 0.0, drawing_seconds(len(job.candidates))]
    reading = [estimate_reading_seconds(path) for path in (job.reference, *job.candidates.values())]
    pairs = [reading[0] + seconds for seconds in reading[1:]]
    writing = sum(pairs) if outputs.folder is not None else 0.0
    scene = [] if job.scene is None else [0.5]
    measuring = sum(2.0 + 20 * pair for pair in pairs)
    return [*reading[:1], *scene, *reading[1:], measuring, writing, drawing_seconds(len(pairs))]


def _absolute(setting: _Setting) -> _Setting | str:
    """Make the path in a text such as `matrix:FILE` absolute."""
    file = file_in_setting(setting)
    if file is None or not isinstance(setting, str):
        return setting
    return f"{setting.partition(':')[0]}:{file.absolute()}"
