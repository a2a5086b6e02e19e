"""Read scenes from folders: find images, masks, positions and cameras, and match them."""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pcbench.errors import InputError, reason_of
from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.cameras import Camera, Intrinsics
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.geodesy import Gps
from pcbench.io.colmap import read_points3d
from pcbench.io.colmap_folders import CAMERA_FILES, is_colmap_model, points_file
from pcbench.io.colmap_model import has_points, read_colmap_cameras
from pcbench.io.earth_studio import PROJECT_FILE_HINT, describe_sphere_scale, read_earth_studio
from pcbench.io.gaussian_cameras import is_gaussian_cameras, read_gaussian_cameras
from pcbench.io.image_header import ImageHeader, read_image_header
from pcbench.io.k_matrix import K_MATRIX_FILE, intrinsics_from_k, read_k_matrix
from pcbench.io.metashape import is_metashape, read_metashape
from pcbench.io.openmvs import is_openmvs, read_openmvs
from pcbench.io.strecha import read_strecha
from pcbench.io.transforms_json import read_transforms
from pcbench.regular_files import has_entry, read_text
from pcbench.scenes.decode import Size
from pcbench.scenes.folders import (
    find_cameras,
    find_images,
    is_earth_studio,
    named_cameras,
    unread_calibrations,
    visible_files,
)
from pcbench.scenes.names import ImageNames
from pcbench.scenes.scene import Scene, first_names
from pcbench.scenes.turned import camera_of_stored, describe_turned

# Smallest plausible focal length as a share of the longer image side; it corresponds to a field of view of 157 degrees.
_MIN_FOCAL_SHARE = 0.1


def read_scene(
    path: Path | str,
    *,
    cameras: Path | str = "auto",
    masks: Path | str | None = None,
    image_scale: float = 1.0,
    on_warning: Callable[[str], None] | None = None,
) -> Scene:
    """Read the scene in a folder: its JPEG, PNG, TIFF and WebP images, cameras, masks and positions.

    Images are searched in `images/`, `train/`, `rgb/` or `footage/`, else directly in the folder. Files that look like
    images but cannot be used are left out, and one warning names them all.

    Args:
        path: folder of the scene.
        cameras: "auto", "none", or a camera file or folder. "auto" uses the first that exists: a COLMAP model (in the
            folder, sparse or colmap/sparse, or the largest of those in their subfolders 0, 1, ...), transforms.json,
            transforms_train.json, Strecha's `.camera` files (in the folder, gt_dense_cameras or images), an OpenMVS
            scene (`.mvs`), an Earth Studio export, the cameras.json of a model of Gaussian splats, the only XML file of
            Metashape's cameras. Cameras are matched to images by name, frames of Earth Studio by
            order or number. Images without a camera get the intrinsics of a `K.txt` next to them or in the folder.
            Intrinsics for another image size are scaled if the aspect ratio is equal.
        masks: folder with a mask NAME.png for an image NAME (with or without its extension). Defaults to `masks/` in
            the folder.
        image_scale: scale of the working size, 0 < scale <= 1.
        on_warning: callback, called with one line per warning. Defaults to `warnings.warn`.

    Returns:
        The scene.

    Raises:
        InputError: there are no images, or none can be used; a camera's size does not match its image, its
            intrinsics are implausible, a pose is not a rotation, no camera matches an image, or an option is invalid.
    """
    path = Path(path)
    warn = on_warning if on_warning is not None else lambda text: warnings.warn(text, stacklevel=3)
    if not path.is_dir():
        got = "got a file" if path.exists() else "but it does not exist"
        raise InputError(f"{path}: expected a folder with images, {got}: check the path")
    if not 0 < image_scale <= 1:
        raise InputError(f"expected an image scale above 0 and at most 1, got {image_scale:g}")
    folder, all_names, unsupported = find_images(path)
    headers, reasons = _read_headers(folder, all_names)
    if not headers:
        raise InputError(next(iter(reasons.values())))
    reasons |= {name: f"{folder / name}: expected a JPEG, PNG, TIFF or WebP image: convert it" for name in unsupported}
    if reasons:
        listed = "; ".join(reasons.values())
        warn(f"{folder}: files that cannot be used as images are left out ({len(reasons)}): {listed}")
    names = tuple(headers)
    scene = Scene(
        folder,
        names,
        {name: (header.width, header.height) for name, header in headers.items()},
        gps={name: header.gps for name, header in headers.items() if header.gps is not None},
        positions=_positions(path / "gps.txt", names, warn),
        masks=_masks(folder, names, headers, _masks_folder(path, masks)),
        with_alpha=frozenset(name for name, header in headers.items() if header.has_alpha),
        image_scale=float(image_scale),
    )
    orientations = {name: header.orientation for name, header in headers.items()}
    return _with_intrinsics(_with_cameras(scene, all_names, path, str(cameras), orientations, warn), path, warn)


