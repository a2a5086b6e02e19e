"""Scene: photographs, and what is known about their cameras. It is what a reconstructor gets."""

from __future__ import annotations

import hashlib
import json
import os
import re
import warnings
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pcbench.errors import InputError, MissingExtra
from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.cameras import Camera
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.geodesy import Gps, enu_from_wgs84
from pcbench.io.colmap import read_points3d
from pcbench.io.colmap_model import (
    check_model_output,
    has_points,
    is_colmap_model,
    read_colmap_cameras,
    write_colmap_model,
)
from pcbench.io.earth_studio import read_earth_studio
from pcbench.io.files import check_output, digest
from pcbench.io.image_header import EXTENSIONS, read_image_header
from pcbench.io.strecha import read_strecha
from pcbench.io.transforms_json import read_transforms, write_transforms

if TYPE_CHECKING:
    from PIL.Image import Image

Size = tuple[int, int]

_MODELS = (".", "sparse/0", "sparse", "colmap/sparse/0")  # where a COLMAP model may stand in a scene's folder
_CAMERA_FOLDERS = (".", "gt_dense_cameras", "images")  # where Strecha's files may
_UNREAD = (".tif", ".tiff", ".webp", ".bmp", ".heic", ".jp2", ".dng", ".gif")


@dataclass(frozen=True, eq=False)
class Scene:
    """Photographs with, perhaps, cameras, GPS positions and masks. `read_scene` makes one.

    Args:
        folder: where the images are.
        images: their names relative to it, sorted.
        sizes: (width, height) of each image's file, in pixels.
        cameras: by image name, at the working size; the images without one are not in it.
        gps: by image name, from EXIF.
        positions: by image name, measured in metres in a frame of their own (3,), from gps.txt.
        masks: by image name: an image of the same size whose black pixels are to be left out.
        image_scale: the working size relative to the files', 0 < scale <= 1.
        points: sparse points in the frame of the cameras, if they came with some.
        origin: the place on earth that is (0, 0, 0) in the frame of the cameras (x east, y north, z up), if known.
    """

    folder: Path
    images: tuple[str, ...]
    sizes: Mapping[str, Size]
    cameras: Mapping[str, Camera] = field(default_factory=dict)
    gps: Mapping[str, Gps] = field(default_factory=dict)
    positions: Mapping[str, FloatArray] = field(default_factory=dict)
    masks: Mapping[str, Path] = field(default_factory=dict)
    image_scale: float = 1.0
    points: Cloud | None = None
    origin: Gps | None = None

    def __len__(self) -> int:
        return len(self.images)

    def size(self, name: str) -> Size:
        """Width and height at which an image is worked with, in pixels."""
        width, height = self.sizes[name]
        return max(1, round(width * self.image_scale)), max(1, round(height * self.image_scale))

    def read_image(self, name: str) -> NDArray[np.uint8]:
        """An image at the working size, (height, width, 3) RGB.

        Raises:
            InputError: it cannot be decoded.
            MissingExtra: Pillow is not installed.
        """
        return np.array(self._open(self.folder / name, "RGB", self.size(name)), dtype=np.uint8)

    def read_mask(self, name: str) -> NDArray[np.bool_] | None:
        """Which pixels count, (height, width) at the working size; None where the image has no mask.

        Raises:
            InputError: it cannot be decoded.
            MissingExtra: Pillow is not installed.
        """
        if name not in self.masks:
            return None
        return np.array(self._open(self.masks[name], "L", self.size(name), smooth=False)) > 0

    def write_images(self, folder: Path) -> None:
        """Write the images at the working size into a folder under their own names: PNG without loss, JPEG at quality
        97 without subsampled colours.

        Raises:
            InputError: an image cannot be decoded.
            MissingExtra: Pillow is not installed.
            OSError: a file cannot be written.
        """
        for name in self.images:
            path = folder / name
            path.parent.mkdir(parents=True, exist_ok=True)
            image = self._open(self.folder / name, "RGB", self.size(name))
            options: dict[str, Any] = (
                {"compress_level": 1} if path.suffix.lower() == ".png" else {"quality": 97, "subsampling": 0}
            )
            image.save(path, **options)

    def _open(self, path: Path, mode: str, size: Size, *, smooth: bool = True) -> Image:
        try:
            from PIL import Image, UnidentifiedImageError
        except ImportError as error:
            raise MissingExtra("pillow", "sfm", str(error)) from error
        try:
            with Image.open(path) as file:
                image = file.convert(mode)
        except (OSError, UnidentifiedImageError, SyntaxError, Image.DecompressionBombError) as error:
            raise InputError(f"{path}: cannot be decoded ({error}): copy the image again or remove it") from error
        if image.size == size:
            return image
        return image.resize(size, Image.Resampling.LANCZOS if smooth else Image.Resampling.NEAREST)

    def measured_positions(self) -> tuple[dict[str, FloatArray], str]:
        """Where images were taken, in metres (3,) by name, and the frame in words: that of gps.txt, or east-north-up
        about the first position in EXIF.
        """
        if self.positions:
            return dict(self.positions), "in the frame of gps.txt"
        if not self.gps:
            return {}, ""
        origin = self.gps[min(self.gps)]
        enu = enu_from_wgs84(list(self.gps.values()), origin)
        where = f"{origin.latitude_deg:.7f}, {origin.longitude_deg:.7f}, {origin.altitude:.2f} m"
        return dict(zip(self.gps, enu, strict=True)), f"east-north-up about {where}"

    def select(self, names: Collection[str]) -> Scene:
        """The scene of some of its images.

        Raises:
            InputError: a name is not in the scene, or none is given.
        """
        if unknown := sorted(set(names) - set(self.images)):
            raise InputError(f"expected names of images, got {unknown[0]!r}: they are such as {self.images[0]!r}")
        kept = tuple(name for name in self.images if name in set(names))
        if not kept:
            raise InputError("expected at least one image, got none")
        return replace(
            self,
            images=kept,
            sizes={name: self.sizes[name] for name in kept},
            cameras={name: self.cameras[name] for name in kept if name in self.cameras},
            gps={name: self.gps[name] for name in kept if name in self.gps},
            positions={name: self.positions[name] for name in kept if name in self.positions},
            masks={name: self.masks[name] for name in kept if name in self.masks},
        )

    def split_every(self, n: int = 8) -> tuple[Scene, Scene]:
        """Train and test: every n-th image, from the first, is for testing. Test views have near neighbours.

        Raises:
            InputError: one of the two would be empty.
        """
        return self._split(lambda index: index % n == 0 if n > 1 else True, f"every {n}")

    def split_blocks(self, n: int = 8, blocks: int = 2) -> tuple[Scene, Scene]:
        """Train and test: an n-th of the images, as contiguous runs in the middles of `blocks` equal parts. Test views
        have no near neighbours, which is harder than `split_every`.

        Raises:
            InputError: one of the two would be empty.
        """
        length = len(self) / blocks
        low, high = (0.5 - 0.5 / n) * length, (0.5 + 0.5 / n) * length
        return self._split(lambda index: low <= (index + 0.5) % length < high, f"{blocks} blocks of 1/{n}")

    def _split(self, is_test: Callable[[int], bool], how: str) -> tuple[Scene, Scene]:
        test = [name for index, name in enumerate(self.images) if is_test(index)]
        if not 0 < len(test) < len(self):
            raise InputError(f"expected images for training and for testing, got {len(self)} images split by {how}")
        return self.select(set(self.images) - set(test)), self.select(test)

    @cached_property
    def _digests(self) -> dict[str, tuple[str, str]]:
        """SHA-256 of each image and its mask: read once, they may be gigabytes."""
        mask = {name: digest(path) for name, path in self.masks.items()}
        return {name: (digest(self.folder / name), mask.get(name, "")) for name in self.images}

    def describe(self) -> list[str]:
        """What is in the scene, a few lines for people."""
        sizes = sorted({self.size(name) for name in self.images})
        shown = ", ".join(f"{width} x {height}" for width, height in sizes[:3]) + (", ..." if len(sizes) > 3 else "")
        lines = [f"{self.folder}: {len(self)} images of {shown}"]
        lines.append(f"  cameras {len(self.cameras)}, GPS {len(self.positions or self.gps)}, masks {len(self.masks)}")
        if self.cameras:
            positions = np.stack([camera.position for camera in self.cameras.values()])
            extent = " x ".join(f"{length:.4g}" for length in np.ptp(positions, axis=0))
            lenses = len({camera.intrinsics for camera in self.cameras.values()})
            lines.append(f"  cameras span {extent}, {lenses} intrinsics")
        if self.points is not None:
            lines.append(f"  sparse points {len(self.points):,}")
        if self.origin is not None:
            at = self.origin
            lines.append(f"  east-north-up about {at.latitude_deg:.7f}, {at.longitude_deg:.7f}, {at.altitude:.1f} m")
        return lines

    def fingerprint(self, *, cameras: bool = True) -> str:
        """SHA-256 of what a reconstruction depends on: the bytes of images and masks, scale, GPS and cameras."""
        whole = hashlib.sha256(repr(self.image_scale).encode())
        for name in self.images:
            whole.update(f"{name}\0{self._digests[name]}\0{self.gps.get(name)}\0".encode())
            whole.update(self.positions[name].tobytes() if name in self.positions else b"")
            if cameras and name in self.cameras:
                camera = self.cameras[name]
                whole.update(repr(camera.intrinsics).encode() + camera.cam_from_world.matrix.tobytes())
        return whole.hexdigest()


