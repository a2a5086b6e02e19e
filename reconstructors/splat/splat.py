"""Gaussian splatting as a reconstructor: train Gaussians on the photographs, then extract the surface they show.

The method is that of Kerbl et al. 2023. Gao et al. make their densified clouds with it and use the Gaussians' means as
points.
"""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcbench.errors import InputError, ReconstructionError
from pcbench.extras import import_problem
from pcbench.geometry.cameras import Camera
from pcbench.geometry.cloud import Cloud
from pcbench.plugins import Reconstruction
from pcbench.plugins.progress import progress, with_time_left
from pcbench.plugins.stages import library_versions, stage, stage_key
from pcbench.scenes import Scene
from pcbench.scenes.previews import PREVIEW_FOLDER
from pcbench.scenes.splits import HoldOut, Split, hold_out, split_for_selection
from pcbench.scenes.views import VIEWS_FOLDER, ViewImages, write_views
from reconstructors.mvs.cells import SPACE, SpaceCell
from reconstructors.mvs.mvs import MAPS, MIN_MEMORY_GB, DenseMvs
from reconstructors.mvs.views import ALPHA, view_stage
from reconstructors.sfm.features import NoPointsError
from reconstructors.sfm.sfm import ColmapSfm
from reconstructors.splat import extract
from reconstructors.splat.background import Background, BackgroundChoice
from reconstructors.splat.blocks import TrainedBlock, TrainingBlock, merge_clouds, merge_models, plan_blocks
from reconstructors.splat.combine import combine
from reconstructors.splat.curve import CRITERIA, CriterionName, Curve
from reconstructors.splat.density import Density
from reconstructors.splat.devices import choose_device
from reconstructors.splat.exposure import Exposure, read_gains, write_gains
from reconstructors.splat.model import Gaussians, LocalFrame
from reconstructors.splat.parsimony import Parsimonious, Score, score_surface, score_views
from reconstructors.splat.photographs import (
    Photograph,
    Pyramid,
    check_training,
    read_photographs,
    select_usable,
    training_pinhole,
)
from reconstructors.splat.ply import local_origin, write_model
from reconstructors.splat.preview import PreviewWriter
from reconstructors.splat.recipes import DensityName, Recipe, choose_recipe
from reconstructors.splat.resume import load_model, run_with_checkpoints, save_model
from reconstructors.splat.start import points_in_bounds, points_in_view
from reconstructors.splat.supervision import Supervision, read_supervision
from reconstructors.splat.train import Training, evaluate, render

if TYPE_CHECKING:
    import torch

MODEL = "point_cloud.ply"  # in the stage `model`
PARAMETERS = "model.pt"  # beside it: the parameters in the frame of training
FINAL_STEP = "steps.txt"  # beside it: the step after which training ended
GAINS = "gains.csv"  # beside it: the brightness of each training photograph relative to the model
BACKGROUND = "background.txt"  # beside it: the color behind the Gaussians, from 0 to 1
CURVE = "curve.csv"  # beside it, if the number of Gaussians was chosen
BLOCKS = "blocks"  # in the workspace: a stage like `model` for each block, if there are several

# Initial points may be less certain than measured ones: training moves them, but does not fill a place without any.
INITIAL_MVS = DenseMvs(precision=0.0)

_PYRAMID_LEVELS = 3  # sizes of each photograph
_MIN_IMAGES = 3  # images that must agree on a point of the surface
_MIN_START_SHARE = 0.5  # initial points, as a share of `gaussians`, below which a note warns that none are added
_MIN_GAIN_RATIO = 1.3  # of the brightest and the darkest photograph, from which a note reports both
_GROWTH = 4  # by which factor the number of Gaussians may grow from the first trial on, if it is chosen
_MIN_SELECTION_IMAGES = 4  # training images needed to choose the number of Gaussians on held-out ones
_MIN_SELECTION_VIEWS = 4  # held-out views or blocks below which a warning says that they are few
_BYTES_PER_GAUSSIAN = 1000  # parameters, gradients, moments and instances in the tiles of an image
_TRIAL_BYTES_PER_GAUSSIAN = 1000  # snapshots of the models among which one is chosen
_BYTES_PER_PIXEL = 4  # of a photograph with its smaller sizes
_DEPTH_BYTES_PER_PIXEL = 6  # of its depths, with supervision
_BYTES_PER_GB = 1e9
_PLANNED_SHARE = 0.9  # of the memory that blocks are planned for: the numbers of points are estimated from samples