def _read_headers(folder: Path, names: Sequence[str]) -> tuple[dict[str, ImageHeader], dict[str, str]]:
    """Return the headers of the images that can be used, and the reasons against the others, by name."""
    headers: dict[str, ImageHeader] = {}
    reasons: dict[str, str] = {}
    for name in names:
        try:
            headers[name] = read_image_header(folder / name)
        except InputError as error:
            reasons[name] = str(error)
    return headers, reasons


def _positions(path: Path, images: Sequence[str], warn: Callable[[str], None]) -> dict[str, FloatArray]:
    """Read measured positions: lines of image name and x y z in metres. Lines that start with # are comments."""
    try:
        lines = read_text(path).splitlines() if has_entry(path) else []
    except (InputError, OSError) as error:
        raise InputError(f"{path}: cannot be read as text: {reason_of(error)}") from error
    find = ImageNames(images)
    positions: dict[str, FloatArray] = {}
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
            raise InputError(
                f"{path}: line {number}: expected a name and x y z, got {line.strip()[:60]!r}: correct the line"
            )
        name = find(words[0])
        if name is None:
            unmatched.append(words[0])
        else:
            positions[name] = position
    if unmatched:
        warn(f"{path}: left out {len(unmatched)} positions without an image: {first_names(unmatched)}")
    return positions


def _masks_folder(path: Path, masks: Path | str | None) -> Path | None:
    if masks is None:
        return path / "masks" if (path / "masks").is_dir() else None
    if not Path(masks).is_dir():
        raise InputError(f"{masks}: expected a folder with masks, got none: check the path")
    return Path(masks)


def _masks(
    folder: Path, names: Iterable[str], headers: Mapping[str, ImageHeader], masks: Path | None
) -> dict[str, Path]:
    """Find the masks by image name; COLMAP's NAME.png (`a.jpg.png`) takes precedence over the stem's (`a.png`)."""
    if masks is None:
        return {}
    mask_files: dict[str, Path] = {}
    for name in names:
        for candidate in (masks / f"{name}.png", masks / Path(name).with_suffix(".png")):
            if has_entry(candidate):
                mask, image = read_image_header(candidate), headers[name]
                if (mask.width, mask.height) != (image.width, image.height):
                    is_turned = (mask.height, mask.width) == (image.width, image.height)
                    raise InputError(
                        f"{candidate}: expected a mask of {image.width} x {image.height} pixels as {folder / name},"
                        f" got {mask.width} x {mask.height}: {'turn' if is_turned else 'resize'} the mask"
                    )
                mask_files[name] = candidate
                break
    if not mask_files:
        raise InputError(f"{masks}: expected masks named by their images, such as {next(iter(headers))}.png, got none")
    return mask_files