def read_scene(
    path: Path | str,
    *,
    cameras: Path | str = "auto",
    masks: Path | str | None = None,
    image_scale: float = 1.0,
    on_warning: Callable[[str], None] | None = None,
) -> Scene:
    """The scene in a folder: its JPEG and PNG images (in `images/`, else directly in it) and what belongs to them.

    Args:
        path: the folder.
        cameras: "auto": the first found of a COLMAP model (here, in sparse/0 or sparse), transforms.json, Strecha's
            `.camera` files (here or in gt_dense_cameras) and an Earth Studio export; "none"; or one of these by its
            file or folder. Cameras are matched to images by name, frames of Earth Studio by their number. Intrinsics
            for images of another size are scaled if the aspect is the same.
        masks: a folder with NAME.png for an image NAME, or with its stem; `masks/` in the folder if not given.
        image_scale: work with images of this scale, 0 < scale <= 1.
        on_warning: called with one line for each thing left out; `warnings.warn` if not given.

    Raises:
        InputError: there are no images, an image is empty or damaged, a camera's size does not fit its image, a pose is
            no rotation, no camera has an image, or an option is wrong.
    """
    path = Path(path)
    warn = on_warning if on_warning is not None else lambda text: warnings.warn(text, stacklevel=3)
    if not path.is_dir():
        raise InputError(f"{path}: expected a folder with images" + ("" if path.exists() else ", which does not exist"))
    if not 0 < image_scale <= 1:
        raise InputError(f"expected an image scale above 0 and up to 1, got {image_scale:g}")
    folder, names = _images(path)
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
    return _with_cameras(scene, path, str(cameras), warn)


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


