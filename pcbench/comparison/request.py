"""Requests for comparisons: the opened inputs, the settings, and the scene whose cameras select the views."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from pcbench.errors import InputError
from pcbench.geometry.cloud import Cloud, as_cloud
from pcbench.geometry.mesh import Mesh
from pcbench.io import CloudLike, is_path
from pcbench.io.contents import digest
from pcbench.io.files import errors_named
from pcbench.io.las_records import parse_filters
from pcbench.io.named_code import code_file
from pcbench.io.source import Source
from pcbench.measure.own_metrics import OwnMetric, metric_name
from pcbench.measure.settings import Settings
from pcbench.measure.tiled.settings import TilingSettings
from pcbench.report.figures import Figures, recorded_figures
from pcbench.report.folder import read_settings
from pcbench.report.inputs import InputFile
from pcbench.report.names import names_of
from pcbench.report.viewing import CAMERAS_FILE, SceneFolder, SceneLike, ViewingCameras, as_scene

if TYPE_CHECKING:
    from pcbench.scenes import Scene

Input = Source | Cloud | Mesh
"""A file, or a shape in memory."""
When = Literal["always", "auto", "if-possible"]


@dataclass(frozen=True)
class TilingChoice:
    """How a comparison is computed in tiles, and when.

    Attributes:
        settings: settings of a tiled comparison.
        when: `always`; `auto`: if the clouds do not fit into the memory; `if-possible`: likewise, but in memory if
            tiles do not support a setting.
        workspace: folder for intermediate files; None: a hidden one, see `pcbench.comparison.workspace`.
    """

    settings: TilingSettings = field(default_factory=TilingSettings)
    when: When = "always"
    workspace: Path | None = None

    @classmethod
    def of(cls, settings: TilingSettings, workspace: Path | None, *, is_auto: bool) -> TilingChoice:
        """Return the choice for settings: always tiles if one of them says more than the memory and the workers.

        Args:
            settings: settings of a tiled comparison.
            workspace: folder for intermediate files, if one is given.
            is_auto: whether the user asked for tiles if the clouds need them.
        """
        needs_tiles = (
            settings.tile_points is not None
            or settings.cluster is not None
            or settings.max_distance is not None
            or settings.skip_bad
        )
        return cls(settings, "always" if needs_tiles else "auto" if is_auto else "if-possible", workspace)


@dataclass(frozen=True)
class Recorded:
    """Facts about the inputs that the settings.json of a repeated comparison records.

    Attributes:
        digests: SHA-256 of files, by path.
        cameras: the cameras in the report, if it has some.
    """

    digests: Mapping[str, str] = field(default_factory=dict)
    cameras: ViewingCameras | None = None


@dataclass(frozen=True, eq=False)
class Request:
    """A comparison: its inputs and settings.

    Attributes:
        reference: the reference.
        candidates: the candidates by name, at least one.
        settings: the settings, with the methods and regions that files describe.
        figures: appearance of the pictures.
        scene: the scene whose cameras select the views, or its folder; or its cameras, if the folder no longer exists.
        tiles: when and how the comparison is computed in tiles; None: in memory.
        recorded: what is known of the inputs if a comparison is repeated.
        setting_files: the files named in settings, recorded before they were read.
    """

    reference: Input
    candidates: Mapping[str, Input]
    settings: Settings
    figures: Figures = field(default_factory=Figures)
    scene: Scene | SceneFolder | ViewingCameras | None = None
    tiles: TilingChoice | None = None
    recorded: Recorded = field(default_factory=Recorded)
    setting_files: tuple[InputFile, ...] = ()

    @classmethod
    def of(
        cls,
        reference: Mesh | CloudLike,
        candidates: Sequence[Mesh | CloudLike] | Mapping[str, Any] | Mesh | CloudLike,
        settings: Settings,
        *,
        figures: Figures | None = None,
        scene: SceneLike | SceneFolder | None = None,
        tiles: TilingChoice | None = None,
    ) -> Request:
        """Open the inputs of a comparison; paths and candidates as in `pcbench.compare`.

        Raises:
            InputError: a file cannot be opened, a setting or its file is invalid, or LAS filters fit no input.
        """
        named = _by_name(candidates)
        setting_files = tuple(InputFile(str(path.absolute()), digest(path)) for path in settings.files)
        settings = settings.with_files_read()
        if not named:
            raise InputError("expected at least one candidate, got none")
        request = cls(
            _open(reference, settings),
            {name: _open(given, settings, vertices=settings.vertices) for name, given in named.items()},
            settings,
            figures or Figures(),
            None if scene is None else as_scene(scene),
            tiles,
            setting_files=setting_files,
        )
        wants_classes = settings.classes is not None or settings.returns is not None
        if wants_classes and request.sources and not any(source.has_classes for source in request.sources):
            raise InputError("--classes and --returns filter LAS files, but none of the clouds is a LAS file")
        if settings.samples is not None and not any(map(_is_mesh, (request.reference, *request.candidates.values()))):
            raise InputError("--sample samples points on meshes, but none of the inputs is a mesh: leave it out")
        return request

    @classmethod
    def repeat(cls, settings_file: Path, metrics: Sequence[str] = ()) -> Request:
        """Return the request that a report's settings.json describes.

        Args:
            settings_file: the file.
            metrics: user-defined metrics that may be run. The file may come from somebody else, so it does not suffice.

        Raises:
            InputError: the file is damaged, or names other metrics; or as `of`.
        """
        settings, inputs = read_settings(settings_file)
        _check_permitted(settings_file, settings.own_metrics, metrics)
        scene: SceneFolder | ViewingCameras | None = inputs.scene
        cameras_file, cameras = settings_file.parent / CAMERAS_FILE, None
        if inputs.scene is not None and cameras_file.is_file():
            cameras = ViewingCameras.read(cameras_file)
            scene = inputs.scene if inputs.scene.path.exists() else cameras
        request = cls.of(
            inputs.reference.path,
            {name: file.path for name, file in inputs.candidates.items()},
            settings,
            figures=recorded_figures(settings_file),
            tiles=None if inputs.tiling is None else TilingChoice(inputs.tiling),
        )
        digests = {file.path: file.sha256 for file in inputs.all_files()}
        return replace(request, scene=scene, recorded=Recorded(digests, cameras))

    def with_outputs(self, tiles: TilingChoice, scene: SceneFolder | None) -> Request:
        """Return a repeated request with other views, and another choice of tiles that does not change its numbers.

        Args:
            tiles: the new choice; of recorded tiles, only the size, the memory and the workers are replaced.
            scene: folder of the scene that selects the views; None: the recorded one.
        """
        if self.tiles is not None:
            given = tiles.settings
            settings = replace(
                self.tiles.settings,
                tile_points=given.tile_points or self.tiles.settings.tile_points,
                memory=given.memory,
                workers=given.workers,
                cluster=given.cluster,
            )
            tiles = TilingChoice(settings, "always", tiles.workspace)
        if scene is None:
            return replace(self, tiles=tiles)
        return replace(self, tiles=tiles, scene=scene, recorded=replace(self.recorded, cameras=None))

    @property
    def sources(self) -> list[Source]:
        """The inputs that are files: the reference first, then the candidates."""
        return [given for given in (self.reference, *self.candidates.values()) if isinstance(given, Source)]

    @property
    def are_files(self) -> bool:
        """Return whether all clouds are files, so that a report can repeat the comparison."""
        return len(self.sources) == 1 + len(self.candidates)

    @property
    def files(self) -> list[Path]:
        """All input files: of the clouds, those named in settings, and the folder of the scene."""
        clouds = [file for source in self.sources for file in source.files]
        scene = self.scene.paths() if isinstance(self.scene, SceneFolder) else []
        return [*clouds, *self.settings.files, *scene]


def _check_permitted(settings_file: Path, recorded: Sequence[str | OwnMetric], permitted: Sequence[str]) -> None:
    """Check that the user names the metrics whose code settings.json would run."""

    def absolute(spec: str) -> str:
        file = code_file(spec)
        return spec if file is None else f"{file.absolute()}:{metric_name(spec)}"

    texts = [metric if isinstance(metric, str) else metric.text for metric in recorded]
    if sorted(texts) != sorted(map(absolute, permitted)):
        needed = " ".join(f"--metric {shlex.quote(text)}" for text in texts)
        raise InputError(
            f"{settings_file}: it names metrics whose code would run: if you trust them, add {needed}"
            if texts
            else f"{settings_file}: expected no --metric, because the comparison had none"
        )


def _open(given: Any, settings: Settings, *, vertices: bool = False) -> Input:
    """Open a file, or return a shape in memory."""
    if is_path(given):
        source = Source.open(given, vertices=vertices)
        if not source.has_classes:
            return source
        with errors_named(source.path):
            return source.filtered(parse_filters(settings.classes, settings.returns))
    return given if isinstance(given, Mesh) else as_cloud(given)


def _is_mesh(given: Input) -> bool:
    return given.kind == "mesh" if isinstance(given, Source) else isinstance(given, Mesh)


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
