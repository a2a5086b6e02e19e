"""Scenes from folders: which images, masks, positions and cameras there are, and which of them belong together."""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pcbench.errors import InputError
from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.cameras import Camera, Intrinsics
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.geodesy import Gps
from pcbench.io.colmap import read_points3d
from pcbench.io.colmap_model import has_points, is_colmap_model, read_colmap_cameras
from pcbench.io.earth_studio import PROJECT_FILE_HINT, read_earth_studio, describe_sphere_scale
from pcbench.io.image_header import ImageHeader, read_image_header
from pcbench.io.k_matrix import K_MATRIX_FILE, intrinsics_from_k, read_k_matrix
from pcbench.io.openmvs import is_openmvs, read_openmvs
from pcbench.io.strecha import read_strecha
from pcbench.io.transforms_json import read_transforms
from pcbench.regular_files import has_entry, read_text
from pcbench.scenes.decode import Size
from pcbench.scenes.folders import find_cameras, find_images, is_earth_studio, unread_calibrations
from pcbench.scenes.names import ImageNames
from pcbench.scenes.scene import Scene

# Of the longer side of an image, below which no focal length is one in pixels: 157 degrees of view.
_MIN_FOCAL_SHARE = 0.1


def read_scene(
    path: Path | str,
    *,
    cameras: Path | str = "auto",
    masks: Path | str | None = None,
    image_scale: float = 1.0,
    on_warning: Callable[[str], None] | None = None,
) -> Scene:
    """The scene in a folder: its JPEG and PNG images (in `images/`, `train/`, `rgb/` or `footage/`, else directly in
    it) and what belongs to them.

    Args:
        path: the folder.
        cameras: "auto": the first found of a COLMAP model (here, in sparse/0 or sparse), transforms.json,
            transforms_train.json, Strecha's `.camera` files (here or in gt_dense_cameras), an OpenMVS scene (`.mvs`)
            and an Earth Studio export; "none"; or one of these by its file or folder. Cameras are matched to images by
            name, frames of Earth Studio by their number. Images without a camera get the intrinsics of a `K.txt` beside
            them or in the folder. Intrinsics for images of another size are scaled if the aspect is the same.
        masks: a folder with NAME.png for an image NAME, or with its stem; `masks/` in the folder if not given.
        image_scale: work with images of this scale, 0 < scale <= 1.
        on_warning: called with one line for each thing left out or not obeyed; `warnings.warn` if not given.

    Raises:
        InputError: there are no images, an image is empty or damaged, a camera's size does not fit its image, its
            intrinsics cannot be those of an image, a pose is no rotation, no camera has an image, or an option is
            wrong.
    """
    path = Path(path)
    warn = on_warning if on_warning is not None else lambda text: warnings.warn(text, stacklevel=3)
    if not path.is_dir():
        raise InputError(f"{path}: expected a folder with images" + ("" if path.exists() else ", which does not exist"))
    if not 0 < image_scale <= 1:
        raise InputError(f"expected an image scale above 0 and up to 1, got {image_scale:g}")
    folder, names = find_images(path)
    headers = {name: read_image_header(folder / name) for name in names}
    scene = Scene(
        folder,
        names,
        {name: (header.width, header.height) for name, header in headers.items()},
        gps={name: header.gps for name, header in headers.items() if header.gps is not None},
        positions=_positions(path / "gps.txt", names, warn),
        masks=_masks(folder, names, headers, _masks_folder(path, masks)),
        image_scale=float(image_scale),
    )
    return _with_intrinsics(_with_cameras(scene, path, str(cameras), warn), path, warn)


