"""Scenes of the runs: a small city with exact truth, rendered once for each surface, and perturbed copies of it."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import numpy as np

from pcbench.extras import require
from pcbench.geometry.cameras import Intrinsics
from pcbench.io.transforms_json import write_transforms
from pcbench.plugins.stages import stage
from pcbench.scenes import read_scene
from pcbench.scenes.synthetic.files import SceneSettings, write_scene
from pcbench.scenes.synthetic.plan import CitySettings
from pcbench.scratch import atomic_write
from pcbench.studies.bench.score import EvaluationProtocol, Rules
from pcbench.studies.bench.truth import Truth, read_truth
from pcbench.studies.stress.descriptions import PhotographInfo
from pcbench.studies.stress.reconstructors.ladders import PHOTO_LADDERS, Photographs

THRESHOLD_PIXELS = 2.0
"""Threshold of the F-score, in pixels on the surface of the unperturbed scene."""

_IMAGES, _QUICK_IMAGES = 20, 10
_SIZE, _QUICK_SIZE = (240, 180), (160, 120)
_FIELD_OF_VIEW_DEG = 50.0  # vertical
_EXTENT, _QUICK_EXTENT = 120.0, 100.0  # m
_RIG = "oblique"
_SURFACE_POINTS = 100_000
_SCENE = "scene"  # folder in a stage


def base_settings(seed: int, *, quick: bool) -> SceneSettings:
    """Return the settings of the unperturbed scene of a seed: each seed gives another city."""
    width, height = _QUICK_SIZE if quick else _SIZE
    return SceneSettings(
        CitySettings(extent=_QUICK_EXTENT if quick else _EXTENT, seed=seed),
        _QUICK_IMAGES if quick else _IMAGES,
        Intrinsics.from_fov(width, height, _FIELD_OF_VIEW_DEG),
        _RIG,
        points=_SURFACE_POINTS,
    )


def rendered_scene(folder: Path, settings: SceneSettings) -> Path:
    """Return the folder of a rendered scene with its truth; it is rendered if an earlier run has not done it.

    Args:
        folder: existing folder of rendered scenes.
        settings: settings of the scene.

    Raises:
        MissingExtra, NoFiguresError: images cannot be rendered on this machine.
        OSError: a file cannot be written.
    """
    city = settings.city
    words = [f"seed{city.seed}", f"texture{city.texture:g}"]
    words += [name for name in ("water", "repeated", "symmetric") if getattr(city, name)]
    words += ["reflections"] if settings.reflections else []
    inputs = {"scene": asdict(settings)}
    return stage(folder, "_".join(words), inputs, lambda made: write_scene(made / _SCENE, settings)) / _SCENE


def read_photographs(folder: Path) -> Photographs:
    """Return the images and cameras of a rendered scene.

    Raises:
        InputError: the scene is damaged.
        OSError: a file cannot be read.
    """
    scene = read_scene(folder, on_warning=lambda _: None)
    return Photographs(
        tuple(scene.cameras[name] for name in scene.images), {name: scene.read_image(name) for name in scene.images}
    )


def write_photographs(folder: Path, photographs: Photographs) -> None:
    """Write photographs as a scene: lossless images, and cameras in transforms.json.

    Args:
        folder: existing folder.
        photographs: images and cameras.

    Raises:
        MissingExtra: Pillow is not installed.
        OSError: a file cannot be written.
    """
    pillow = require("PIL.Image")
    (folder / "images").mkdir()
    for camera in photographs.cameras:
        with atomic_write(folder / "images" / camera.name) as file:
            pillow.fromarray(np.ascontiguousarray(photographs.images[camera.name])).save(file, format="PNG")
    write_transforms(folder / "transforms.json", photographs.cameras)


def perturbed_photographs(scene: Path, ladder: str, level: float, seed: int) -> Photographs:
    """Return the photographs of a rendered scene, perturbed to a level; the same arguments give the same result.

    Args:
        scene: folder of the rendered scene of the level.
        ladder: name of the ladder; any other name leaves the photographs unperturbed.
        level: level of the ladder.
        seed: random seed.
    """
    photographs = read_photographs(scene)
    if ladder not in PHOTO_LADDERS:
        return photographs
    rng = np.random.default_rng([seed, *ladder.encode()])
    return PHOTO_LADDERS[ladder].apply(photographs, level, rng)


def read_scene_truth(scene: Path) -> Truth:
    """Return the truth of a rendered scene: its surface, its cameras, and what three of them saw.

    Raises:
        InputError: the truth is damaged.
        OSError: a file cannot be read.
    """
    truth = scene / "truth"
    cameras = {camera.name: camera for camera in read_photographs(scene).cameras}
    return read_truth(truth / "cloud.ply", truth / "mesh.ply", cameras, lambda _: None)


def protocol_of(truth: Truth, extent: float, threshold: float) -> EvaluationProtocol:
    """Return how clouds are measured: inside the city, with one threshold in metres.

    Args:
        truth: truth of the scene.
        extent: side of the city, in metres; the fields around it are not measured.
        threshold: threshold of the F-score, in metres.
    """
    half = extent / 2
    crop = f"box:{-half:g},{-half:g},-100,{half:g},{half:g},200"
    return EvaluationProtocol.from_rules(truth, Rules(crop=crop, threshold=repr(threshold)))


def photograph_info(settings: SceneSettings, truth: Truth) -> PhotographInfo:
    """Return the description of an unperturbed scene."""
    assert truth.pixel is not None  # the cameras of a city see it
    k = settings.intrinsics
    return PhotographInfo(
        settings.images,
        (k.width, k.height),
        settings.rig,
        settings.city.extent,
        truth.pixel,
        THRESHOLD_PIXELS * truth.pixel,
        len(truth.cloud),
    )
