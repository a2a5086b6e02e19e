"""Ladders of perturbed photographs: each perturbs one property of a scene, from little to certain failure.

Images and cameras are perturbed as arrays; the surface of the city and its reflections are rendered again. Random
numbers do not depend on the level: along a ladder the severity alone changes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.cameras import Camera
from pcbench.geometry.transform import Similarity
from pcbench.scenes.synthetic.files import SceneSettings
from pcbench.studies.stress.descriptions import LadderInfo
from pcbench.studies.stress.ladders.ladder import PlannedLadder, choose, rotation
from pcbench.studies.stress.reconstructors.reconstruction import RECONSTRUCTION

_BLUR_REACH = 4.0  # standard deviations at which the kernel of a blur ends
_MAX_GREY = 255.0

Image = NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class Photographs:
    """Images with their cameras; functions return new ones and leave the given ones unchanged.

    Attributes:
        cameras: cameras as a reconstructor gets them, in the order of the flight.
        images: (height, width, 3) sRGB images by the names of the cameras.
    """

    cameras: tuple[Camera, ...]
    images: Mapping[str, Image]

    def with_images(self, change: Callable[[Image], Image]) -> Photographs:
        """Return the photographs with a function applied to each image."""
        return replace(self, images={camera.name: change(self.images[camera.name]) for camera in self.cameras})

    def with_cameras(self, change: Callable[[Camera], Camera]) -> Photographs:
        """Return the photographs with a function applied to each camera."""
        return replace(self, cameras=tuple(map(change, self.cameras)))


Perturb = Callable[[Photographs, float, np.random.Generator], Photographs]
Render = Callable[[SceneSettings, float], SceneSettings]


@dataclass(frozen=True)
class PhotoLadder(PlannedLadder):
    """A perturbation of a scene of photographs; its levels leave out the one that changes nothing.

    Attributes:
        start: level that changes nothing, as the unperturbed run has it.
        perturb: function of photographs, level and random generator; None if the scene is rendered again.
        render: function of the settings of the scene and the level; None if the photographs are perturbed.
        level_names: names of the levels of a list of cases.
    """

    start: float
    perturb: Perturb | None = None
    render: Render | None = None
    level_names: tuple[str, ...] = ()

    def apply(self, photographs: Photographs, level: float, rng: np.random.Generator) -> Photographs:
        """Return the photographs perturbed to a level; those of a scene that is rendered again are returned as given.

        The start of the ladder returns the photographs unchanged.
        """
        if self.perturb is None or level == self.start:
            return photographs
        return self.perturb(photographs, level, rng)

    def scene(self, base: SceneSettings, level: float) -> SceneSettings:
        """Return the settings of the scene to render for a level."""
        return base if self.render is None else self.render(base, level)

    def info(self, *, quick: bool) -> LadderInfo:
        """Return the description for results, with the levels of the quick or of the full plan."""
        return self.describe((RECONSTRUCTION,), self.level_names, quick=quick)


def selected(only: str | None, *, quick: bool) -> tuple[PhotoLadder, ...]:
    """Return the ladders of a plan whose name or kind contains a text; all of them without one.

    Raises:
        InputError: no ladder matches.
    """
    return choose(
        PHOTO_LADDERS.values(),
        only,
        quick=quick,
        texts_of=lambda ladder: (ladder.name, ladder.kind),
        searched="name or kind",
    )


def linear_light(image: Image) -> NDArray[np.float32]:
    """Return the linear light of an sRGB image, 0 to 1 (IEC 61966-2-1)."""
    value = np.arange(int(_MAX_GREY) + 1) / _MAX_GREY
    table = np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4).astype(np.float32)
    return table[image]


def srgb(light: NDArray[np.float32]) -> Image:
    """Return the sRGB image of linear light; light above 1 is saturated."""
    light = np.clip(light, 0, 1)
    value = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    return np.asarray(np.round(_MAX_GREY * value), np.uint8)


def _fewer(photographs: Photographs, level: float, rng: np.random.Generator) -> Photographs:
    """Keep a share of the images, chosen at random; the images of a level are among those of all easier ones."""
    count = max(1, round(level / 100 * len(photographs.cameras)))
    kept = set(rng.permutation(len(photographs.cameras))[:count].tolist())
    cameras = tuple(camera for number, camera in enumerate(photographs.cameras) if number in kept)
    return Photographs(cameras, {camera.name: photographs.images[camera.name] for camera in cameras})


def _cropped(photographs: Photographs, level: float, _: np.random.Generator) -> Photographs:
    """Cut images to a share of each side about the middle: less overlap, at the same resolution and focal length."""
    cameras, images = [], {}
    for camera in photographs.cameras:
        k = camera.intrinsics
        width, height = (max(1, round(level / 100 * side)) for side in (k.width, k.height))
        left, top = (k.width - width) // 2, (k.height - height) // 2
        intrinsics = replace(k, width=width, height=height, cx=k.cx - left, cy=k.cy - top)
        cameras.append(replace(camera, intrinsics=intrinsics))
        images[camera.name] = photographs.images[camera.name][top : top + height, left : left + width]
    return Photographs(tuple(cameras), images)


def _blurred(photographs: Photographs, level: float, _: np.random.Generator) -> Photographs:
    """Blur linear light by a Gaussian whose standard deviation is the level, in pixels."""
    reach = int(np.ceil(_BLUR_REACH * level))
    kernel = np.exp(-0.5 * np.square(np.arange(-reach, reach + 1) / level))
    kernel = (kernel / kernel.sum()).astype(np.float32)

    def blur(image: Image) -> Image:
        light = linear_light(image)
        for axis in (0, 1):
            pad = [(reach, reach) if dimension == axis else (0, 0) for dimension in range(3)]
            windows = np.lib.stride_tricks.sliding_window_view(np.pad(light, pad, mode="edge"), len(kernel), axis)
            light = windows @ kernel
        return srgb(light)

    return photographs.with_images(blur)


def _exposed(photographs: Photographs, level: float, rng: np.random.Generator) -> Photographs:
    """Multiply the linear light of each image by 2 to the power of a normal number whose deviation is the level."""
    stops = dict(zip(photographs.images, rng.normal(size=len(photographs.images)), strict=True))
    images = {
        name: srgb(linear_light(image) * np.float32(2.0 ** (level * stops[name])))
        for name, image in photographs.images.items()
    }
    return replace(photographs, images=images)


def _shifted(photographs: Photographs, level: float, rng: np.random.Generator) -> Photographs:
    """Add normal errors of this standard deviation along each axis to the positions of the cameras."""

    def shift(camera: Camera) -> Camera:
        return _posed(camera, camera.cam_from_world.rotation, camera.position + level * rng.normal(size=3))

    return photographs.with_cameras(shift)


def _turned(photographs: Photographs, level: float, rng: np.random.Generator) -> Photographs:
    """Rotate each camera about its centre; the rotation vector has this standard deviation along each axis."""

    def turn(camera: Camera) -> Camera:
        vector: FloatArray = rng.normal(size=3)
        length = float(np.linalg.norm(vector))
        error = rotation(vector / length, np.radians(level) * length)
        return _posed(camera, error @ camera.cam_from_world.rotation, camera.position)

    return photographs.with_cameras(turn)


def _zoomed(photographs: Photographs, level: float, _: np.random.Generator) -> Photographs:
    """Enlarge the focal lengths of all cameras by this percentage; the images stay as they are."""
    factor = 1 + level / 100

    def zoom(camera: Camera) -> Camera:
        k = camera.intrinsics
        return replace(camera, intrinsics=replace(k, fx=factor * k.fx, fy=factor * k.fy))

    return photographs.with_cameras(zoom)


def _posed(camera: Camera, R: FloatArray, position: FloatArray) -> Camera:
    return replace(camera, cam_from_world=Similarity(R, -R @ position))


def _textured(base: SceneSettings, level: float) -> SceneSettings:
    return replace(base, city=replace(base.city, texture=level))


def _difficult(base: SceneSettings, level: float) -> SceneSettings:
    """Return the scene of a case, in the order of `level_names`."""
    city = base.city
    return (
        replace(base, city=replace(city, repeated=True)),
        replace(base, city=replace(city, water=True)),
        replace(base, city=replace(city, water=True), reflections=True),
        replace(base, city=replace(city, symmetric=True)),
        replace(base, city=city.hard()),
    )[int(level)]


PHOTO_LADDERS = {
    ladder.name: ladder
    for ladder in (
        PhotoLadder("fewer-images", "images kept", "images", "%", (80, 60, 40, 30, 20), (80, 40), 100, _fewer),
        PhotoLadder("crop", "side of the images kept", "images", "%", (80, 65, 50, 35, 25), (), 100, _cropped),
        PhotoLadder("blur", "blur", "images", "px", (0.5, 1, 2, 4, 8), (1, 4), 0, _blurred),
        PhotoLadder("exposure", "exposure jitter", "images", "stops", (0.25, 0.5, 1, 2, 4), (), 0, _exposed),
        PhotoLadder(
            "positions", "errors of camera positions", "cameras", "m", (0.1, 0.3, 1, 3, 10), (0.3, 3), 0, _shifted
        ),
        PhotoLadder("rotations", "errors of camera rotations", "cameras", "deg", (0.1, 0.3, 1, 3, 10), (), 0, _turned),
        PhotoLadder("focal-length", "error of the focal length", "cameras", "%", (1, 2, 5, 10, 30), (), 0, _zoomed),
        PhotoLadder("texture", "texture", "surface", "", (0.5, 0.25, 0.1, 0), (), 1, render=_textured),
        PhotoLadder(
            "difficult",
            "difficult surface",
            "surface",
            "",
            (0, 1, 2, 3, 4),
            (),
            -1,
            render=_difficult,
            level_names=("repeated facades", "lakes", "lakes that reflect", "half-turn symmetry", "hard city"),
        ),
    )
}
