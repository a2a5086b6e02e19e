"""What is made of a scene, and where it is measured."""

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

SPARSE, MVS, MEANS, SURFACE = "sparse", "mvs", "splat-means", "splat-surface"
SPLAT = "splat"  # the workspace of both
_REGION_SHARE = 0.4  # of the farthest camera's distance from what all look at: on the paper's circles, the inner city
_MIN_EIGENVALUE = 0.01  # of a direction: what axes that are so nearly parallel meet at is left to chance

# As the paper has it, as far as two cores get: its densification begins at step 1000 of 30,000 and more, so the rules
# of the method that it follows are the default, whose rates here are for fewer steps.
SPLAT_SETTINGS = {"start": "sfm", "density": "classic", "hold_out": "every", "steps": "2000", "sh_degree": "3"}
_RESERVED_SETTINGS = ("cloud", "seed", "poses")  # settings that the experiment makes itself


@dataclass(frozen=True)
class Cities:
    """What to make where no scene is given: cities of different kinds, photographed from seven circles."""

    count: int = 3
    images: int = 48
    width: int = 320
    height: int = 180
    extent: float = 120.0


@dataclass(frozen=True)
class GaoJob:
    """The experiment.

    Attributes:
        scenes: folders as `read_scene` reads them; none: cities are made.
        poses: `solve` finds the cameras once, by `sfm`, as the paper does, and every cloud has these; `given` takes
            those of the scene, which needs some for all images then.
        settings: of `splat`, in place of those of `SPLAT_SETTINGS`.
        crop: region that is measured, as `pcbench.geometry.region_text` has it; None: a sphere about the place that the
            cameras look at.
        image_scale: of the images of given scenes.
        time_limit: seconds, of one cloud.
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
    """A cloud that is made.

    Attributes:
        name: of the cloud.
        plugin: the reconstructor.
        settings: of it.
        workspace: clouds with the same one share what is made on the way.
    """

    name: str
    plugin: str
    settings: dict[str, str]
    workspace: str


def methods(job: GaoJob) -> list[CloudMethod]:
    """Sparse, dense, and the two clouds of one training, in the order in which they are made.

    Raises:
        InputError: a setting of `splat` is one that the experiment makes.
    """
    if taken := [key for key in _RESERVED_SETTINGS if key in job.settings]:
        raise InputError(f"expected settings of splat that the experiment leaves open, got {taken[0]}")
    if job.settings.get("hold_out") == "none":
        raise InputError("expected hold_out=every or hold_out=blocks: new views are measured too")
    seed = str(job.seed)
    splat = {**SPLAT_SETTINGS, **job.settings, "poses": "given", "seed": seed}
    return [
        CloudMethod(SPARSE, "sfm", {"poses": job.poses, "seed": seed}, SPARSE),
        CloudMethod(MVS, "mvs", {"poses": "given", "seed": seed}, MVS),
        CloudMethod(MEANS, "splat", {**splat, "cloud": "means"}, SPLAT),
        CloudMethod(SURFACE, "splat", {**splat, "cloud": "surface"}, SPLAT),
    ]


def focus_point(cameras: Iterable[Camera]) -> FloatArray | None:
    """The place (3,) that is nearest to the axes of cameras, in least squares; None where these are nearly parallel, or
    where it lies behind cameras.
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
    """What is measured of a scene: a sphere about the place that its cameras look at, which is the same in any frame;
    half of the reference where there is no such place.
    """
    cameras = list(cameras)
    place = focus_point(cameras)
    if place is None:
        return "quantile:0.5"
    farthest = max(float(np.linalg.norm(camera.position - place)) for camera in cameras)
    return Sphere(place.round(3) + 0.0, round(_REGION_SHARE * farthest, 3)).text
