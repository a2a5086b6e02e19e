"""Photographs of a city: OpenGL through VTK in a process of its own, then the lens, the exposure and the sensor."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from pcbench.children import Limits, run_module
from pcbench.errors import InputError, PcbenchError
from pcbench.extras import require
from pcbench.geometry.cameras import Camera, Intrinsics
from pcbench.opengl import OFF_SCREEN, check_opengl
from pcbench.scenes.synthetic.surface import CitySurface
from pcbench.scratch import scratch_folder

_MAX_SECONDS = 120  # an image: software OpenGL needs a second for a megapixel
_MAX_SIDE = 8192  # pixels along a side of an image, or of what the lens bends into it


@dataclass(frozen=True)
class Optics:
    """What a lens and a sensor do to an image.

    Args:
        exposure: standard deviation of the logarithm of each image's gain.
        blur: standard deviation of the lens's blur in pixels.
        noise: standard deviation of the sensor's noise in grey levels of 255.
        vignetting: 1: pixels get light by the fourth power of the cosine of their rays' angles with the axis (natural
            vignetting), 0: all the same; in between a part of the loss.
    """

    exposure: float = 0.05
    blur: float = 0.4
    noise: float = 1.5
    vignetting: float = 0.0


def check_renderer() -> None:
    """Say before anything is computed that no picture can be taken here.

    Raises:
        MissingExtra: pyvista or Pillow is not installed or does not load.
        NoFiguresError: neither a display nor EGL nor OSMesa is there.
    """
    check_opengl()  # before VTK, which pyvista imports
    require("PIL", "plot")
    require("pyvista")


def check_intrinsics(intrinsics: Intrinsics) -> None:
    """Say before anything is computed that no picture can be taken with this camera.

    Raises:
        InputError: the image is too large, or its distortion folds it over.
    """
    drawn = 2 * intrinsics.widest * max(intrinsics.fx, intrinsics.fy)
    if drawn.max() > _MAX_SIDE:
        raise InputError(
            f"expected images of at most {_MAX_SIDE} pixels along a side (less where the lens widens them),"
            f" got {intrinsics.width} x {intrinsics.height}"
        )


def render(
    city: CitySurface,
    cameras: Sequence[Camera],
    folder: Path,
    *,
    optics: Optics | None = None,
    reflections: bool = False,
    seed: int = 0,
) -> None:
    """Write a photograph for each camera, by its name, into an existing folder.

    Args:
        reflections: glass and water mirror what is around them, once, without the sun's own glint.

    Raises:
        InputError: an image is too large, or a lens folds it over.
        MissingExtra, NoFiguresError: a library is missing.
        PcbenchError: drawing fails.
    """
    check_renderer()
    for camera in cameras:
        check_intrinsics(camera.intrinsics)
    with scratch_folder() as scratch:
        job = scratch
        corners = city.mesh.vertices[city.mesh.faces].astype(np.float32)  # the city is small and about the origin
        np.savez(job / "faces.npz", corners=corners, uv=city.uv, page=city.page, shade=city.shade)
        for number, page in enumerate(city.pages):
            np.save(job / f"page{number}.npy", page)
        for number, mirror in enumerate(city.mirrors):
            if mirror is not None:
                np.save(job / f"mirror{number}.npy", mirror)
        rows = [
            {
                "name": camera.name,
                "intrinsics": asdict(camera.intrinsics),
                "rotation": camera.cam_from_world.rotation.tolist(),
                "translation": camera.cam_from_world.translation.tolist(),
            }
            for camera in cameras
        ]
        values = {"cameras": rows, "optics": asdict(optics or Optics()), "reflections": reflections, "seed": seed}
        (job / "job.json").write_text(json.dumps(values))
        done = run_module(
            "pcbench.scenes.synthetic.render_worker",
            str(job),
            str(folder.absolute()),
            limits=Limits(seconds=_MAX_SECONDS * (1 + len(cameras))),
            environment=OFF_SCREEN,
        )
    if done.timed_out:
        raise PcbenchError(f"no images: drawing took longer than {_MAX_SECONDS} s an image")
    missing = [camera.name for camera in cameras if not (folder / camera.name).is_file()]
    if done.code != 0 or missing:
        raise PcbenchError(f"no images: drawing failed ({done.last_words or 'it crashed'})")