class _Part(NamedTuple):
    """The scene or one block of it, as it is trained.

    Args:
        scene: its photographs.
        initial: its cameras, and the points at which training starts.
        split: its training images and held-out ones.
        pinholes: its pinholes in the world by image name.
        folders: stages of its undistorted photographs by image name.
        device: device of the training.
    """

    scene: Scene
    initial: Reconstruction
    split: Split
    pinholes: Mapping[str, Camera]
    folders: Mapping[str, Path]
    device: torch.device

    @property
    def frame(self) -> LocalFrame:
        """Frame of its model."""
        return LocalFrame.of(list(self.initial.cameras.values()))

    def photograph(self, name: str) -> Photograph:
        """Read a photograph at full size."""
        return read_photographs({name: self.folders[name]}, self.pinholes, self.frame, 1, self.device)[0][0]

    def select(self, block: TrainingBlock) -> _Part:
        """Return the part of a block."""
        cameras = {name: self.initial.cameras[name] for name in block.images}
        held_out = tuple(kept for names in self.split.blocks if (kept := tuple(n for n in names if n in cameras)))
        train = tuple(name for name in self.split.train if name in cameras)
        return _Part(
            self.scene.select(block.images),
            replace(self.initial, cloud=self.initial.cloud.select(block.start), cameras=cameras),
            replace(self.split, train=train, blocks=held_out),
            {name: self.pinholes[name] for name in block.images},
            {name: self.folders[name] for name in block.images},
            self.device,
        )


class _TrainedPart(NamedTuple):
    """A part with its block, and the stage of its model."""

    part: _Part
    block: TrainingBlock
    folder: Path


