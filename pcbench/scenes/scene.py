"""Scene: photographs and their known cameras, the input of a reconstructor."""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pcbench.errors import InputError
from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.cameras import Camera, Intrinsics
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.geodesy import Gps, enu_from_wgs84
from pcbench.geometry.transform import Similarity
from pcbench.io.contents import digest
from pcbench.io.earth_studio import wgs84_from_sphere
from pcbench.io.image_header import JPEG_AND_PNG
from pcbench.scenes.decode import Size, decode_alpha, decode_image, decode_mask, opaque_pixels, resize_image
from pcbench.scenes.folders import scene_name
from pcbench.scenes.splits import Split, split_blocks, split_every


def cameras_in_wgs84(cameras: Mapping[str, Camera], origin: Gps) -> dict[str, Camera]:
    """Convert cameras in east-north-up from Earth Studio's sphere to WGS84, about the same origin."""
    moved = {}
    for name, camera in cameras.items():
        rotation = camera.cam_from_world.rotation
        position = wgs84_from_sphere(camera.position[None], origin)[0]
        moved[name] = replace(camera, cam_from_world=Similarity(rotation, -rotation @ position))
    return moved


@dataclass(frozen=True, eq=False)
class Scene:
    """Photographs, optionally with cameras, GPS positions and masks. Use `read_scene` to create one.

    Args:
        folder: folder of the images.
        images: image names relative to the folder, in natural order (frame_2 before frame_10).
        sizes: stored size (width, height) of each image, in pixels.
        cameras: cameras by image name, at the working size; images without a camera are absent.
        gps: GPS positions from EXIF by image name.
        positions: measured positions (3,) from gps.txt by image name, in metres in their own frame.
        masks: mask files by image name. A mask has the size of its image; black pixels are excluded.
        with_alpha: names of the images with an alpha channel. Pixels that are at least half transparent are excluded.
        image_scale: working size relative to the stored size, 0 < scale <= 1.
        points: sparse points in the frame of the cameras, if available.
        origin: geographic position of (0, 0, 0) in the frame of the cameras (x east, y north, z up), if known.
        on_sphere: whether the cameras are in metres on Earth Studio's sphere, whose lengths are up to 0.6 % off WGS84.
        intrinsics: intrinsics by image name, at the working size, of images without a camera.
    """

    folder: Path
    images: tuple[str, ...]
    sizes: Mapping[str, Size]
    cameras: Mapping[str, Camera] = field(default_factory=dict)
    gps: Mapping[str, Gps] = field(default_factory=dict)
    positions: Mapping[str, FloatArray] = field(default_factory=dict)
    masks: Mapping[str, Path] = field(default_factory=dict)
    with_alpha: frozenset[str] = frozenset()
    image_scale: float = 1.0
    points: Cloud | None = None
    origin: Gps | None = None
    on_sphere: bool = False
    intrinsics: Mapping[str, Intrinsics] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.images)

    @property
    def name(self) -> str:
        """Name of the scene: its folder's name, or that of the parent of `images/` and similar."""
        return scene_name(self.folder)

    def size(self, name: str) -> Size:
        """Return the working size (width, height) of an image, in pixels."""
        width, height = self.sizes[name]
        return max(1, round(width * self.image_scale)), max(1, round(height * self.image_scale))

    def read_image(self, name: str) -> NDArray[np.uint8]:
        """Read an image at the working size, (height, width, 3) RGB; transparent pixels are composited over black.

        Raises:
            InputError: the image cannot be decoded.
            MissingExtra: Pillow is not installed.
        """
        return decode_image(self.folder / name, self.size(name))

    def read_mask(self, name: str) -> NDArray[np.bool_] | None:
        """Read the mask of valid pixels, (height, width) at the working size; None if all are valid.

        Pixels are valid if the mask is not black there and the image is more than half opaque.

        Raises:
            InputError: the mask or the image cannot be decoded.
            MissingExtra: Pillow is not installed.
        """
        mask = decode_mask(self.masks[name], self.size(name)) if name in self.masks else None
        alpha = self.read_alpha(name)
        if alpha is None:
            return mask
        return opaque_pixels(alpha) if mask is None else mask & opaque_pixels(alpha)

    def read_alpha(self, name: str) -> NDArray[np.uint8] | None:
        """Read the alpha channel of an image, (height, width) at the working size; None if all pixels are opaque.

        Raises:
            InputError: the image cannot be decoded.
            MissingExtra: Pillow is not installed.
        """
        return decode_alpha(self.folder / name, self.size(name)) if name in self.with_alpha else None

    def write_images(self, folder: Path) -> None:
        """Write the images at the working size to a folder: JPEG at quality 97 with full chroma, or lossless PNG.

        TIFF and WebP images become PNG under their names. JPEG and PNG images that keep their size are copied.

        Raises:
            InputError: an image cannot be decoded.
            MissingExtra: Pillow is not installed.
            OSError: a file cannot be written.
        """
        for name in self.images:
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            if self.size(name) == self.sizes[name] and name.lower().endswith(JPEG_AND_PNG):
                shutil.copyfile(self.folder / name, folder / name)
            else:
                resize_image(self.folder / name, folder / name, self.size(name))

    @property
    def gps_origin(self) -> Gps | None:
        """Origin of the frame of `measured_positions`: the first position in EXIF; None without one, or in gps.txt."""
        named = next((name for name in self.images if name in self.gps), None)
        return None if self.positions or named is None else self.gps[named]

    def measured_positions(self) -> tuple[dict[str, FloatArray], str]:
        """Return the measured positions (3,) of images by name, in metres, and a description of their frame.

        The frame is that of gps.txt, or east-north-up about the first image with a position in EXIF.
        """
        if self.positions:
            return dict(self.positions), "in the frame of gps.txt"
        origin = self.gps_origin
        if origin is None:
            return {}, ""
        enu = enu_from_wgs84(list(self.gps.values()), origin)
        where = f"{origin.latitude_deg:.7f}, {origin.longitude_deg:.7f}, {origin.altitude:.2f} m"
        return dict(zip(self.gps, enu, strict=True)), f"east-north-up about {where}"

    def in_wgs84(self) -> Scene:
        """Return the scene with its cameras converted from Earth Studio's sphere to WGS84 metres.

        Latitudes, longitudes and altitudes stay the same. The images show the sphere: with the converted cameras,
        matches are off by one or two pixels. Reconstruct with the original cameras and convert the cloud instead
        (`pcbench reconstruct --wgs84`).

        Raises:
            InputError: the cameras are not from Earth Studio.
        """
        origin = self.sphere_origin()
        return replace(self, cameras=cameras_in_wgs84(self.cameras, origin), on_sphere=False)

    def sphere_origin(self) -> Gps:
        """Return the origin of cameras that are in metres on Earth Studio's sphere.

        Raises:
            InputError: the cameras are not on the sphere.
        """
        if not self.on_sphere or self.origin is None:
            raise InputError(
                f"{self.folder}: expected Earth Studio cameras for WGS84 metres, got others: leave out --wgs84"
            )
        return self.origin

    def select(self, names: Collection[str]) -> Scene:
        """Return the scene with only the given images.

        Raises:
            InputError: a name is not in the scene, or none is given.
        """
        if unknown := sorted(set(names) - set(self.images)):
            raise InputError(f"expected names of images such as {self.images[0]!r}, got {unknown[0]!r}")
        selected = tuple(name for name in self.images if name in set(names))
        if not selected:
            raise InputError("expected at least one image, got none")
        return replace(
            self,
            images=selected,
            sizes={name: self.sizes[name] for name in selected},
            cameras={name: self.cameras[name] for name in selected if name in self.cameras},
            gps={name: self.gps[name] for name in selected if name in self.gps},
            positions={name: self.positions[name] for name in selected if name in self.positions},
            masks={name: self.masks[name] for name in selected if name in self.masks},
            with_alpha=self.with_alpha.intersection(selected),
            intrinsics={name: self.intrinsics[name] for name in selected if name in self.intrinsics},
        )

    def split_every(self, n: int = 8) -> tuple[Scene, Scene]:
        """Split into training and test images with `pcbench.scenes.splits.split_every`: every n-th is a test image.

        Test views are close to training views.

        Raises:
            InputError: there are too few images.
        """
        return self._select_split(split_every(self.images, n))

    def split_blocks(self, n: int = 8, blocks: int = 8) -> tuple[Scene, Scene]:
        """Split into training and test images with `pcbench.scenes.splits.split_blocks`.

        About one in n images is a test image: the sequence is divided into equal parts, and a run of images in the
        middle of each part is held out. Most test views are far from training views, so this is harder than
        `split_every`.

        Raises:
            InputError: there are too few images.
        """
        positions = {name: camera.position for name, camera in self.cameras.items()}
        return self._select_split(split_blocks(self.images, blocks, 1 / n, positions))

    def _select_split(self, split: Split) -> tuple[Scene, Scene]:
        return self.select(split.train), self.select(split.test)

    @cached_property
    def _digests(self) -> dict[str, tuple[str, str]]:
        """SHA-256 of each image and its mask, computed once because the files may be gigabytes."""
        mask = {name: digest(path) for name, path in self.masks.items()}
        return {name: (digest(self.folder / name), mask.get(name, "")) for name in self.images}

    def describe(self) -> list[str]:
        """Describe the scene in a few lines for users."""
        sizes = sorted({self.size(name) for name in self.images})
        sizes_text = first_names([f"{width} x {height}" for width, height in sizes])
        lines = [f"{self.folder}: {len(self)} images of {sizes_text}"]
        lines.append(f"  cameras {len(self.cameras)}, GPS {len(self.positions or self.gps)}, masks {len(self.masks)}")
        if self.cameras:
            positions = np.stack([camera.position for camera in self.cameras.values()])
            extent = " x ".join(f"{length:.4g}" for length in np.ptp(positions, axis=0))
            kinds = len({camera.intrinsics for camera in self.cameras.values()})
            unit = "" if self.origin is None else " m"
            sets = "one set" if kinds == 1 else f"{kinds} sets"
            lines.append(f"  cameras span {extent}{unit}, {sets} of intrinsics")
        if self.with_alpha:
            lines.append(f"  alpha channel in {len(self.with_alpha)} images; transparent pixels count as masked")
        if self.intrinsics:
            lines.append(f"  intrinsics for {len(self.intrinsics)} images without a camera")
        if self.points is not None:
            lines.append(f"  sparse points {len(self.points):,}")
        if self.origin is not None:
            origin = self.origin
            lines.append(
                f"  east-north-up about {origin.latitude_deg:.7f}, {origin.longitude_deg:.7f}, {origin.altitude:.1f} m"
            )
            if not self.on_sphere:
                lines.append("  metres of WGS84")
        return lines

    def fingerprint(self, *, cameras: bool = True) -> str:
        """Return the SHA-256 of the inputs of a reconstruction.

        Args:
            cameras: whether cameras and intrinsics count, besides images, masks, scale and measured positions.
        """
        combined = hashlib.sha256(repr(self.image_scale).encode())
        for name in self.images:
            combined.update(f"{name}\0{self._digests[name]}\0{self.gps.get(name)}\0".encode())
            combined.update(self.positions[name].tobytes() if name in self.positions else b"")
            if cameras and name in self.cameras:
                camera = self.cameras[name]
                combined.update(repr(camera.intrinsics).encode() + camera.cam_from_world.matrix.tobytes())
            elif cameras and name in self.intrinsics:
                combined.update(repr(self.intrinsics[name]).encode())
        return combined.hexdigest()


def first_names(names: Sequence[str]) -> str:
    """Return the first three names for a note, and dots if there are more."""
    return ", ".join(names[:3]) + (", ..." if len(names) > 3 else "")
