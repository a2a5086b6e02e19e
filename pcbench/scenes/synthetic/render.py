"""Images of a city: OpenGL rendering by VTK in a separate process, then lens, exposure and sensor effects."""

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
from pcbench.opengl import OFF_SCREEN_ENVIRONMENT, check_opengl
from pcbench.scenes.synthetic.surface import CitySurface
from pcbench.scratch import scratch_folder

_MAX_SECONDS_PER_IMAGE = 120  # software OpenGL needs about one second per megapixel
_MAX_SIDE_PX = 8192  # of an image, or of the larger pinhole image from which a distorted one is computed


@dataclass(frozen=True)
class Optics:
    """Effects of lens and sensor on an image.

    Args:
        exposure: standard deviation of the logarithm of the gain, which varies between images.
        blur: standard deviation of the lens blur in pixels.
        noise: standard deviation of the sensor noise in grey levels of 255.
        vignetting: share of natural vignetting. 1: light falls with the fourth power of the cosine of the angle between
            a pixel's ray and the optical axis; 0: none.
    """

    exposure: float = 0.05
    blur: float = 0.4
    noise: float = 1.5
    vignetting: float = 0.0


def check_renderer() -> None:
    """Check that images can be rendered, before anything is computed.

    Raises:
        MissingExtra: pyvista or Pillow is not installed or does not load.
        NoFiguresError: there is neither a display nor EGL nor OSMesa.
    """
    check_opengl()  # before VTK, which pyvista imports
    require("PIL", "plot")
    require("pyvista")


def check_intrinsics(intrinsics: Intrinsics) -> None:
    """Check that a camera can be rendered, before anything is computed.

    Args:
        intrinsics: intrinsics of the camera.

    Raises:
        InputError: the image is too large, or its distortion is not invertible.
    """
    rendered_size = 2 * intrinsics.widest * max(intrinsics.fx, intrinsics.fy)
    if rendered_size.max() > _MAX_SIDE_PX:
        raise InputError(
            f"expected images of at most {_MAX_SIDE_PX} pixels along a side (less if the distortion widens them),"
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
    """Render one image per camera, named after it, into an existing folder.

    Args:
        city: city with textures.
        cameras: cameras.
        folder: folder of the images.
        optics: effects of lens and sensor.
        reflections: whether glass and water reflect their surroundings: one reflection, without the sun's glint.
        seed: random seed.

    Raises:
        InputError: an image is too large, or its distortion is not invertible.
        MissingExtra, NoFiguresError: images cannot be rendered on this machine.
        PcbenchError: rendering fails.
    """
    check_renderer()
    for camera in cameras:
        check_intrinsics(camera.intrinsics)
    with scratch_folder() as scratch:
        job = scratch
        corners = city.mesh.vertices[city.mesh.faces].astype(np.float32)  # precise enough near the origin
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
        process = run_module(
            "pcbench.scenes.synthetic.render_worker",
            str(job),
            str(folder.absolute()),
            limits=Limits(seconds=_MAX_SECONDS_PER_IMAGE * (1 + len(cameras))),
            environment=OFF_SCREEN_ENVIRONMENT,
        )
    if process.timed_out:
        raise PcbenchError(f"no images: rendering took longer than {_MAX_SECONDS_PER_IMAGE} s per image")
    missing = [camera.name for camera in cameras if not (folder / camera.name).is_file()]
    if process.code != 0 or missing:
        raise PcbenchError(f"no images: rendering failed ({process.last_error_line or 'it crashed'})")