def _positions(path: Path, images: Sequence[str], warn: Callable[[str], None]) -> dict[str, FloatArray]:
    """Measured positions, lines of an image's name and x y z in metres; lines that start with # are comments."""
    try:
        lines = read_text(path).splitlines() if has_entry(path) else []
    except (InputError, OSError) as error:
        raise InputError(f"{path}: cannot be read as text: {getattr(error, 'strerror', None) or error}") from error
    find = ImageNames(images)
    found: dict[str, FloatArray] = {}
    unmatched: list[str] = []
    for number, line in enumerate(lines, 1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        try:
            position = np.array([float(word) for word in words[1:]])
        except ValueError:
            position = np.zeros(0)
        if position.shape != (3,) or not np.isfinite(position).all():
            raise InputError(f"{path}: line {number}: expected a name and x y z, got {line.strip()[:60]!r}")
        name = find(words[0])
        if name is None:
            unmatched.append(words[0])
        else:
            found[name] = position
    if unmatched:
        warn(f"{path}: {len(unmatched)} positions are left out, their images are missing: {_list_names(unmatched)}")
    return found


def _masks_folder(path: Path, masks: Path | str | None) -> Path | None:
    if masks is None:
        return path / "masks" if (path / "masks").is_dir() else None
    if not Path(masks).is_dir():
        raise InputError(f"{masks}: expected a folder with masks")
    return Path(masks)


def _masks(
    folder: Path, names: Iterable[str], headers: Mapping[str, ImageHeader], masks: Path | None
) -> dict[str, Path]:
    """The masks by image name; COLMAP's NAME.png (`a.jpg.png`) goes before the stem's (`a.png`)."""
    if masks is None:
        return {}
    found: dict[str, Path] = {}
    for name in names:
        for candidate in (masks / f"{name}.png", masks / Path(name).with_suffix(".png")):
            if has_entry(candidate):
                mask, image = read_image_header(candidate), headers[name]
                if (mask.width, mask.height) != (image.width, image.height):
                    raise InputError(
                        f"{candidate}: expected a mask of {image.width} x {image.height} pixels as {folder / name},"
                        f" got {mask.width} x {mask.height}"
                    )
                found[name] = candidate
                break
    if not found:
        raise InputError(f"{masks}: no mask has an image's name: expected files such as {next(iter(headers))}.png")
    return found


def _with_cameras(scene: Scene, path: Path, choice: str, warn: Callable[[str], None]) -> Scene:
    """The scene with the cameras of a file or folder, or as it is where there are none."""
    if choice == "none":
        return scene
    source = find_cameras(path) if choice == "auto" else Path(choice)
    if source is None:
        _warn_of_unread(scene, None, scene.images, warn)
        if projects := sorted(path.glob("*.esp")):
            warn(f"{projects[0]}: {PROJECT_FILE_HINT}")
        return scene
    if not source.exists():
        raise InputError(f"{source}: expected a file or folder with cameras, which does not exist")
    find = ImageNames(scene.images)
    camera_file = _read_cameras(source, scene, find, warn)
    matched: dict[str, Camera] = {}
    unmatched: list[str] = []
    for camera in camera_file.cameras:
        name = find(camera.name)
        if name is None:
            unmatched.append(camera.name)
            continue
        if name in matched:
            raise InputError(f"{source}: two cameras for the image {name}")
        intrinsics = camera.intrinsics
        if not _same_aspect((intrinsics.width, intrinsics.height), scene.sizes[name]):
            width, height = scene.sizes[name]
            raise InputError(
                f"{scene.folder / name}: the image has {width} x {height} pixels, but its camera in {source} is for"
                f" {intrinsics.width} x {intrinsics.height}: use the images that the cameras were made for"
            )
        if wrong := _intrinsics_error(intrinsics):
            raise InputError(f"{source}: {name}: {wrong}")
        matched[name] = Camera(name, intrinsics.resized(*scene.size(name)), camera.cam_from_world)
    if not matched:
        missing = unmatched[0] if unmatched else "a file_path"
        raise InputError(f"{source}: missing images: none of {len(unmatched)} cameras has one, such as {missing!r}")
    if unmatched:
        count = f"{len(unmatched)} of {len(camera_file.cameras)}"
        warn(f"{source}: {count} cameras are left out, their images are missing: {_list_names(unmatched)}")
    if without_camera := [name for name in scene.images if name not in matched]:
        warn(f"{source}: {len(without_camera)} of {len(scene)} images have no camera: {_list_names(without_camera)}")
    _warn_of_unread(scene, source, without_camera, warn)
    if camera_file.origin is not None:
        warn(f"{source}: {describe_sphere_scale(camera_file.origin)}")
    on_sphere = camera_file.origin is not None  # Earth Studio alone says where its origin is
    return replace(scene, cameras=matched, points=camera_file.points, origin=camera_file.origin, on_sphere=on_sphere)


def _warn_of_unread(scene: Scene, source: Path | None, without_camera: Sequence[str], warn: Callable[[str], None]) -> None:
    """Warn of a calibration among the images that is not read; that of a K.txt is, where images have no camera."""
    unread = [name for name in unread_calibrations(scene.folder, source) if name != K_MATRIX_FILE or not without_camera]
    if unread:
        there = "there are no cameras" if source is None else f"cameras are those of {source}"
        warn(f"{scene.folder / unread[0]}: looks like a calibration and is not read: {there}")


def _with_intrinsics(scene: Scene, path: Path, warn: Callable[[str], None]) -> Scene:
    """The scene with the intrinsics of a K.txt for the images without a camera, or as it is where there is none."""
    file = next((place / K_MATRIX_FILE for place in (scene.folder, path) if has_entry(place / K_MATRIX_FILE)), None)
    without_camera = [name for name in scene.images if name not in scene.cameras]
    if file is None or not without_camera:
        return scene
    k = read_k_matrix(file)
    found: dict[str, Intrinsics] = {}
    reduced: dict[Size, int] = {}
    for name in without_camera:
        width, height = scene.sizes[name]
        try:
            intrinsics, factor = intrinsics_from_k(k, width, height)
        except InputError as error:
            raise InputError(f"{file}: {name}: {error}") from None
        if wrong := _intrinsics_error(intrinsics):
            raise InputError(f"{file}: {name}: {wrong}")
        found[name] = intrinsics.resized(*scene.size(name))
        if factor > 1:
            reduced[width, height] = factor
    for (width, height), factor in reduced.items():
        full = f"{factor * width} x {factor * height}"
        warn(f"{file}: taken to be for images of {full} pixels, by its principal point: scaled to {width} x {height}")
    return replace(scene, intrinsics=found)


class _CameraFile(NamedTuple):
    """Cameras under the names that their file has for them, and what else it says."""

    cameras: Sequence[Camera]
    points: Cloud | None = None
    origin: Gps | None = None


def _read_cameras(source: Path, scene: Scene, find: ImageNames, warn: Callable[[str], None]) -> _CameraFile:
    """The cameras of a file or folder, in whichever of the known formats it is."""
    if source.is_dir():
        if is_colmap_model(source):
            return _CameraFile(read_colmap_cameras(source), read_points3d(source) if has_points(source) else None)
        if files := sorted(source.glob("*.camera")):
            return _CameraFile([read_strecha(file) for file in files])
        raise InputError(f"{source}: expected a COLMAP model (cameras, images) or .camera files in this folder")
    if source.suffix == ".camera":
        return _CameraFile([read_strecha(source)])
    if is_openmvs(source):
        return _CameraFile(*read_openmvs(source, lambda name: scene.sizes.get(find(name) or ""), warn))
    if source.suffix.lower() == ".esp":
        raise InputError(f"{source}: {PROJECT_FILE_HINT}")
    if is_earth_studio(source):
        frames, origin = read_earth_studio(source)
        return _CameraFile(_frames_to_images(source, frames, scene.images), origin=origin)
    return _CameraFile(read_transforms(source, lambda name: scene.sizes.get(find(name) or ""), warn))


def _frames_to_images(source: Path, frames: Sequence[Camera], images: Sequence[str]) -> list[Camera]:
    """Frames under the names of their images: in order where all are there, else by the number that ends a name.

    An export has one frame more than the renderer writes images (96 of 97).
    """
    if len(images) in (len(frames), len(frames) - 1):
        return [replace(camera, name=name) for camera, name in zip(frames, images, strict=False)]
    chosen = []
    for name in images:
        number = re.search(r"(\d+)$", Path(name).stem)
        if number is None or int(number[1]) >= len(frames):
            raise InputError(
                f"{source}: {len(frames)} frames for {len(images)} images, and {name!r} does not end in the number of"
                f" a frame (0 to {len(frames) - 1})"
            )
        chosen.append(replace(frames[int(number[1])], name=name))
    return chosen


def _intrinsics_error(k: Intrinsics) -> str:
    """Why intrinsics cannot be those of an image, in words; empty where they can."""
    size = max(k.width, k.height)
    focal, at = f"a focal length of {k.fx:.4g} x {k.fy:.4g}", f"a principal point at ({k.cx:.4g}, {k.cy:.4g})"
    in_pixels = min(k.fx, k.fy) >= _MIN_FOCAL_SHARE * size and (max(k.cx, k.cy) > 1 or size <= 2)
    if not in_pixels:
        what = "they look normalised or in millimetres"
    elif not (0 <= k.cx <= k.width and 0 <= k.cy <= k.height):
        what = "its principal point lies outside the image"
    else:
        return ""
    return f"expected intrinsics in pixels of {k.width} x {k.height}, got {focal} and {at}: {what}"


def _same_aspect(camera: Size, image: Size) -> bool:
    """Whether one was resized to the other, up to the rounding of a pixel in either size."""
    scale = image[0] / camera[0]
    return abs(camera[1] * scale - image[1]) <= 1 + scale


def _list_names(names: Sequence[str]) -> str:
    return ", ".join(names[:3]) + (", ..." if len(names) > 3 else "")
