"""Read the clouds of a comparison, and record each input file for the report."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

from pcbench.errors import InputError
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.crs import check_lengths
from pcbench.geometry.mesh import Mesh
from pcbench.io.contents import changed_error, digest
from pcbench.io.files import errors_named, file_in_setting
from pcbench.io.las_records import parse_filters
from pcbench.io.source import Source
from pcbench.measure.m3c2_settings import M3C2Settings
from pcbench.measure.settings import Settings
from pcbench.report.inputs import InputFile, SceneFolder
from pcbench.report.viewing import ViewingCameras

if TYPE_CHECKING:
    from pcbench.scenes import Scene

SceneLike: TypeAlias = "Scene | str | os.PathLike[str]"
"""A scene, or the path of its folder."""


def read_input(path: Path, settings: Settings, *, vertices: bool = False) -> tuple[Cloud | Mesh, InputFile]:
    """Read the reference or a candidate of a comparison, a cloud or a mesh, and record its file.

    Args:
        path: path of the input.
        settings: settings of the comparison.
        vertices: whether a mesh is read as its vertices.

    Raises:
        InputError: the file cannot be read; the message starts with the path.
        MissingExtra: the format needs an optional library.
        PcbenchError: the file changed while it was read.
    """
    warnings: list[str] = []
    with errors_named(path):
        filters = parse_filters(settings.classes, settings.returns)
    shape, sha256 = Source.open(path, vertices=vertices).filtered(filters).read_with_digest(warnings.append)
    check_lengths(shape, str(path))
    return shape, InputFile(str(path), sha256, tuple(warnings))


def paths_in(settings: Settings) -> list[Path]:
    """Return the files named in settings, such as a matrix."""
    cores = settings.m3c2.file if isinstance(settings.m3c2, M3C2Settings) else None
    return [*filter(None, (file_in_setting(settings.register), file_in_setting(settings.crop), cores))]


def named_files(settings: Settings) -> tuple[InputFile, ...]:
    """Record the files named in settings."""
    return tuple(InputFile(str(path), digest(path)) for path in paths_in(settings))


def check_named_files(files: Iterable[InputFile]) -> None:
    """Check that files named in settings have not changed since they were recorded.

    Raises:
        PcbenchError: one has.
    """
    for file in files:
        if digest(Path(file.path)) != file.sha256:
            raise changed_error(Path(file.path))


def as_scene(scene: SceneLike) -> Scene | SceneFolder:
    """Return a scene, or its folder.

    Raises:
        InputError: the argument is neither.
    """
    if isinstance(scene, str | os.PathLike):
        return SceneFolder(Path(scene))
    from pcbench.scenes import Scene

    if not isinstance(scene, Scene):
        raise InputError(f"expected a scene or the path of its folder, got {type(scene).__name__}")
    return scene


def viewing_cameras(
    scene: Scene | SceneFolder | ViewingCameras, shown: Cloud | Mesh, on_warning: Callable[[str], None]
) -> ViewingCameras:
    """Return the cameras of a scene for the views of a cloud or a mesh, read from its folder if necessary.

    Raises:
        InputError: the scene cannot be read, has no cameras, or none of them sees it.
    """
    if isinstance(scene, ViewingCameras):
        return scene
    if isinstance(scene, SceneFolder):
        from pcbench.scenes import read_scene

        scene = read_scene(scene.path, cameras=scene.cameras, on_warning=on_warning)
    if not scene.cameras:
        raise InputError(
            f"{scene.folder}: expected a scene with cameras, got none: name their file or folder (--cameras)"
        )
    z_is_up = shown.crs is not None or scene.origin is not None
    cameras = ViewingCameras.of(scene.cameras.values(), z_is_up=z_is_up)
    try:
        cameras.check_sight(shown.vertices if isinstance(shown, Mesh) else shown.points)
    except InputError as error:
        raise InputError(f"{scene.folder}: {error}") from error
    return cameras