def check_cameras_output(path: Path) -> None:
    """Say before a long computation that cameras cannot be written there by `write_cameras`.

    Raises:
        InputError: the folder of a .json does not exist, or a model's folder is a file or holds a binary model.
    """
    if path.suffix.lower() == ".json":
        check_output(path, ())
    else:
        check_model_output(path)


def _images(path: Path) -> tuple[Path, tuple[str, ...]]:
    """The folder of the images and their sorted names in it."""
    inner = path / "images"
    # Only a folder of images is searched to its depths: beside it stand masks, depth maps and results.
    nested = [p.relative_to(inner) for p in inner.rglob("*") if p.is_file()] if inner.is_dir() else []
    for folder, files in ((inner, nested), (path, [Path(p.name) for p in path.iterdir() if p.is_file()])):
        visible = [p for p in files if not any(part.startswith(".") for part in p.parts)]
        names = sorted(p.as_posix() for p in visible if p.suffix.lower() in EXTENSIONS)
        unread = sorted(p.as_posix() for p in visible if p.suffix.lower() in _UNREAD)
        if unread:
            raise InputError(f"{folder / unread[0]}: expected JPEG or PNG images: convert it, or move it elsewhere")
        if names:
            return folder, tuple(names)
    raise InputError(f"{path}: expected a folder with images (.jpg, .jpeg, .png), directly or in images/")


def _positions(path: Path, images: Sequence[str], warn: Callable[[str], None]) -> dict[str, FloatArray]:
    """Measured positions, lines of an image's name and x y z in metres; lines that start with # are comments."""
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except FileNotFoundError:
        return {}
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read as text: {getattr(error, 'strerror', None) or error}") from error
    find = _Names(images)
    found: dict[str, FloatArray] = {}
    lost: list[str] = []
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
            lost.append(words[0])
        else:
            found[name] = position
    if lost:
        warn(f"{path}: {len(lost)} positions are left out, their images are missing: {_some(lost)}")
    return found


def _masks_folder(path: Path, masks: Path | str | None) -> Path | None:
    if masks is None:
        return path / "masks" if (path / "masks").is_dir() else None
    if not Path(masks).is_dir():
        raise InputError(f"{masks}: expected a folder with masks")
    return Path(masks)


