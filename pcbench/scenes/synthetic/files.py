"""A synthetic scene's files: images, cameras as COLMAP and nerfstudio write them, and the truth."""

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
from pcbench.geometry.mesh import Mesh, MeshIndex
from pcbench.io import write_cloud
from pcbench.io.colmap_model import write_colmap_model
from pcbench.io.transforms_json import write_transforms
from pcbench.progress import Plan
from pcbench.scenes.synthetic.demos import Demo
from pcbench.scenes.synthetic.layout import lay_out
from pcbench.scenes.synthetic.plan import CitySettings
from pcbench.scenes.synthetic.render import Optics, check_intrinsics, check_renderer, render
from pcbench.scenes.synthetic.rigs import Site, perturbed_positions, rig
from pcbench.scenes.synthetic.surface import build_city
from pcbench.scenes.synthetic.truth import depth_map, surface_cloud
from pcbench.scratch import claim, scratch_folder

_DEMO_MARK = ".demo"  # the file by which a demo's folder is known


class DemoFiles(NamedTuple):
    """Where the clouds of a demo lie."""

    reference: Path
    candidates: dict[str, Path]


@dataclass(frozen=True)
class SceneSettings:
    """A city and how it is photographed.

    Args:
        images: how many.
        intrinsics: of all of them.
        rig: circles, grid, oblique, drone or orbit (`pcbench.scenes.synthetic.rigs`).
        reflections: glass and water mirror what is around them.
        points: of the true cloud.
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
    """Make a city and write images/, transforms.json, sparse/0/ and truth/ (mesh.ply, cloud.ply, depth/) into `out`.

    The folder appears when everything is in it. The same settings give the same bytes on one machine.

    Raises:
        InputError: `out` exists and is not an empty folder, or a setting is out of its range.
        MissingExtra, NoFiguresError: no picture can be taken here.
    """
    check_renderer()
    check_intrinsics(settings.intrinsics)
    with _new_folder(out) as folder:
        progress = Plan(step, [2.0, 0.5 * settings.images, *([0.3] * settings.images), 2.0 + 5e-6 * settings.points])
        progress("building the city")
        plan = lay_out(settings.city)
        site = Site(settings.city.extent, float(np.median(plan.terrain.heights)), plan.top)
        cameras = rig(settings.rig, settings.images, site, settings.intrinsics)
        city = build_city(plan, cameras=cameras)
        (folder / "images").mkdir()
        progress(f"taking {len(cameras)} images")
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
        write_mesh_ply(folder / "truth" / "mesh.ply", city.mesh)
        for camera in cameras:
            progress(f"casting the depths of {camera.name}")
            np.save(folder / "truth" / "depth" / f"{Path(camera.name).stem}.npy", depth_map(index, camera))
        progress("sampling the surface")
        cloud = surface_cloud(plan, index, cameras, settings.points, settings.city.seed)
        write_cloud(folder / "truth" / "cloud.ply", cloud)


def check_demo_folder(out: Path) -> None:
    """Say before a demo is made that `write_demo` may not write there.

    Raises:
        InputError: it is a file, or a folder that holds something else than an earlier demo.
    """
    if out.exists() and not out.is_dir():
        raise InputError(f"{out}: expected a folder for the demo, got a file")
    if out.is_dir() and any(out.iterdir()) and not (out / _DEMO_MARK).is_file():
        raise InputError(f"{out}: the folder is not empty and holds no demo: choose another one, or empty it")


def write_demo(out: Path, made: Demo) -> DemoFiles:
    """Write the clouds of a demo into `out`/clouds, in the place of an earlier demo's.

    Raises:
        InputError: the folder is not a demo's.
        OSError: a file cannot be written.
    """
    check_demo_folder(out)
    folder = out / "clouds"
    folder.mkdir(parents=True, exist_ok=True)
    (out / _DEMO_MARK).touch()
    files = DemoFiles(folder / "reference.ply", {name: folder / f"{name}.ply" for name in made.candidates})
    write_cloud(files.reference, made.reference)
    for name, path in files.candidates.items():
        write_cloud(path, made.candidates[name])
    return files


def _words(values: Sequence[float] | FloatArray) -> str:
    return " ".join(repr(float(v)) for v in values)


def _write_positions(path: Path, cameras: Sequence[Camera], positions: FloatArray) -> None:
    lines = ["# NAME X Y Z", *(f"{c.name} {_words(p)}" for c, p in zip(cameras, positions, strict=True))]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def write_mesh_ply(path: Path, mesh: Mesh) -> None:
    """Binary little-endian PLY: x y z double, faces as lists of int."""
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        *([f"comment unit {mesh.unit}"] if mesh.unit else []),
        f"element vertex {len(mesh.vertices)}",
        *(f"property double {axis}" for axis in "xyz"),
        f"element face {len(mesh)}",
        "property list uchar int vertex_indices",
        "end_header",
    ]
    faces = np.empty(len(mesh), dtype=[("count", "u1"), ("corners", "<i4", 3)])
    faces["count"], faces["corners"] = 3, mesh.faces
    with path.open("wb") as file:
        file.write(("\n".join(lines) + "\n").encode())
        file.write(mesh.vertices.astype("<f8").tobytes())
        file.write(faces.tobytes())


@contextmanager
def _new_folder(out: Path) -> Iterator[Path]:
    """A temporary folder beside `out` that becomes `out` when the block ends well, and vanishes when it does not."""
    if out.exists() and not out.is_dir():
        raise InputError(f"{out}: expected a folder to write the scene to, got a file")
    if out.is_dir() and any(out.iterdir()):
        raise InputError(f"{out}: the folder is not empty: choose another one, or empty it")
    parent = out.absolute().parent
    if not parent.is_dir():
        raise InputError(f"{out}: the folder {parent} does not exist: make it first")
    with claim(out), scratch_folder(out) as scratch:
        yield scratch
        scratch.replace(out.absolute())