def _with_cameras(
    scene: Scene,
    all_names: Sequence[str],
    path: Path,
    choice: str,
    orientations: Mapping[str, int],
    warn: Callable[[str], None],
) -> Scene:
    """Add the cameras of a file or folder to a scene; return it unchanged if there are none.

    Frames of Earth Studio belong to images by order: `all_names` are those of all images, also of unreadable ones.
    """
    if choice == "none":
        return scene
    source = find_cameras(path, warn) if choice == "auto" else named_cameras(Path(choice), warn)
    if source is None:
        _warn_of_unread(scene, None, scene.images, warn)
        if projects := visible_files(path, "*.esp"):
            warn(f"{projects[0]}: {PROJECT_FILE_HINT}")
        return scene
    if not source.exists():
        raise InputError(f"{source}: expected a file or folder with cameras, but it does not exist: check the path")
    find = ImageNames(scene.images)
    camera_file = _read_cameras(source, scene, all_names, find, warn)
    matched: dict[str, Camera] = {}
    unmatched: list[str] = []
    turned: list[str] = []
    ambiguous: list[str] = []
    for camera in camera_file.cameras:
        name = find(camera.name)
        if name is None:
            unmatched.append(camera.name)
            continue
        if name in matched:
            raise InputError(f"{source}: expected one camera per image, got two for {name}: remove one of them")
        if wrong := _intrinsics_error(camera.intrinsics):
            raise InputError(f"{source}: {name}: {wrong}")
        try:
            stored = camera_of_stored(camera, scene.sizes[name], orientations[name], source)
        except InputError as error:
            raise InputError(f"{scene.folder / name}: {error}") from None
        turned += [name] * stored.was_turned
        ambiguous += [name] * stored.is_ambiguous
        camera = stored.camera
        matched[name] = Camera(name, camera.intrinsics.resized(*scene.size(name)), camera.cam_from_world)
    if not matched:
        raise InputError(
            f"{source}: expected cameras of these images, got {len(unmatched)} of other images, such as"
            f" {unmatched[0]!r}: use the images of these cameras"
        )
    if unmatched:
        count = f"{len(unmatched)} of {len(camera_file.cameras)}"
        warn(f"{source}: left out {count} cameras whose images are missing: {first_names(unmatched)}")
    if without_camera := [name for name in scene.images if name not in matched]:
        warn(f"{source}: no camera for {len(without_camera)} of {len(scene)} images: {first_names(without_camera)}")
    for line in describe_turned(turned, ambiguous, len(matched)):
        warn(f"{source}: {line}")
    _warn_of_unread(scene, source, without_camera, warn)
    if camera_file.origin is not None:
        warn(f"{source}: {describe_sphere_scale(camera_file.origin)}")
    on_sphere = camera_file.origin is not None  # only Earth Studio exports state an origin
    return replace(scene, cameras=matched, points=camera_file.points, origin=camera_file.origin, on_sphere=on_sphere)


def _warn_of_unread(
    scene: Scene, source: Path | None, without_camera: Sequence[str], warn: Callable[[str], None]
) -> None:
    """Warn about a calibration file that is not read; K.txt is read if images have no camera."""
    unread = [name for name in unread_calibrations(scene.folder, source) if name != K_MATRIX_FILE or not without_camera]
    if unread:
        there = "the scene has no cameras" if source is None else f"the cameras are read from {source}"
        warn(f"{scene.folder / unread[0]}: ignored a file that looks like a calibration: {there}")


def _with_intrinsics(scene: Scene, path: Path, warn: Callable[[str], None]) -> Scene:
    """Add the intrinsics of a K.txt for the images without a camera; return the scene unchanged if there is none."""
    file = next((place / K_MATRIX_FILE for place in (scene.folder, path) if has_entry(place / K_MATRIX_FILE)), None)
    without_camera = [name for name in scene.images if name not in scene.cameras]
    if file is None or not without_camera:
        return scene
    k = read_k_matrix(file)
    found_intrinsics: dict[str, Intrinsics] = {}
    reduced: dict[Size, int] = {}
    for name in without_camera:
        width, height = scene.sizes[name]
        try:
            intrinsics, factor = intrinsics_from_k(k, width, height)
        except InputError as error:
            raise InputError(f"{file}: {name}: {error}") from None
        if wrong := _intrinsics_error(intrinsics):
            raise InputError(f"{file}: {name}: {wrong}")
        found_intrinsics[name] = intrinsics.resized(*scene.size(name))
        if factor > 1:
            reduced[width, height] = factor
    for (width, height), factor in reduced.items():
        full = f"{factor * width} x {factor * height}"
        warn(f"{file}: its principal point fits images of {full} pixels: scaled it to {width} x {height}")
    return replace(scene, intrinsics=found_intrinsics)


