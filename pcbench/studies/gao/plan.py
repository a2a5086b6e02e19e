"""The clouds to reconstruct from a scene, and the region to measure."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from pcbench.errors import InputError
from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.cameras import Camera
from pcbench.geometry.regions import Sphere

SPARSE, MVS, MEANS, SURFACE, FIELD = "sparse", "mvs", "splat-means", "splat-surface", "field"
SPLAT = "splat"  # workspace that both clouds of splats share
_REGION_SHARE = 0.4  # of the farthest camera's distance from the focus; on the paper's circles, the inner city
_MIN_EIGENVALUE = 0.01  # of the mean projection across the axes; below, the axes are nearly parallel

# As in the paper, but short enough for two cores: density=gao2025 takes 50,000 steps. The rates of density=classic suit
# fewer steps.
SPLAT_SETTINGS = {
    "start": "sfm",
    "density": "classic",
    "background": "black",
    "hold_out": "every",
    "steps": "2000",
    "sh_degree": "3",
}
# A radiance field stands for the networks that the paper compares with; its time is about that of splats.
_FIELD_SETTINGS = {"hold_out": "every", "steps": "2000"}
_RESERVED_SETTINGS = ("cloud", "seed", "poses")  # set by the experiment


@dataclass(frozen=True)
class Cities:
    """Cities to create if no scene is given: different kinds, with cameras on seven circles."""

    count: int = 3
    images: int = 48
    width: int = 320
    height: int = 180
    extent: float = 120.0


@dataclass(frozen=True)
class GaoJob:
    """Settings of the experiment.

    Attributes:
        scenes: folders for `read_scene`; if empty, cities are created.
        cities: cities to create.
        poses: `solve` solves the cameras once by `sfm`, as the paper does, and uses them for all clouds; `given` uses
            the cameras of the scene, which must cover all images.
        settings: settings of `splat`, which override `SPLAT_SETTINGS`.
        crop: region to measure, as text (see `pcbench.geometry.region_text`); None: a sphere around the focus of the
            cameras.
        image_scale: scale of the images of given scenes.
        time_limit: time limit per cloud, in seconds.
        seed: random seed.
    """

    scenes: tuple[Path, ...] = ()
    cities: Cities = field(default_factory=Cities)
    poses: Literal["solve", "given"] = "solve"
    settings: Mapping[str, str] = field(default_factory=dict)
    crop: str | None = None
    image_scale: float = 1.0
    time_limit: float | None = None
    seed: int = 0


class CloudMethod(NamedTuple):
    """A cloud to reconstruct.

    Attributes:
        name: name of the cloud.
        plugin: reconstructor.
        settings: settings of the reconstructor.
        workspace: name of the workspace; clouds with the same one share intermediate results.
    """

    name: str
    plugin: str
    settings: dict[str, str]
    workspace: str


def methods(job: GaoJob) -> list[CloudMethod]:
    """List the clouds in order: sparse, dense, the two clouds of one training of splats, and a radiance field.

    Raises:
        InputError: a setting of `splat` is one that the experiment sets.
    """
    if taken := [key for key in _RESERVED_SETTINGS if key in job.settings]:
        raise InputError(f"expected settings of splat that the experiment does not set itself, got {taken[0]}")
    if job.settings.get("hold_out") == "none":
        raise InputError("expected hold_out=every or hold_out=blocks, got none; the experiment measures novel views")
    seed = str(job.seed)
    splat = {**SPLAT_SETTINGS, **job.settings, "poses": "given", "seed": seed}
    return [
        CloudMethod(SPARSE, "sfm", {"poses": job.poses, "seed": seed}, SPARSE),
        CloudMethod(MVS, "mvs", {"poses": "given", "seed": seed}, MVS),
        CloudMethod(MEANS, "splat", {**splat, "cloud": "means"}, SPLAT),
        CloudMethod(SURFACE, "splat", {**splat, "cloud": "surface"}, SPLAT),
        CloudMethod(FIELD, "field", {**_FIELD_SETTINGS, "poses": "given", "seed": seed}, FIELD),
    ]


def focus_point(cameras: Iterable[Camera]) -> FloatArray | None:
    """Return the point (3,) closest to the axes of cameras, in least squares.

    Returns None if the axes are nearly parallel, or if the point is behind the cameras.
    """
    cameras = list(cameras)
    if len(cameras) < 2:
        return None
    positions = np.stack([camera.position for camera in cameras])
    axes = np.stack([camera.direction for camera in cameras])
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    matrix = across.mean(axis=0)
    if float(np.linalg.eigvalsh(matrix)[0]) < _MIN_EIGENVALUE:
        return None
    place: FloatArray = np.linalg.solve(matrix, np.einsum("nij,nj->i", across, positions) / len(cameras))
    ahead = np.einsum("ni,ni->n", place - positions, axes)
    return place if np.median(ahead) > 0 else None


def default_region(cameras: Iterable[Camera]) -> str:
    """Return the default region: a sphere around the focus of the cameras, or half of the reference without a focus.

    The sphere has the same content in any coordinate frame.
    """
    cameras = list(cameras)
    place = focus_point(cameras)
    if place is None:
        return "quantile:0.5"
    farthest = max(float(np.linalg.norm(camera.position - place)) for camera in cameras)
    return Sphere(place.round(3) + 0.0, round(_REGION_SHARE * farthest, 3)).text
