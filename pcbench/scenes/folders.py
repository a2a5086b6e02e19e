"""Find images and cameras in a scene's folder, in the layouts of common programs and data sets."""

from __future__ import annotations

import re
from pathlib import Path
from typing import NamedTuple

from pcbench.errors import InputError
from pcbench.io.colmap_folders import find_model
from pcbench.io.files import Warn
from pcbench.io.gaussian_cameras import is_gaussian_cameras
from pcbench.io.image_header import EXTENSIONS
from pcbench.io.metashape import is_metashape_export
from pcbench.regular_files import has_entry, read_bytes, read_json

# In order of search: COLMAP and nerfstudio; NeRF's synthetic scenes; RGB-D data sets; Earth Studio.
_IMAGE_FOLDERS = ("images", "train", "rgb", "footage")
_TRANSFORMS_FILES = ("transforms.json", "transforms_train.json")
_GAUSSIAN_CAMERAS = "cameras.json"
_CAMERA_FOLDERS = (".", "gt_dense_cameras", "images")  # possible folders of Strecha's files
_CALIBRATION_NAMES = re.compile(
    r"(k|.*_par|(intrinsics?|calib|calibration|cameras?|cam)([_-].*)?)\.(txt|xml|json|ya?ml|csv|npz|bin)|transforms.*\.json"
)
_UNSUPPORTED_EXTENSIONS = (".bmp", ".heic", ".heif", ".jp2", ".dng", ".gif", ".avif", ".jxl")


def natural_key(name: str) -> tuple[list[tuple[str, int]], str]:
    """Return the key for natural sorting of names: frame_2 comes before frame_10."""
    parts = re.split(r"([0-9]+)", name)
    pairs = [(text, int(number or -1)) for text, number in zip(parts[::2], [*parts[1::2], ""], strict=True)]
    return pairs, name  # 1 and 01 are equal as numbers, so the name decides


def visible_files(folder: Path, pattern: str) -> list[Path]:
    """Return the files of a folder that match a pattern, sorted, without hidden ones such as macOS's `._` files."""
    return sorted(file for file in folder.glob(pattern) if not file.name.startswith("."))


class ImageFolder(NamedTuple):
    """Folder of a scene's images, with the names of the images in natural order and those of unsupported formats."""

    folder: Path
    names: tuple[str, ...]
    unsupported: tuple[str, ...]


def find_images(path: Path) -> ImageFolder:
    """Find the images of a scene's folder.

    Raises:
        InputError: there are no images.
    """
    # Only a folder of images is searched recursively: a scene's folder also contains masks, depth maps and results.
    folders = [(path / name, list((path / name).rglob("*"))) for name in _IMAGE_FOLDERS if (path / name).is_dir()]
    for folder, entries in [*folders, (path, list(path.iterdir()))]:
        files = [p.relative_to(folder) for p in entries if not p.is_dir()]
        visible = [p for p in files if not any(part.startswith(".") for part in p.parts)]
        names, unsupported = (
            sorted((p.as_posix() for p in visible if p.suffix.lower() in extensions), key=natural_key)
            for extensions in (EXTENSIONS, _UNSUPPORTED_EXTENSIONS)
        )
        if names:
            return ImageFolder(folder, tuple(names), tuple(unsupported))
        if unsupported:
            raise InputError(f"{folder / unsupported[0]}: expected JPEG, PNG, TIFF or WebP images: convert them")
    inner = ", ".join(f"{name}/" for name in _IMAGE_FOLDERS)
    raise InputError(f"{path}: expected a folder with images ({', '.join(EXTENSIONS)}), directly or in one of {inner}")


def scene_name(folder: Path) -> str:
    """Return the name of a scene from its image folder: the folder's name, or its parent's for `images/` etc."""
    path = folder.resolve()
    return (path.parent if path.name in _IMAGE_FOLDERS else path).name


def unread_calibrations(folder: Path, cameras: Path | None) -> tuple[str, ...]:
    """Return names of files next to the images that look like a calibration but are not the source of the cameras.

    Args:
        folder: folder of the images.
        cameras: file or folder that the cameras are read from, or None.
    """
    if cameras is not None and cameras.resolve() == folder.resolve():
        return ()
    names = sorted(path.name for path in folder.iterdir() if _CALIBRATION_NAMES.fullmatch(path.name.lower()))
    return tuple(name for name in names if cameras is None or (folder / name).resolve() != cameras.resolve())


def find_cameras(path: Path, warn: Warn) -> Path | None:
    """Find the cameras of a scene's folder: the first of the supported formats that exists, or None.

    Args:
        path: folder of the scene.
        warn: callback, called with one line that names all COLMAP models if there are several.

    Raises:
        InputError: there are two Earth Studio exports, or several OpenMVS scenes none of which is named scene.mvs.
    """
    if (model := find_model(path, "images", lambda line: warn(f"{path}: {line}"))) is not None:
        return model
    for name in _TRANSFORMS_FILES:
        if has_entry(path / name):
            return path / name
    for subfolder in _CAMERA_FOLDERS:
        if visible_files(path / subfolder, "*.camera"):
            return path / subfolder
    if (scene := _openmvs_scene(path)) is not None:
        return scene
    exports = [file for file in visible_files(path, "*.json") if is_earth_studio(file)]
    if len(exports) > 1:
        raise InputError(
            f"{path}: expected one camera export, got {exports[0].name} and {exports[1].name}: choose one by its file"
        )
    if exports:
        return exports[0]
    if is_gaussian_cameras(path / _GAUSSIAN_CAMERAS):
        return path / _GAUSSIAN_CAMERAS
    projects = [file for file in visible_files(path, "*.xml") if is_metashape_export(file)]
    return projects[0] if len(projects) == 1 else None


def named_cameras(path: Path, warn: Warn) -> Path:
    """Return the folder of the COLMAP model in a folder that a user names; return any other path unchanged.

    Args:
        path: file or folder with cameras.
        warn: callback, called with one line that names all COLMAP models if there are several.
    """
    model = find_model(path, "images", lambda line: warn(f"{path}: {line}")) if path.is_dir() else None
    return model or path


def _openmvs_scene(path: Path) -> Path | None:
    """Find the OpenMVS scene in a folder. OpenMVS's tools write further scenes next to the first, scene.mvs."""
    files = [file for file in visible_files(path, "*.mvs") if file.is_file()]
    if (path / "scene.mvs") in files:
        return path / "scene.mvs"
    if len(files) > 1:
        raise InputError(
            f"{path}: expected one OpenMVS scene, got {files[0].name} and {files[1].name}: choose one by its file"
        )
    return files[0] if files else None


def is_earth_studio(path: Path) -> bool:
    """Return whether a file is an Earth Studio camera export.

    Raises:
        InputError: the file is not a regular file. The message starts with the path.
    """
    try:
        document = read_json(path)
    except InputError as error:  # a damaged export still counts, so that its reader reports the damage
        try:
            return b'"cameraFrames"' in read_bytes(path)
        except InputError:
            raise InputError(f"{path}: {error}") from error
        except OSError:
            return False
    except OSError:
        return False
    return isinstance(document, dict) and "cameraFrames" in document