class _CameraFile(NamedTuple):
    """Cameras named as in their file, with the sparse points and origin if it has them."""

    cameras: Sequence[Camera]
    points: Cloud | None = None
    origin: Gps | None = None


def _read_cameras(
    source: Path, scene: Scene, all_names: Sequence[str], find: ImageNames, warn: Callable[[str], None]
) -> _CameraFile:
    """Read the cameras of a file or folder in any supported format."""
    if source.name in CAMERA_FILES:
        return _read_model(source.parent, warn)
    if source.is_dir():
        if is_colmap_model(source):
            return _read_model(source, warn)
        if files := visible_files(source, "*.camera"):
            return _CameraFile([read_strecha(file) for file in files])
        raise InputError(f"{source}: expected a COLMAP model (cameras, images) or .camera files, got neither")
    if source.suffix == ".camera":
        return _CameraFile([read_strecha(source)])
    if is_openmvs(source):
        return _CameraFile(*read_openmvs(source, lambda name: scene.sizes.get(find(name) or ""), warn))
    if is_metashape(source):
        return _CameraFile(read_metashape(source, warn))
    if is_gaussian_cameras(source):
        return _CameraFile(read_gaussian_cameras(source))
    if source.suffix.lower() == ".esp":
        raise InputError(f"{source}: {PROJECT_FILE_HINT}")
    if is_earth_studio(source):
        frames, origin = read_earth_studio(source)
        return _CameraFile(_frames_to_images(source, frames, all_names), origin=origin)
    return _CameraFile(read_transforms(source, lambda name: scene.sizes.get(find(name) or ""), warn))


def _read_model(folder: Path, warn: Callable[[str], None]) -> _CameraFile:
    """Read the cameras and points of the COLMAP model that a folder holds itself."""
    points = points_file(folder)
    cameras = read_colmap_cameras(folder, warn)
    return _CameraFile(cameras, read_points3d(points, warn) if points is not None and has_points(points) else None)


def _frames_to_images(source: Path, frames: Sequence[Camera], images: Sequence[str]) -> list[Camera]:
    """Name frames by their images: in order if the counts match, else by the number at the end of an image's name.

    An export may have one frame more than the renderer writes images, such as 97 for 96.
    """
    if len(images) in (len(frames), len(frames) - 1):
        return [replace(camera, name=name) for camera, name in zip(frames, images, strict=False)]
    chosen = []
    for name in images:
        number = re.search(r"(\d+)$", Path(name).stem)
        if number is None or int(number[1]) >= len(frames):
            raise InputError(
                f"{source}: expected image names that end in a frame number (0 to {len(frames) - 1}), since there are"
                f" {len(frames)} frames for {len(images)} images; got {name!r}: rename the image"
            )
        chosen.append(replace(frames[int(number[1])], name=name))
    return chosen


def _intrinsics_error(k: Intrinsics) -> str:
    """Describe why intrinsics are implausible for their image; empty if they are plausible."""
    size = max(k.width, k.height)
    focal = f"a focal length of {k.fx:.4g} x {k.fy:.4g}"
    principal_point = f"a principal point at ({k.cx:.4g}, {k.cy:.4g})"
    in_pixels = min(k.fx, k.fy) >= _MIN_FOCAL_SHARE * size and (max(k.cx, k.cy) > 1 or size <= 2)
    if not in_pixels:
        what = "they look normalised or in millimetres, convert them to pixels"
    elif not (0 <= k.cx <= k.width and 0 <= k.cy <= k.height):
        what = "the principal point lies outside the image, correct it"
    else:
        return ""
    return f"expected intrinsics in pixels of {k.width} x {k.height}, got {focal} and {principal_point}: {what}"
