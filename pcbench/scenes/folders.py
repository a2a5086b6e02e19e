"""Where in a scene's folder its images and cameras are: the layouts that programs and data sets leave."""

from __future__ import annotations

import re
from pathlib import Path

from pcbench.errors import InputError
from pcbench.io.colmap_model import is_colmap_model
from pcbench.io.files import read_json
from pcbench.io.image_header import EXTENSIONS
from pcbench.regular_files import has_entry, read_bytes

# COLMAP and nerfstudio; NeRF's synthetic sets; RGB-D sets; Earth Studio's download.
_IMAGE_FOLDERS = ("images", "train", "rgb", "footage")
_MODEL_FOLDERS = (".", "sparse/0", "sparse", "colmap/sparse/0")  # where a COLMAP model may stand in a scene's folder
_TRANSFORMS_FILES = ("transforms.json", "transforms_train.json")
_CAMERA_FOLDERS = (".", "gt_dense_cameras", "images")  # where Strecha's files may
_CALIBRATION_NAMES = re.compile(
    r"(k|.*_par|(intrinsics?|calib|calibration|cameras?|cam)([_-].*)?)\.(txt|xml|json|ya?ml|csv|npz|bin)|transforms.*\.json"
)
_UNSUPPORTED_EXTENSIONS = (".tif", ".tiff", ".webp", ".bmp", ".heic", ".jp2", ".dng", ".gif")


def natural_key(name: str) -> tuple[list[tuple[str, int]], str]:
    """What names are sorted by where people count: frame_2 comes before frame_10."""
    parts = re.split(r"([0-9]+)", name)
    pairs = [(text, int(number or -1)) for text, number in zip(parts[::2], [*parts[1::2], ""], strict=True)]
    return pairs, name  # 1 and 01 count the same: their texts decide


def find_images(path: Path) -> tuple[Path, tuple[str, ...]]:
    """The folder of a scene's images, and their names in it as people count them.

    Raises:
        InputError: there are none, or some are of a format that is not read.
    """
    # Only a folder of images is searched to its depths: beside it stand masks, depth maps and results.
    folders = [(path / name, list((path / name).rglob("*"))) for name in _IMAGE_FOLDERS if (path / name).is_dir()]
    for folder, found in [*folders, (path, list(path.iterdir()))]:
        files = [p.relative_to(folder) for p in found if not p.is_dir()]
        visible = [p for p in files if not any(part.startswith(".") for part in p.parts)]
        unread = sorted(p.as_posix() for p in visible if p.suffix.lower() in _UNSUPPORTED_EXTENSIONS)
        if unread:
            raise InputError(f"{folder / unread[0]}: expected JPEG or PNG images: convert it, or move it elsewhere")
        names = sorted((p.as_posix() for p in visible if p.suffix.lower() in EXTENSIONS), key=natural_key)
        if names:
            return folder, tuple(names)
    inner = ", ".join(f"{name}/" for name in _IMAGE_FOLDERS)
    raise InputError(f"{path}: expected a folder with images (.jpg, .jpeg, .png), directly or in one of {inner}")


def scene_name(folder: Path) -> str:
    """What people call the scene whose images are in a folder: its name, or that of the folder above `images/` and the
    like."""
    path = folder.resolve()
    return (path.parent if path.name in _IMAGE_FOLDERS else path).name


def unread_calibrations(folder: Path, cameras: Path | None) -> tuple[str, ...]:
    """The names of files among the images that look like a calibration and are not what the cameras are read from.

    Args:
        folder: of the images.
        cameras: the file or folder that the cameras are read from; None where there is none.
    """
    if cameras is not None and cameras.resolve() == folder.resolve():
        return ()
    names = sorted(path.name for path in folder.iterdir() if _CALIBRATION_NAMES.fullmatch(path.name.lower()))
    return tuple(name for name in names if cameras is None or (folder / name).resolve() != cameras.resolve())


def find_cameras(path: Path) -> Path | None:
    """The cameras that belong to a scene's folder: the first of the known formats that is there.

    Raises:
        InputError: there are two exports of Earth Studio, or two scenes of OpenMVS and none is called scene.mvs.
    """
    for subfolder in _MODEL_FOLDERS:
        if is_colmap_model(path / subfolder):
            return path / subfolder
    for name in _TRANSFORMS_FILES:
        if has_entry(path / name):
            return path / name
    for subfolder in _CAMERA_FOLDERS:
        if any((path / subfolder).glob("*.camera")):
            return path / subfolder
    if (scene := _openmvs_scene(path)) is not None:
        return scene
    exports = [file for file in sorted(path.glob("*.json")) if is_earth_studio(file)]
    if len(exports) > 1:
        raise InputError(f"{path}: two camera exports, {exports[0].name} and {exports[1].name}: say which one")
    return exports[0] if exports else None


def _openmvs_scene(path: Path) -> Path | None:
    """The scene of OpenMVS in a folder; its tools leave more beside the first one, scene.mvs."""
    files = sorted(file for file in path.glob("*.mvs") if file.is_file())
    if (path / "scene.mvs") in files:
        return path / "scene.mvs"
    if len(files) > 1:
        raise InputError(f"{path}: two scenes of OpenMVS, {files[0].name} and {files[1].name}: say which one")
    return files[0] if files else None


def is_earth_studio(path: Path) -> bool:
    """Whether a file is a camera export of Earth Studio.

    Raises:
        InputError: it is no regular file; the message starts with the path.
    """
    try:
        document = read_json(path)
    except InputError as error:  # an export that is damaged is one all the same, and no reason to see no cameras
        try:
            return b'"cameraFrames"' in read_bytes(path)
        except InputError:
            raise InputError(f"{path}: {error}") from error
        except OSError:
            return False
    except OSError:
        return False
    return isinstance(document, dict) and "cameraFrames" in document