def _masks(folder: Path, names: Iterable[str], headers: Mapping[str, Any], masks: Path | None) -> dict[str, Path]:
    """The masks by image name; COLMAP's NAME.png (`a.jpg.png`) goes before the stem's (`a.png`)."""
    if masks is None:
        return {}
    found: dict[str, Path] = {}
    for name in names:
        for candidate in (masks / f"{name}.png", masks / Path(name).with_suffix(".png")):
            if candidate.is_file():
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
    source = _find(path) if choice == "auto" else Path(choice)
    if source is None:
        return scene
    if not source.exists():
        raise InputError(f"{source}: expected a file or folder with cameras, which does not exist")
    find = _Names(scene.images)
    points: Cloud | None = None
    origin: Gps | None = None
    if source.is_dir():
        if is_colmap_model(source):
            given: Sequence[Camera] = read_colmap_cameras(source)
            points = read_points3d(source) if has_points(source) else None
        elif files := sorted(source.glob("*.camera")):
            given = [read_strecha(file) for file in files]
        else:
            raise InputError(f"{source}: expected a COLMAP model (cameras, images) or .camera files in this folder")
    elif source.suffix == ".camera":
        given = [read_strecha(source)]
    elif _is_earth_studio(source):
        given, origin = read_earth_studio(source)
        given = _frames_to_images(source, given, scene.images)
    else:
        given = read_transforms(source, lambda name: scene.sizes.get(find(name) or ""))
    placed: dict[str, Camera] = {}
    lost: list[str] = []
    for camera in given:
        name = find(camera.name)
        if name is None:
            lost.append(camera.name)
            continue
        if name in placed:
            raise InputError(f"{source}: two cameras for the image {name}")
        intrinsics = camera.intrinsics
        if not _same_aspect((intrinsics.width, intrinsics.height), scene.sizes[name]):
            width, height = scene.sizes[name]
            raise InputError(
                f"{scene.folder / name}: the image has {width} x {height} pixels, but its camera in {source} is for"
                f" {intrinsics.width} x {intrinsics.height}: use the images that the cameras were made for"
            )
        placed[name] = Camera(name, intrinsics.resized(*scene.size(name)), camera.cam_from_world)
    if not placed:
        missing = lost[0] if lost else "a file_path"
        raise InputError(f"{source}: missing images: none of {len(lost)} cameras has one, such as {missing!r}")
    if lost:
        warn(f"{source}: {len(lost)} of {len(given)} cameras are left out, their images are missing: {_some(lost)}")
    if bare := [name for name in scene.images if name not in placed]:
        warn(f"{source}: {len(bare)} of {len(scene)} images have no camera: {_some(bare)}")
    return replace(scene, cameras=placed, points=points, origin=origin)


def _find(path: Path) -> Path | None:
    for place in _MODELS:
        if is_colmap_model(path / place):
            return path / place
    if (path / "transforms.json").is_file():
        return path / "transforms.json"
    for place in _CAMERA_FOLDERS:
        if any((path / place).glob("*.camera")):
            return path / place
    exports = [file for file in sorted(path.glob("*.json")) if _is_earth_studio(file)]
    if len(exports) > 1:
        raise InputError(f"{path}: two camera exports, {exports[0].name} and {exports[1].name}: say which one")
    return exports[0] if exports else None


def _is_earth_studio(path: Path) -> bool:
    try:
        document = json.loads(path.read_text(encoding="utf-8-sig"))
    except (OSError, ValueError):
        return False
    return isinstance(document, dict) and "cameraFrames" in document


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


class _Names:
    """Which image a camera's name means: the same name, or the only image with its last part, or with its stem."""

    def __init__(self, images: Iterable[str]) -> None:
        self._images: dict[str, str | None] = {}
        for name in images:
            for key in {Path(name).name, Path(name).stem} - {name}:
                self._images[key] = None if key in self._images else name
        self._images |= {name: name for name in images}

    def __call__(self, camera: str) -> str | None:
        path = Path(camera)
        inner = path.as_posix().removeprefix("images/")
        return next((found for key in (inner, path.name, path.stem) if (found := self._images.get(key))), None)


def _same_aspect(camera: Size, image: Size) -> bool:
    """Whether one was resized to the other, up to the rounding of a pixel in either size."""
    scale = image[0] / camera[0]
    return abs(camera[1] * scale - image[1]) <= 1 + scale


def _some(names: Sequence[str]) -> str:
    return ", ".join(names[:3]) + (", ..." if len(names) > 3 else "")
