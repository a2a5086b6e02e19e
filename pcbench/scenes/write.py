"""A scene's cameras as files that other programs read."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

from pcbench.errors import InputError
from pcbench.geometry.cameras import Camera
from pcbench.geometry.cloud import Cloud
from pcbench.io.colmap_model import MODEL_FILES, check_model_output, write_colmap_model
from pcbench.io.files import check_output
from pcbench.io.transforms_json import write_transforms


def write_cameras(path: Path, cameras: Mapping[str, Camera], images: Path, points: Cloud | None = None) -> None:
    """Write cameras as transforms.json where `path` ends in .json, else into a folder as a COLMAP text model, with
    sparse points if there are some.

    Args:
        cameras: by image name.
        images: the folder of the images; a transforms.json names them by their way from its own folder.

    Raises:
        InputError: there are no cameras, or the folder holds a binary model.
        OSError: a file cannot be written.
    """
    if not cameras:
        raise InputError(f"{images}: no cameras to write: expected a COLMAP model, transforms.json or the like")
    ordered = [cameras[name] for name in sorted(cameras)]
    check_cameras_output(path)
    if path.suffix.lower() != ".json":
        write_colmap_model(path, ordered, points)
        return
    write_transforms(path, ordered, Path(os.path.relpath(images, path.absolute().parent)).as_posix())


def cameras_files(path: Path) -> list[Path]:
    """The files that `write_cameras` writes."""
    return [path] if path.suffix.lower() == ".json" else [path / name for name in MODEL_FILES]


def check_cameras_kept(path: Path, scene: Path, source: Path | None) -> None:
    """Say that `write_cameras` would replace cameras that were read.

    Args:
        scene: its folder.
        source: the file or folder that the cameras were read from, if it was named.

    Raises:
        InputError: a file that would be written exists and is of the scene's folder, or of the source.
    """
    for file in cameras_files(path):
        for given in (scene, source):
            if given is not None and file.exists() and file.resolve().is_relative_to(given.resolve()):
                raise InputError(f"{file}: belongs to {given}, and would be replaced: choose another place")


def check_cameras_output(path: Path, scene: Path | None = None) -> None:
    """Say before a long computation that cameras cannot be written there by `write_cameras`.

    Args:
        scene: a scene's folder that is to stay as it is.

    Raises:
        InputError: the folder of a .json does not exist, a model's folder is a file or holds a binary model, or the
            cameras would be written into the scene.
    """
    if path.suffix.lower() == ".json":
        check_output(path, ())
    else:
        check_model_output(path)
    if scene is not None and path.resolve().is_relative_to(scene.resolve()):
        raise InputError(f"{path}: the cameras would be written into the scene: choose another place")
