"""A voxel radiance field as a reconstructor: train it on the photographs, then extract the surface that it shows.

The method is that of Plenoxels (Fridovich-Keil et al. 2022). The surface is the one that splats use: the median depths
that at least three images agree on.
"""

from __future__ import annotations

import math
import shutil
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from pcbench.errors import InputError, ReconstructionError
from pcbench.extras import import_problem
from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.cameras import Camera
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.voxels import robust_bounds
from pcbench.plugins import Reconstruction
from pcbench.plugins.progress import progress, with_time_left
from pcbench.plugins.stages import library_versions, stage
from pcbench.scenes import Scene
from pcbench.scenes.splits import HoldOut, Split, hold_out
from pcbench.scenes.views import VIEWS_FOLDER, ViewImages, write_views
from reconstructors.field.model import VoxelField, dense_shape
from reconstructors.field.train import (
    BYTES_PER_PIXEL,
    BYTES_PER_VERTEX,
    FieldSchedule,
    FieldTraining,
    load_field,
    save_field,
)
from reconstructors.mvs.views import view_stage
from reconstructors.sfm.sfm import ColmapSfm
from reconstructors.splat import extract
from reconstructors.splat.model import LocalFrame
from reconstructors.splat.photographs import Pyramid, check_training, read_photographs, select_usable, training_pinhole
from reconstructors.splat.resume import run_with_checkpoints

MODEL = "field.npz"  # in the stage `model`
COARSE = "coarse"  # beside it, if the voxels were not halved as often as planned

_SFM = "sfm"  # workspace of the cameras and the sparse points
_MIN_IMAGES = 3  # images that must agree on a point of the surface
_HALVINGS = 2  # times that the voxels are halved during training
_MIN_RESOLUTION = 16
_MARGIN = 0.1  # added to the sparse points on all sides, as a share of the longest side of their box
_BYTES_PER_GB = 1e9