@dataclass(frozen=True)
class GaussianSplatting:
    """Train Gaussians on the photographs and extract the surface they show.

    poses: `given` uses the scene's cameras as they are, `solve` computes them, as `sfm` does; `auto` uses the scene's
    cameras if there are any.
    start: the points at which training starts: the cloud of `mvs`, thinned to the initial number of Gaussians, the
    sparse points of `sfm`, or `random` positions in their bounding box; if photographs with given cameras have no such
    points, where at least three cameras look.
    supervision: `mvs` adds the difference from the depth maps of `mvs` to the loss, if start=mvs; `none` does not.
    density: `parsimonious` starts with a quarter of `gaussians`, doubles or halves their number, then lowers the degree
    of the spherical harmonics, and keeps the smallest model whose loss on held-out photographs is within its noise;
    `fixed` keeps the initial number; `classic` densifies and prunes by the rules of Kerbl et al. 2023; `gao2025` trains
    as Gao et al.
    select: what `parsimonious` compares: `views`, the held-out photographs, or `surface`, their depths in `mvs`, for
    which fewer Gaussians are enough.
    cloud: the `surface` of the Gaussians that at least three images agree on; `combined`, this surface together with
    the points of `mvs`, weighted by how well depth maps agree (the surface alone, unless start=mvs); or the `means` of
    all Gaussians, as Gao et al. use them.
    min_opacity: the least opacity of those means, 0 to 1.
    steps: number of training steps; 3,000, or 50,000 for gao2025.
    gaussians: maximum number; 50,000, but 100,000 for parsimonious and 2,000,000 for gao2025.
    sh_degree: degree of the spherical harmonics, 0 to 3; 2, or 3.
    background: the colour behind the Gaussians: `black`, `white` or `learned`; `auto` learns it if one colour dominates
    the borders of the photographs, and otherwise is black. If photographs have an alpha channel, the model becomes
    transparent where they are.
    exposure: whether to fit the brightness of each training photograph, because cameras choose their exposures.
    image_side: maximum length of the photographs' longer side, in pixels; 640, or a quarter of its length.
    hold_out: images not used for training: `every` 8th, or 8 `blocks`; the workspace then has renderings of all images
    for `pcbench views`.
    memory: gigabytes that training may use. A scene that needs more is trained in blocks, one after the other, each for
    `steps` steps on the photographs that show it; the blocks share the `gaussians`.
    device: `cuda` or `cpu`; `auto` uses CUDA if there is a device.

    The workspace keeps the model (model/point_cloud.ply), which splat viewers open.
    """

    poses: Literal["auto", "given", "solve"] = "auto"
    start: Literal["mvs", "sfm", "random"] = "mvs"
    supervision: Literal["mvs", "none"] = "mvs"
    density: DensityName = "parsimonious"
    select: CriterionName = "views"
    cloud: Literal["combined", "surface", "means"] = "combined"
    min_opacity: float = 0.0
    steps: int | None = None
    gaussians: int | None = None
    sh_degree: int | None = None
    background: BackgroundChoice = "auto"
    exposure: bool = False
    image_side: int | None = None
    hold_out: HoldOut = "none"
    memory: float = 4.0
    device: Literal["auto", "cpu", "cuda"] = "auto"
    seed: int = 0

    def __post_init__(self) -> None:
        if not 0 <= self.min_opacity <= 1:
            raise ValueError(f"expected min_opacity from 0 to 1, got {self.min_opacity}")
        if self.min_opacity and self.cloud != "means":
            raise ValueError("min_opacity applies to the means of Gaussians: set cloud=means too")
        if self.select == "surface" and not (self.density == "parsimonious" and self.start == "mvs"):
            raise ValueError(
                "select=surface compares models by the depths of mvs: set density=parsimonious and start=mvs too, got"
                f" density={self.density} and start={self.start}"
            )
        recipe = self._recipe
        if recipe.steps < 1:
            raise ValueError(f"expected at least one step, got {recipe.steps}")
        if recipe.gaussians < 2:
            raise ValueError(f"expected at least 2 Gaussians, got {recipe.gaussians}")
        if not 0 <= recipe.sh_degree <= 3:
            raise ValueError(f"expected spherical harmonics of degree 0 to 3, got {recipe.sh_degree}")
        check_training(self.image_side, self.memory, self.seed)

    @classmethod
    def missing(cls) -> str | None:
        """Return how to install what is missing, or None."""
        return import_problem("torch", "pycolmap", "PIL", extra="splat")

    def reconstruct(self, scene: Scene, workspace: Path) -> Reconstruction:
        """Train a model in the workspace and return its cloud; a finished stage is not repeated."""
        import torch

        try:
            return self._reconstruct(scene, workspace)
        except torch.cuda.OutOfMemoryError as error:
            raise ReconstructionError(
                "the CUDA device ran out of memory: set fewer gaussians, a smaller image_side, or device=cpu"
            ) from error

    def _reconstruct(self, scene: Scene, workspace: Path) -> Reconstruction:
        if len(scene) < _MIN_IMAGES:
            raise InputError(f"expected at least {_MIN_IMAGES} images, got {len(scene)}")
        device, note = choose_device(self.device)
        hold_out(scene.images, self.hold_out)  # raises before hours of work if there are too few images
        initial = self._initial_reconstruction(scene, workspace)
        cameras = initial.cameras
        split = hold_out(list(cameras), self.hold_out, {name: c.position for name, c in cameras.items()})
        pinholes = {name: training_pinhole(camera, self._recipe.side(camera)) for name, camera in cameras.items()}
        blocks = self._plan_blocks(initial.cloud, pinholes)
        folders = {
            name: view_stage(scene, cameras[name], camera, workspace)
            for name, camera in with_time_left(list(pinholes.items()), "undistorting")
        }
        whole = _Part(scene, initial, split, pinholes, folders, device)
        notes = [] if note is None else [note]
        if split.test:
            notes.append(f"{len(split.test)} of {len(cameras)} images held out: {split.words}")
            notes.append(f"held out of training only: the initial points (start={self.start}) come from all images")
        trained = list[_TrainedPart]()
        if blocks:
            trained = self._train_blocks(whole, blocks, workspace)
            model_folder = self._merge_blocks(trained, whole.frame, workspace)
            notes += self._blocks_notes(trained, len(blocks), workspace)
        else:
            shutil.rmtree(workspace / BLOCKS, ignore_errors=True)  # of an earlier run with less memory
            model_folder = self._model_stage(whole, workspace, workspace, "model")
        model = load_model(model_folder / PARAMETERS, device)
        notes += self._density_notes(model_folder, len(initial.cloud), in_blocks=bool(blocks))
        last_step = int((model_folder / FINAL_STEP).read_text(encoding="utf-8"))
        early = f" of {self._recipe.steps:,}: training converged" if last_step < self._recipe.steps else ""
        notes.append(
            f"{len(model):,} Gaussians, spherical harmonics of degree {model.degree}, after step {last_step:,}{early}"
        )
        model_file = model_folder / MODEL
        origin = local_origin(whole.frame.to_world(model.means.cpu().numpy()))
        shift = f" --shift {','.join(str(-round(x)) for x in origin)}" if origin.any() else ""
        notes.append(f"model for viewers: {model_file}; for the web: pcbench convert {model_file} model.spz{shift}")
        background = np.loadtxt(model_folder / BACKGROUND, dtype=np.float32)
        notes += self._background_notes(folders, background)
        if (model_folder / GAINS).is_file():
            held_out = [whole.photograph(name) for name in split.test]
            notes += _exposure_note(read_gains(model_folder / GAINS), model, held_out, background)
        if split.test:
            self._write_views(workspace / VIEWS_FOLDER, whole, model, background)
            notes.append(f"renderings: pcbench views {workspace / VIEWS_FOLDER}")
        else:
            shutil.rmtree(workspace / VIEWS_FOLDER, ignore_errors=True)  # renderings of an earlier model
        maps = workspace / self.start / MAPS
        if self.cloud == "means":
            cloud = extract.means(model, whole.frame, min_opacity=self.min_opacity or None)
        elif blocks:
            del model
            clouds = self._extract_blocks(trained, initial.cloud, maps)
            if len(clouds) < len(trained):
                notes.append(f"{len(trained) - len(clouds)} of {len(blocks)} blocks have no surface: parts are missing")
            cloud = merge_clouds(clouds)
        else:
            cloud = self._extract_surface(model, whole, initial.cloud, maps)
        if "stereo" in cloud.attributes:
            notes.append(_sources_note(cloud))
        return Reconstruction(
            replace(cloud, unit=initial.cloud.unit),
            initial.gauge,
            cameras,
            [*initial.notes, *notes],
            origin=initial.origin,
        )

    def _training_settings(self) -> tuple[object, ...]:
        """Return the settings on which the model depends."""
        return (
            self.poses,
            self.start,
            self.supervision,
            self.density,
            self.select,
            repr(self._recipe),
            self.background,
            self.exposure,
            self.seed,
        )

    @property
    def _recipe(self) -> Recipe:
        """The recipe of the density setting with what is set otherwise."""
        names = ("steps", "gaussians", "sh_degree", "image_side")
        changed: dict[str, Any] = {name: value for name in names if (value := getattr(self, name)) is not None}
        supervised = self.start == "mvs" and self.supervision == "mvs"
        return replace(choose_recipe(self.density, supervised=supervised), **changed)

    @property
    def _uses_depths(self) -> bool:
        """Return whether depths of `mvs` supervise the training or select the model."""
        return self.start == "mvs" and (self.supervision == "mvs" or self.select == "surface")

    def _initial_reconstruction(self, scene: Scene, workspace: Path) -> Reconstruction:
        """Return the cameras and the initial points."""
        folder = workspace / self.start
        folder.mkdir(exist_ok=True)
        if self.start == "mvs":
            mvs = replace(INITIAL_MVS, poses=self.poses, memory=max(MIN_MEMORY_GB, self.memory), seed=self.seed)
            return mvs.reconstruct(scene, folder)
        count = self._recipe.gaussians
        try:
            initial = ColmapSfm(poses=self.poses, seed=self.seed).reconstruct(scene, folder)
        except NoPointsError as error:
            if self.start != "random" or self.poses == "solve" or not scene.cameras:
                raise
            cameras = {name: scene.cameras[name] for name in scene.images if name in scene.cameras}
            points = points_in_view(list(cameras.values()), count, self.seed)
            note = f"starts at random points where at least three cameras look: {error}"
            return Reconstruction(Cloud(points), "georeferenced", cameras, [note], origin=scene.origin)
        if self.start == "random":
            points = points_in_bounds(initial.cloud.points, count, self.seed)
            return replace(initial, cloud=Cloud(points, unit=initial.cloud.unit))
        return initial

    def _needed_gigabytes(self, gaussians: float, cameras: Iterable[Camera]) -> float:
        """Return the memory of a training, in gigabytes."""
        pixels = sum(c.intrinsics.width * c.intrinsics.height for c in cameras)
        gaussian = _BYTES_PER_GAUSSIAN + _TRIAL_BYTES_PER_GAUSSIAN * (self.density == "parsimonious")
        pixel = _BYTES_PER_PIXEL + _DEPTH_BYTES_PER_PIXEL * self._uses_depths
        return (gaussian * gaussians + pixel * pixels) / _BYTES_PER_GB

    def _plan_blocks(self, cloud: Cloud, pinholes: Mapping[str, Camera]) -> list[TrainingBlock]:
        """Return the blocks that fit into memory; none if the whole scene does.

        Raises:
            InputError: the smallest blocks need too much memory.
        """
        if self._needed_gigabytes(self._recipe.gaussians, pinholes.values()) <= self.memory:
            return []

        def needed(share: float, names: Sequence[str]) -> float:
            return self._needed_gigabytes(share * self._recipe.gaussians, [pinholes[name] for name in names])

        blocks = plan_blocks(
            cloud.points, pinholes, lambda *size: needed(*size) <= _PLANNED_SHARE * self.memory, self.seed
        )
        largest = max(blocks, key=lambda block: needed(block.share, block.images))
        if (least := needed(largest.share, largest.images)) > self.memory:
            longest = max(max(c.intrinsics.width, c.intrinsics.height) for c in pinholes.values())
            raise InputError(
                f"{largest.share * self._recipe.gaussians:,.0f} Gaussians and {len(largest.images)} photographs of"
                f" {longest} pixels need about {least:.2g} GB, more than memory={self.memory:g} allows, and cannot be"
                " split into smaller blocks: set fewer gaussians, a smaller image_side, or more memory"
            )
        return blocks

    def _model_stage(self, part: _Part, workspace: Path, parent: Path, name: str) -> Path:
        """Return the stage `parent/name` of the model that is trained on a part of the scene or on all of it."""
        inputs = {
            "versions": library_versions(),
            "settings": repr(self._training_settings()),
            "scene": part.scene.fingerprint(),
            "train": list(part.split.train),
            "points": hashlib.sha256(part.initial.cloud.points.data).hexdigest(),
        }
        return stage(parent, name, inputs, lambda folder: self._train(folder, part, workspace, repr(inputs)))

    def _train_blocks(self, whole: _Part, blocks: Sequence[TrainingBlock], workspace: Path) -> list[_TrainedPart]:
        """Train the blocks that have training photographs, one after the other.

        Raises:
            InputError: no block has a training photograph.
        """
        root = workspace / BLOCKS
        root.mkdir(exist_ok=True)
        trained = []
        for number, block in enumerate(blocks, start=1):
            shown = set(block.images).intersection(whole.split.train)
            if not any(whole.photograph(name).has_valid_pixels for name in shown):
                continue
            part = whole.select(block)
            progress(f"block {number} of {len(blocks)}: {len(part.split.train)} photographs")
            own = replace(self, gaussians=max(2, round(block.share * self._recipe.gaussians)))
            trained.append(_TrainedPart(part, block, own._model_stage(part, workspace, root, f"{number:04d}")))
        for folder in set(root.iterdir()).difference(folder for _, _, folder in trained):  # of an earlier run
            shutil.rmtree(folder)
        if not trained:
            raise InputError(
                f"no block has a training photograph: masks hide all of the {len(whole.split.train)} photographs"
            )
        return trained

    def _merge_blocks(self, trained: Sequence[_TrainedPart], frame: LocalFrame, workspace: Path) -> Path:
        """Return the stage of the model of all blocks, in a frame."""
        folders = [folder for _, _, folder in trained]
        inputs = {
            "blocks": [stage_key(folder) for folder in folders],
            "cells": [[block.cell.lower.tolist(), block.cell.upper.tolist()] for _, block, _ in trained],
        }

        def make(folder: Path) -> None:
            model = merge_models(
                (
                    TrainedBlock(load_model(source / PARAMETERS), part.frame, block.cell)
                    for part, block, source in trained
                ),
                frame,
            )
            color = np.mean([np.loadtxt(source / BACKGROUND) for source in folders], axis=0).tolist()
            last_step = max(int((source / FINAL_STEP).read_text(encoding="utf-8")) for source in folders)
            (folder / FINAL_STEP).write_text(str(last_step), encoding="utf-8")
            if self.exposure:
                gains = [read_gains(source / GAINS) for source in folders]
                names = dict.fromkeys(name for own in gains for name in own)
                means = {name: float(np.mean([own[name] for own in gains if name in own])) for name in names}
                write_gains(folder / GAINS, means)
            _save(folder, model, frame, color)

        return stage(workspace, "model", inputs, make)

    def _extract_blocks(self, trained: Sequence[_TrainedPart], stereo: Cloud, maps: Path) -> list[Cloud]:
        """Return the clouds of the blocks, each from its own model and of the points in its cell, if it has some.

        Raises:
            ReconstructionError: no block has a surface.
        """
        clouds, problem = [], None
        for part, block, folder in trained:
            if len(part.pinholes) < _MIN_IMAGES:
                continue
            model = load_model(folder / PARAMETERS, part.device)
            try:
                cloud = self._extract_surface(model, part, stereo, maps, block.surroundings)
            except ReconstructionError as error:
                problem = error
                continue
            own = block.cell.contains(cloud.points)
            if own.any():
                clouds.append(cloud.select(own))
        if not clouds:
            raise problem or ReconstructionError("no block has a surface in its cell; check the cameras")
        return clouds

    def _density_and_photographs(
        self,
        split: Split,
        cameras: Mapping[str, Camera],
        photographs: Mapping[str, Pyramid],
        depths: Supervision | None,
    ) -> tuple[Density[Training], list[Pyramid]]:
        """Return the densification strategy and the photographs that training starts with."""
        usable = select_usable(photographs.values(), split.train)
        names = [pyramid[0].name for pyramid in usable]
        if (rules := self._recipe.densification) is not None:
            return replace(rules, max_gaussians=self._recipe.gaussians), usable
        score: Score = score_views
        candidates = names
        if self.select == "surface":
            assert depths is not None
            score = score_surface(depths.depths)
            candidates = [name for name in names if name in depths.depths and (depths.depths[name][0] > 0).any()]
        if self.density == "fixed" or len(candidates) < _MIN_SELECTION_IMAGES:
            return Density(), usable
        selection_split = split_for_selection(candidates, {name: camera.position for name, camera in cameras.items()})
        held_out_blocks = [[photographs[name] for name in block] for block in selection_split.blocks]
        shown = [photographs[name] for name in names if name not in selection_split.test]
        most = self._recipe.gaussians
        density = Parsimonious(held_out_blocks, max(2, most // _GROWTH), most, CRITERIA[self.select], score)
        return density, shown

    def _train(self, folder: Path, part: _Part, workspace: Path, key: str) -> None:
        progress("creating the initial Gaussians")
        initial, split, frame, recipe = part.initial, part.split, part.frame, self._recipe
        photographs = read_photographs(part.folders, part.pinholes, frame, _PYRAMID_LEVELS, part.device)
        pyramids = {pyramid[0].name: pyramid for pyramid in photographs}
        depths = None
        if self._uses_depths:
            depths = read_supervision(
                workspace / self.start / MAPS, [pyramids[name] for name in split.train], frame.unit
            )
        density, training_photographs = self._density_and_photographs(split, initial.cameras, pyramids, depths)
        background = Background.choose(self.background, [pyramids[name][0] for name in split.train])
        count = density.start_gaussians if isinstance(density, Parsimonious) else self._recipe.gaussians
        model = initial_model(initial.cloud, frame, count, self.seed)
        training = Training(
            model.to(part.device),
            training_photographs,
            replace(recipe.schedule, steps=recipe.steps, sh_degree=recipe.sh_degree, seed=self.seed),
            density,
            None if self.supervision == "none" else depths,
            background,
            Exposure(split.train, background.color.device) if self.exposure else None,
        )
        held_out = [pyramids[name][0] for name in split.test if pyramids[name][0].has_valid_pixels]
        shown = PreviewWriter(
            workspace / PREVIEW_FOLDER,
            hashlib.sha256(key.encode()).hexdigest(),
            frame,
            [pyramid[0] for pyramid in training_photographs],
            held_out,
        )
        model = run_with_checkpoints(training, workspace / "checkpoint.pt", key, shown)
        if isinstance(density, Parsimonious) and density.curve is not None:
            density.curve.write(folder / CURVE)
        (folder / FINAL_STEP).write_text(str(training.step), encoding="utf-8")
        if training.exposure is not None:
            write_gains(folder / GAINS, training.exposure.gains)
        color = background.color[0].tolist()
        _save(folder, model, frame, color)

    def _blocks_notes(self, trained: Sequence[_TrainedPart], planned: int, workspace: Path) -> Iterator[str]:
        """Yield how the scene was split, and whether parts of it have no training photographs."""
        most = max(len(part.pinholes) for part, _, _ in trained)
        yield (
            f"trained in {planned} blocks of at most {most} photographs each, for memory={self.memory:g} GB:"
            f" {workspace / BLOCKS}"
        )
        if hidden := planned - len(trained):
            yield f"{hidden} of {planned} blocks have no training photographs: these parts have no Gaussians"
        if self.density == "parsimonious":
            fixed = sum(not (folder / CURVE).is_file() for _, _, folder in trained)
            kept = f", except in {fixed} blocks with too few photographs" if fixed else ""
            yield f"the number of Gaussians was optimized in each block{kept}: {workspace / BLOCKS}/*/{CURVE}"

    def _density_notes(self, folder: Path, points: int, *, in_blocks: bool) -> Iterator[str]:
        """Yield how the number of Gaussians was chosen, and why it may be too small.

        Args:
            folder: stage of the model.
            points: number of points at which training started.
            in_blocks: whether the scene was trained in blocks, whose numbers `_blocks_notes` describes.
        """
        if (folder / CURVE).is_file():
            curve = Curve.read(folder / CURVE)
            yield f"{curve.sentence}; all models tried: {folder / CURVE}"
            if (views := len(curve.budgets[0].scores[0])) < _MIN_SELECTION_VIEWS:
                yield (
                    f"warning: only {views} held-out photographs decide on the number of Gaussians, so it may be too"
                    " small: give more images"
                )
        elif self.density == "parsimonious" and not in_blocks:
            condition = " with depths that three images confirm" if self.select == "surface" else ""
            yield (
                f"warning: the number of Gaussians was not optimized: this needs at least {_MIN_SELECTION_IMAGES}"
                f" training images{condition}"
            )
        steps, rules = self._recipe.steps, self._recipe.densification
        if rules is not None and rules.refine_start >= rules.refine_stop_share * steps:
            yield (
                f"no Gaussian was added: density={self.density} starts at step {rules.refine_start:,} and stops after"
                f" {rules.refine_stop_share:.0%} of the steps; set more steps"
            )
        yield from self._few_points_note(points)

    def _few_points_note(self, points: int) -> Iterator[str]:
        """Yield a note if training starts at far fewer points than `gaussians`, and adds none."""
        adds = self._recipe.densification is not None or self.density == "parsimonious"
        if self.start == "random" or adds or points >= _MIN_START_SHARE * self._recipe.gaussians:
            return
        remedy = "density=parsimonious, which adds them" + (", or start=mvs" if self.start == "sfm" else "")
        yield (
            f"few Gaussians: training starts at the {points:,} points of start={self.start}, and density={self.density}"
            f" adds none up to gaussians={self._recipe.gaussians:,}; set {remedy}"
        )

    def _background_notes(self, photographs: Mapping[str, Path], color: NDArray[np.float32]) -> Iterator[str]:
        """Yield how transparent photographs were used, and which color was learned behind opaque ones."""
        transparent = sum((folder / ALPHA).is_file() for folder in photographs.values())
        if transparent:
            colors = self.background if self.background in ("black", "white") else "random colors"
            yield (
                f"{transparent} of {len(photographs)} photographs have transparent pixels: trained over {colors},"
                f" rendered over {_color_text(color)}"
            )
        if self.background in ("auto", "learned") and transparent < len(photographs) and color.any():
            yield f"color behind the Gaussians, learned: {_color_text(color)}"

    def _write_views(self, folder: Path, whole: _Part, model: Gaussians, color: NDArray[np.float32]) -> None:
        background = model.means.new_tensor(color)

        def pictures(name: str) -> ViewImages:
            photograph = whole.photograph(name)
            valid = None if photograph.valid is None else photograph.valid.cpu().numpy()
            rendering = render(model, photograph.view, background).cpu().numpy()
            return ViewImages(name, rendering, photograph.over(background).cpu().numpy(), valid)

        progress("rendering the images")
        write_views(folder, whole.scene.name, "splat", whole.split, pictures)

    def _extract_surface(
        self, model: Gaussians, part: _Part, stereo: Cloud, maps: Path, cell: SpaceCell = SPACE
    ) -> Cloud:
        """Return the surface of a part in a cell; `stereo` and the folder `maps` are points and maps of start=mvs."""
        surface = extract.surface(model, part.frame, part.pinholes, cell=cell)
        if self.cloud == "surface" or self.start != "mvs":
            return surface
        if cell is not SPACE:
            stereo = stereo.select(cell.contains(stereo.points))
        return combine(surface, stereo, model, part.frame, part.pinholes, maps)


def _save(folder: Path, model: Gaussians, frame: LocalFrame, color: list[float]) -> None:
    """Write a model, before the color of its background, into the folder of its stage."""
    np.savetxt(folder / BACKGROUND, [color], fmt="%.9g")
    save_model(folder / PARAMETERS, model)
    write_model(folder / MODEL, model, frame, background=color)


def _sources_note(cloud: Cloud) -> str:
    """Describe where the points of a combined cloud come from."""
    stereo = cloud.attributes["stereo"]
    return (
        f"{np.mean(stereo == 1):.0%} of the points come from mvs alone, {np.mean(stereo == 0):.0%} from the Gaussians"
        " alone, the others from both: attribute stereo"
    )


def _exposure_note(
    gains: Mapping[str, float], model: Gaussians, held_out: Sequence[Photograph], color: NDArray[np.float32]
) -> Iterator[str]:
    """Yield how much the exposures differ, with the PSNR of held-out views without and with a gain, if they do."""
    dark, bright = min(gains, key=gains.__getitem__), max(gains, key=gains.__getitem__)
    if gains[bright] < _MIN_GAIN_RATIO * gains[dark]:
        return
    scores = ""
    if held_out:
        background = model.means.new_tensor(color)
        raw, fitted = (
            np.mean([score.psnr for score in evaluate(model, held_out, background, fit_exposure=fit_exposure)])
            for fit_exposure in (False, True)
        )
        scores = f"; PSNR of held-out views {raw:.2f} dB as rendered, {fitted:.2f} dB with their brightness fitted too"
    yield f"brightness of the photographs from {gains[dark]:.2f} ({dark}) to {gains[bright]:.2f} ({bright}){scores}"


def _color_text(color: NDArray[np.float32]) -> str:
    """Return a color from 0 to 1 as its name or in levels of 255."""
    red, green, blue = (round(255 * float(channel)) for channel in color)
    return {(0, 0, 0): "black", (255, 255, 255): "white"}.get((red, green, blue), f"({red}, {green}, {blue})")


def initial_model(cloud: Cloud, frame: LocalFrame, max_gaussians: int, seed: int) -> Gaussians:
    """Create the Gaussians that training starts with, at points of a cloud.

    Args:
        cloud: initial points in the world, with colors or without.
        frame: the frame of the model.
        max_gaussians: maximum number of Gaussians; a larger cloud is sampled.
        seed: seed of the random numbers.

    Raises:
        ReconstructionError: the cloud has fewer than two points.
    """
    points, colors = cloud.points, cloud.colors
    if len(points) > max_gaussians:
        # At random: a dense cloud has more points where the photographs are closer, and the model needs more there.
        rows = np.sort(np.random.default_rng([seed, 2]).choice(len(points), max_gaussians, replace=False))
        points, colors = points[rows], None if colors is None else colors[rows]
    if len(points) < 2:
        raise ReconstructionError(f"expected at least 2 initial points, got {len(points)}: set start=random")
    shades = np.full((len(points), 3), 0.5) if colors is None else colors / 255
    return Gaussians.from_points(points, shades, frame)
