"""Files of a synthetic scene: images, cameras in COLMAP's and nerfstudio's formats, and the truth."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pcbench.errors import InputError
from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.cameras import Camera, Intrinsics
from pcbench.geometry.mesh import MeshIndex
from pcbench.io import write_cloud
from pcbench.io.colmap_model import write_colmap_model
from pcbench.io.ply import write_ply_mesh
from pcbench.io.transforms_json import write_transforms
from pcbench.progress import ProgressPlan
from pcbench.scenes.synthetic.demos import Demo
from pcbench.scenes.synthetic.layout import lay_out
from pcbench.scenes.synthetic.plan import CitySettings
from pcbench.scenes.synthetic.render import Optics, check_intrinsics, check_renderer, render
from pcbench.scenes.synthetic.rigs import Site, perturbed_positions, rig
from pcbench.scenes.synthetic.surface import build_city
from pcbench.scenes.synthetic.truth import depth_map, surface_cloud
from pcbench.scratch import lock_output, scratch_folder

_DEMO_MARKER = ".demo"  # file that marks a demo's folder


class DemoFiles(NamedTuple):
    """Paths of a demo's clouds."""

    reference: Path
    candidates: dict[str, Path]


@dataclass(frozen=True)
class SceneSettings:
    """Settings of a city and its images.

    Args:
        city: settings of the city.
        images: number of images.
        intrinsics: intrinsics of all images.
        rig: circles, grid, oblique, drone or orbit (`pcbench.scenes.synthetic.rigs`).
        optics: effects of lens and sensor.
        reflections: whether glass and water reflect their surroundings.
        points: number of points of the cloud in truth/.
        gps: standard deviation in metres of the positions in gps.txt; None writes no such file.
    """

    city: CitySettings = field(default_factory=CitySettings)
    images: int = 40
    intrinsics: Intrinsics = field(default_factory=lambda: Intrinsics.from_fov(960, 540, 40.0))
    rig: str = "circles"
    optics: Optics = field(default_factory=Optics)
    reflections: bool = False
    points: int = 1_000_000
    gps: float | None = None


def write_scene(out: Path, settings: SceneSettings, step: Callable[[str], None] = lambda _: None) -> None:
    """Create a city and write images/, transforms.json, sparse/0/ and truth/ (mesh.ply, cloud.ply, depth/) into `out`.

    `out` appears once it is complete. The same settings give the same bytes on the same machine.

    Args:
        out: folder to create.
        settings: city and images.
        step: called with a short text before each step that takes time.

    Raises:
        InputError: `out` exists and is not an empty folder, its parent is missing, or a setting is out of range.
        MissingExtra, NoFiguresError: images cannot be rendered on this machine.
    """
    check_renderer()
    check_intrinsics(settings.intrinsics)
    with _new_folder(out) as folder:
        progress = ProgressPlan(
            step, [2.0, 0.5 * settings.images, *([0.3] * settings.images), 2.0 + 5e-6 * settings.points]
        )
        progress("building the city")
        plan = lay_out(settings.city)
        site = Site(settings.city.extent, float(np.median(plan.terrain.heights)), plan.top)
        cameras = rig(settings.rig, settings.images, site, settings.intrinsics)
        city = build_city(plan, cameras=cameras)
        (folder / "images").mkdir()
        progress(f"rendering {len(cameras)} images")
        render(
            city,
            cameras,
            folder / "images",
            optics=settings.optics,
            reflections=settings.reflections,
            seed=settings.city.seed,
        )
        write_transforms(folder / "transforms.json", cameras)
        write_colmap_model(folder / "sparse" / "0", cameras)
        if settings.gps is not None:
            positions = perturbed_positions(cameras, settings.gps, settings.city.seed)
            _write_positions(folder / "gps.txt", cameras, positions)

        (folder / "truth" / "depth").mkdir(parents=True)
        index = MeshIndex(city.mesh)
        write_ply_mesh(folder / "truth" / "mesh.ply", city.mesh)
        for camera in cameras:
            progress(f"computing the depth map of {camera.name}")
            np.save(folder / "truth" / "depth" / f"{Path(camera.name).stem}.npy", depth_map(index, camera))
        progress("sampling the surface")
        cloud = surface_cloud(plan, index, cameras, settings.points, settings.city.seed)
        write_cloud(folder / "truth" / "cloud.ply", cloud)


def claim_demo_folder(out: Path) -> None:
    """Create the folder of a demo, and mark it as one, before the demo is computed.

    Args:
        out: folder of the demo; that of an earlier demo may be used again.

    Raises:
        InputError: it is a file, or a folder with other contents than an earlier demo.
        OSError: it cannot be created.
    """
    if out.exists() and not out.is_dir():
        raise InputError(f"{out}: expected a folder for the demo, got a file")
    if out.is_dir() and any(out.iterdir()) and not (out / _DEMO_MARKER).is_file():
        raise InputError(
            f"{out}: expected an empty folder or a demo, got a folder with other files; choose another one"
        )
    out.mkdir(parents=True, exist_ok=True)
    (out / _DEMO_MARKER).touch()


def write_demo(out: Path, demo: Demo) -> DemoFiles:
    """Write the clouds of a demo into `out`/clouds and replace those of an earlier demo.

    Args:
        out: folder of the demo, see `claim_demo_folder`.
        demo: clouds.

    Raises:
        OSError: a file cannot be written.
    """
    folder = out / "clouds"
    folder.mkdir(exist_ok=True)
    files = DemoFiles(folder / "reference.ply", {name: folder / f"{name}.ply" for name in demo.candidates})
    write_cloud(files.reference, demo.reference)
    for name, path in files.candidates.items():
        write_cloud(path, demo.candidates[name])
    return files


def _format_row(values: Sequence[float] | FloatArray) -> str:
    return " ".join(repr(float(v)) for v in values)


def _write_positions(path: Path, cameras: Sequence[Camera], positions: FloatArray) -> None:
    lines = ["# NAME X Y Z", *(f"{c.name} {_format_row(p)}" for c, p in zip(cameras, positions, strict=True))]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


@contextmanager
def _new_folder(out: Path) -> Iterator[Path]:
    """Yield a temporary folder beside `out` that is renamed to `out` on success and removed on failure."""
    if out.exists() and not out.is_dir():
        raise InputError(f"{out}: expected a folder to write the scene to, got a file")
    if out.is_dir() and any(out.iterdir()):
        raise InputError(f"{out}: expected an empty folder, got one with files; choose another one, or empty it")
    parent = out.resolve().parent
    if not parent.is_dir():
        raise InputError(f"{out}: expected an existing parent folder, got {parent}; create it first")
    with lock_output(out), scratch_folder(out) as scratch:
        yield scratch
        scratch.replace(out.resolve())