@dataclass(frozen=True)
class RadianceField:
    """Train a voxel radiance field on the photographs and extract the surface it shows.

    The field covers the sparse points of `sfm`; what lies behind it has a colour that depends only on the direction.

    poses: `given` uses the scene's cameras as they are, `solve` computes them, as `sfm` does; `auto` uses the scene's
    cameras if there are any.
    steps: number of training steps of 4,096 rays.
    resolution: number of voxels along the longest side of the field.
    image_side: maximum length of the photographs' longer side, in pixels.
    hold_out: images not used for training: `every` 8th, or 8 `blocks`; the workspace then has renderings of all images
    for `pcbench views`.
    memory: gigabytes that training may use; if the grid does not fit, its voxels stay larger.

    The workspace keeps the field (model/field.npz).
    """

    poses: Literal["auto", "given", "solve"] = "auto"
    steps: int = 3000
    resolution: int = 256
    image_side: int = 640
    hold_out: HoldOut = "none"
    memory: float = 4.0
    seed: int = 0

    def __post_init__(self) -> None:
        if self.steps < 1:
            raise ValueError(f"expected at least one step, got {self.steps}")
        if not _MIN_RESOLUTION <= self.resolution <= 1024 or self.resolution % 2**_HALVINGS:
            raise ValueError(
                f"expected a resolution from {_MIN_RESOLUTION} to 1024 that is a multiple of {2**_HALVINGS}, got"
                f" {self.resolution}"
            )
        check_training(self.image_side, self.memory, self.seed)

    @classmethod
    def missing(cls) -> str | None:
        """Return how to install what is missing, or None."""
        return import_problem("torch", "pycolmap", "PIL", extra="field")

    def reconstruct(self, scene: Scene, workspace: Path) -> Reconstruction:
        """Train a field in the workspace and return its cloud; a finished stage is not repeated."""
        import torch

        if len(scene) < _MIN_IMAGES:
            raise InputError(f"expected at least {_MIN_IMAGES} images, got {len(scene)}")
        hold_out(scene.images, self.hold_out)  # raises before minutes of work if there are too few images
        (workspace / _SFM).mkdir(exist_ok=True)
        sparse = ColmapSfm(poses=self.poses, seed=self.seed).reconstruct(scene, workspace / _SFM)
        cameras = sparse.cameras
        split = hold_out(list(cameras), self.hold_out, {name: c.position for name, c in cameras.items()})
        frame = LocalFrame.of(list(cameras.values()))
        pinholes = {name: training_pinhole(camera, self.image_side) for name, camera in cameras.items()}
        lower, upper = bounding_box(frame.to_local(sparse.cloud.points))
        initial_resolution = self.resolution // 2**_HALVINGS
        max_vertices = self._max_vertices(pinholes, math.prod(dense_shape(lower, upper, initial_resolution)))
        folders = {
            name: view_stage(scene, cameras[name], camera, workspace)
            for name, camera in with_time_left(list(pinholes.items()), "undistorting")
        }
        photographs = read_photographs(folders, pinholes, frame, 1 + _HALVINGS, torch.device("cpu"))
        notes = []
        if split.test:
            notes.append(f"{len(split.test)} of {len(cameras)} images held out: {split.words}")
            notes.append("held out of training only: the sparse points that bound the field come from all images")
        transparent = sum(pyramid[0].alpha is not None for pyramid in photographs)
        if transparent:
            notes.append(f"{transparent} of {len(photographs)} photographs have transparent pixels: trained over black")
        inputs = {
            "versions": library_versions(),
            "settings": repr((self.poses, self.steps, self.resolution, self.image_side, self.seed, max_vertices)),
            "scene": scene.fingerprint(),
            "train": list(split.train),
        }

        usable = select_usable(photographs, split.train)

        def train(folder: Path) -> None:
            training = FieldTraining(
                VoxelField.dense(lower, upper, initial_resolution),
                usable,
                FieldSchedule(steps=self.steps, seed=self.seed, max_vertices=max_vertices),
            )
            field = run_with_checkpoints(training, workspace / "checkpoint.npz", repr(inputs))
            if training.coarse:
                (folder / COARSE).touch()
            save_field(folder / MODEL, field)

        model_folder = stage(workspace, "model", inputs, train)
        field = load_field(model_folder / MODEL)
        notes.append(f"{len(field):,} vertices, voxels of {field.voxel * frame.unit:.3g}{_unit(sparse.cloud)}")
        if (model_folder / COARSE).is_file():
            notes.append(f"voxels stayed larger than planned, within memory={self.memory:g} GB: set more memory")
        if split.test:
            _write_views(workspace / VIEWS_FOLDER, scene, split, field, photographs)
            notes.append(f"renderings: pcbench views {workspace / VIEWS_FOLDER}")
        else:
            shutil.rmtree(workspace / VIEWS_FOLDER, ignore_errors=True)  # renderings of an earlier model
        cloud = extract.surface(field, frame, pinholes)
        return Reconstruction(
            replace(cloud, unit=sparse.cloud.unit),
            sparse.gauge,
            cameras,
            [*sparse.notes, *notes],
            origin=sparse.origin,
        )

    def _max_vertices(self, pinholes: Mapping[str, Camera], initial_vertices: int) -> int:
        """Return the number of vertices that fit into memory beside the photographs.

        Args:
            pinholes: cameras of the photographs.
            initial_vertices: number of vertices of the initial grid.

        Raises:
            InputError: the photographs and the initial grid do not fit.
        """
        pixels = sum(c.intrinsics.width * c.intrinsics.height for c in pinholes.values())
        links = 4 * initial_vertices * 8**_HALVINGS  # of the final grid
        fixed = BYTES_PER_PIXEL * pixels + links
        needed = (fixed + BYTES_PER_VERTEX * initial_vertices) / _BYTES_PER_GB
        if needed > self.memory:
            longest = max(max(c.intrinsics.width, c.intrinsics.height) for c in pinholes.values())
            raise InputError(
                f"a field of resolution={self.resolution} and {len(pinholes)} photographs of {longest} pixels need at"
                f" least {needed:.2g} GB, more than memory={self.memory:g} allows: set a lower resolution, a smaller"
                " image_side, or more memory"
            )
        return int((self.memory * _BYTES_PER_GB - fixed) / BYTES_PER_VERTEX)


def bounding_box(points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the corners (3,) of the box of a field that contains sparse points (N, 3), without outliers.

    Raises:
        ReconstructionError: there are fewer than two points.
    """
    if len(points) < 2:
        raise ReconstructionError(
            f"expected sparse points that bound the field, got {len(points)}: check the overlap of the images"
        )
    lower, upper = robust_bounds(points)
    margin = _MARGIN * float((upper - lower).max())
    return lower - margin, upper + margin


def _write_views(folder: Path, scene: Scene, split: Split, field: VoxelField, photographs: list[Pyramid]) -> None:
    full_size = {pyramid[0].name: pyramid[0] for pyramid in photographs}

    def images(name: str) -> ViewImages:
        photograph = full_size[name]
        rendering = field.render_geometry(photograph.view).color.numpy().clip(0, 1)
        valid = None if photograph.valid is None else photograph.valid.numpy()
        return ViewImages(name, rendering, photograph.color.numpy(), valid)

    progress("rendering the images")
    write_views(folder, scene.name, "field", split, images)


def _unit(cloud: Cloud) -> str:
    return "" if cloud.unit is None else f" {cloud.unit}"
