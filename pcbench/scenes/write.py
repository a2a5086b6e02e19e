"""Write the cameras of a scene in formats that other programs read."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

from pcbench.errors import InputError
from pcbench.geometry.cameras import Camera
from pcbench.geometry.cloud import Cloud
from pcbench.io.colmap_model import MODEL_FILES, check_model_output, write_colmap_model
from pcbench.io.outputs import check_output
from pcbench.io.transforms_json import write_transforms


def write_cameras(path: Path, cameras: Mapping[str, Camera], images: Path, points: Cloud | None = None) -> None:
    """Write cameras as transforms.json if `path` ends in .json, else as a COLMAP text model in a folder.

    Args:
        path: output file or folder.
        cameras: cameras by image name.
        images: folder of the images; a transforms.json refers to them relative to its own folder.
        points: sparse points of a COLMAP model.

    Raises:
        InputError: there are no cameras, or the folder contains a binary model.
        OSError: a file cannot be written.
    """
    if not cameras:
        raise InputError(f"{images}: expected cameras to write, got none: add a COLMAP model or a transforms.json")
    ordered = [cameras[name] for name in sorted(cameras)]
    check_cameras_output(path)
    if path.suffix.lower() != ".json":
        write_colmap_model(path, ordered, points)
        return
    write_transforms(path, ordered, Path(os.path.relpath(images, path.absolute().parent)).as_posix())


def camera_output_files(path: Path) -> list[Path]:
    """Return the paths of the files that `write_cameras` writes."""
    return [path] if path.suffix.lower() == ".json" else [path / name for name in MODEL_FILES]


def check_cameras_not_replaced(path: Path, scene: Path, source: Path | None) -> None:
    """Check that `write_cameras` would not replace cameras that were read.

    Args:
        path: output of `write_cameras`.
        scene: folder of the scene.
        source: file or folder that the cameras were read from, if the user named it.

    Raises:
        InputError: a file that would be written exists in the scene's folder or in the source.
    """
    for file in camera_output_files(path):
        for owner in (scene, source):
            if owner is not None and file.exists() and file.resolve().is_relative_to(owner.resolve()):
                raise InputError(f"{file}: would be replaced, but belongs to {owner}: choose another output")


def check_cameras_output(path: Path, scene: Path | None = None) -> None:
    """Check before a long computation that `write_cameras` can write to a path.

    Args:
        path: output of `write_cameras`.
        scene: folder of a scene that must not change.

    Raises:
        InputError: the folder of a .json does not exist, a model's folder is a file or contains a binary model, or the
            cameras would be written into the scene.
    """
    if path.suffix.lower() == ".json":
        check_output(path, ())
    else:
        check_model_output(path)
    if scene is not None and path.resolve().is_relative_to(scene.resolve()):
        raise InputError(f"{path}: the cameras would be written into the scene's folder: choose another folder")
