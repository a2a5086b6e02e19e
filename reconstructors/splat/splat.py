"""Gaussian splatting as a reconstructor: Gaussians trained to look like the photographs, and the surface they show.

Kerbl et al. 2023, with which Gao et al. make their densified clouds; they take the Gaussians' centres for points.
"""

from __future__ import annotations

import errno
import shutil
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from pcbench.errors import InputError, ReconstructionError
from pcbench.extras import unavailable
from pcbench.geometry.cameras import Camera
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.voxels import robust_bounds
from pcbench.plugins import Reconstruction
from pcbench.plugins.progress import progress, with_time_left
from pcbench.plugins.stages import library_versions, stage
from pcbench.scenes import Scene
from pcbench.scenes.splits import HoldOut, Split, for_choosing, hold_out
from pcbench.scenes.views import RENDERED, Pictures, write_views
from reconstructors.mvs.mvs import MAPS, DenseMvs
from reconstructors.mvs.views import pinhole, view_stage
from reconstructors.sfm.sfm import ColmapSfm
from reconstructors.splat import extract
from reconstructors.splat.density import GAO2025, Classic, Density
from reconstructors.splat.devices import computing_on
from reconstructors.splat.model import Gaussians, LocalFrame
from reconstructors.splat.optimizer import GAO2025_RATES, Rates
from reconstructors.splat.parsimony import Curve, Parsimonious
from reconstructors.splat.photographs import Pyramid, read_photographs
from reconstructors.splat.ply import write_model
from reconstructors.splat.resume import load_model, save_model, trained
from reconstructors.splat.supervision import read_supervision
from reconstructors.splat.train import Schedule, Training, render

MODEL = "point_cloud.ply"  # in the stage `model`
NUMBERS = "model.pt"  # beside it, in the frame of training
STEPS = "steps.txt"  # beside it: after which step training ended
CURVE = "curve.csv"  # beside it, where the number of Gaussians was chosen

# Points to begin at may be less sure than points to measure: training moves them, and fills no place that has none.
BEGINNING = DenseMvs(views=2, confidence=0.1)

_LEVELS = 3  # sizes of the photographs
_FEWEST = 3  # images: a surface is what as many agree on
_CHOOSING = 4  # images, of which some judge how many Gaussians are enough
_BYTES = 1000  # a Gaussian: its numbers, their derivatives and moments, its places in the tiles of an image
_KEPT_BYTES = 1000  # a Gaussian: of the models among which one is chosen
_PIXEL_BYTES = 4  # of a photograph, with its smaller sizes
_DEPTH_BYTES = 6  # beside it, where depths are trained by
_GIGA = 1e9


@dataclass(frozen=True)
class GaussianSplatting:
    """The surface that Gaussians show which were trained to look like the photographs.

    poses: `given` takes the scene's cameras as they are, `solve` finds them, as `sfm` does; `auto` is given where there
    are some.
    start: from what training begins: the cloud of `mvs`, thinned to `gaussians`, the sparse points of `sfm`, or places
    at `random` in their box.
    supervision: `mvs` holds what is drawn to the depth maps of `mvs`, where training begins at its cloud; `none`.
    density: `parsimonious` tries ever fewer, down from `gaussians`, and simpler colours, and takes the smallest model
    that photographs which none was trained on find as good as the best; `fixed` leaves their number as it is;
    `classic` adds and removes by the rules of Kerbl et al. 2023, `gao2025` by those of Gao et al.
    cloud: the `surface` that at least three images agree on, or the `means` of all Gaussians, as Gao et al. take them;
    min_opacity: of those.
    steps: of training. gaussians: at most. sh_degree: 0 to 3, of their colours. image_side: pixels of the longer side
    of the photographs, at most. hold_out: images that are not trained on: `every` 8th, or 8 `blocks`; renderings of all
    images are then left in the workspace for `pcbench views`. memory: gigabytes that training may take.
    device: `cuda` or `cpu`; `auto` is the former where there is one.
    The workspace keeps the model (model/point_cloud.ply), which viewers open.
    """

    poses: Literal["auto", "given", "solve"] = "auto"
    start: Literal["mvs", "sfm", "random"] = "mvs"
    supervision: Literal["mvs", "none"] = "mvs"
    density: Literal["parsimonious", "fixed", "classic", "gao2025"] = "parsimonious"
    cloud: Literal["surface", "means"] = "surface"
    min_opacity: float = 0.0
    steps: int = 3000
    gaussians: int = 50_000
    sh_degree: int = 2
    image_side: int = 640
    hold_out: HoldOut = "none"
    memory: float = 4.0
    device: Literal["auto", "cpu", "cuda"] = "auto"
    seed: int = 0

    def __post_init__(self) -> None:
        if not 0 <= self.min_opacity <= 1:
            raise ValueError(f"expected a least opacity from 0 to 1, got {self.min_opacity}")
        if self.min_opacity and self.cloud != "means":
            raise ValueError("min_opacity is of the centres of Gaussians: set cloud=means too")
        if self.steps < 1:
            raise ValueError(f"expected at least one step, got {self.steps}")
        if self.gaussians < 2:
            raise ValueError(f"expected at least 2 Gaussians, got {self.gaussians}")
        if not 0 <= self.sh_degree <= 3:
            raise ValueError(f"expected spherical harmonics of degree 0 to 3, got {self.sh_degree}")
        if self.image_side < 16:
            raise ValueError(f"expected photographs of at least 16 pixels, got image_side={self.image_side}")
        if not (np.isfinite(self.memory) and self.memory > 0):
            raise ValueError(f"expected memory in gigabytes, got {self.memory}")
        if not 0 <= self.seed < 2**31:
            raise ValueError(f"expected a seed from 0 to 2^31 - 1, got {self.seed}")

    @classmethod
    def missing(cls) -> str | None:
        return unavailable("torch", "pycolmap", "PIL", extra="splat")

    def reconstruct(self, scene: Scene, workspace: Path) -> Reconstruction:
        import torch

        try:
            return self._reconstruct(scene, workspace)
        except torch.cuda.OutOfMemoryError as error:
            raise ReconstructionError(
                "the CUDA device has too little memory: set fewer gaussians, a smaller image_side, or device=cpu"
            ) from error
        except OSError as error:
            if error.errno in (errno.ENOSPC, errno.EDQUOT):
                raise ReconstructionError(
                    f"the disk of {workspace} is full: make room and run it again; what is finished is kept"
                ) from error
            raise

    def _reconstruct(self, scene: Scene, workspace: Path) -> Reconstruction:
        if len(scene) < _FEWEST:
            raise InputError(f"expected at least {_FEWEST} images, got {len(scene)}")
        device, note = computing_on(self.device)
        hold_out(scene.images, self.hold_out)  # too few are refused before hours of work
        begun = self._begun(scene, workspace)
        cameras = begun.cameras
        split = hold_out(list(cameras), self.hold_out, {name: c.position for name, c in cameras.items()})
        frame = LocalFrame.of(list(cameras.values()))
        pinholes = {name: pinhole(camera, self._scale(camera)) for name, camera in cameras.items()}
        self._check_memory(pinholes)
        folders = {
            name: view_stage(scene, cameras[name], camera, workspace)
            for name, camera in with_time_left(list(pinholes.items()), "undistorting")
        }
        photographs = read_photographs(folders, pinholes, frame, _LEVELS, device)
        notes = [] if note is None else [note]
        notes += [f"{len(split.test)} of {len(cameras)} images held out: {split.words}"] if split.test else []
        if split.test:
            notes.append(f"held out of training only: `{self.start}`, at whose points it begins, saw all images")

        inputs = {
            "versions": library_versions(),
            "settings": repr(self._of_training()),
            "scene": scene.fingerprint(),
            "train": list(split.train),
        }
        made = stage(
            workspace,
            "model",
            inputs,
            lambda folder: self._train(folder, photographs, split, begun, frame, workspace, repr(inputs)),
        )
        model = load_model(made / NUMBERS, device)
        if (made / CURVE).is_file():
            notes.append(f"{Curve.read(made / CURVE).sentence}; all that were tried: {made / CURVE}")
        elif self.density == "parsimonious":
            notes.append(f"fewer than {_CHOOSING} images to train on: how many Gaussians are enough was not asked")
        if (rules := self._rules) is not None and rules.first > rules.last * self.steps:
            notes.append(
                f"no Gaussian was added: density={self.density} begins at step {rules.first:,} and ends after"
                f" {rules.last:.0%} of the steps"
            )
        took = int((made / STEPS).read_text(encoding="utf-8"))
        early = f" of {self.steps:,}: the photographs got no better" if took < self.steps else ""
        notes.append(f"{len(model):,} Gaussians, harmonics of degree {model.degree}, after step {took:,}{early}")
        if split.test:
            self._write_views(workspace / RENDERED, scene, split, model, photographs)
            notes.append(f"renderings: pcbench views {workspace / RENDERED}")
        else:
            shutil.rmtree(workspace / RENDERED, ignore_errors=True)  # of another model
        cloud = self._extracted(model, frame, pinholes)
        return Reconstruction(
            Cloud(cloud.points, cloud.normals, cloud.colors, cloud.attributes, unit=begun.cloud.unit),
            begun.gauge,
            cameras,
            [*begun.notes, *notes],
        )

    def _of_training(self) -> tuple[object, ...]:
        """The settings on which the model depends."""
        return (
            self.poses,
            self.start,
            self.supervision,
            self.density,
            self.steps,
            self.gaussians,
            self.sh_degree,
            self.image_side,
            self.seed,
        )

    @property
    def _rules(self) -> Classic | None:
        """By which Gaussians are added and taken away."""
        return {"classic": Classic(), "gao2025": GAO2025}.get(self.density)

    @property
    def _supervised(self) -> bool:
        return self.supervision == "mvs" and self.start == "mvs"

    def _begun(self, scene: Scene, workspace: Path) -> Reconstruction:
        """Cameras, and the points that Gaussians begin at."""
        folder = workspace / self.start
        folder.mkdir(exist_ok=True)
        if self.start == "mvs":
            return replace(BEGINNING, poses=self.poses, seed=self.seed).reconstruct(scene, folder)
        return ColmapSfm(poses=self.poses, seed=self.seed).reconstruct(scene, folder)

    def _scale(self, camera: Camera) -> float:
        """Of a photograph, so that its longer side has at most `image_side` pixels."""
        return min(1.0, self.image_side / max(camera.intrinsics.width, camera.intrinsics.height))

    def _check_memory(self, pinholes: Mapping[str, Camera]) -> None:
        pixels = sum(c.intrinsics.width * c.intrinsics.height for c in pinholes.values())
        gaussian = _BYTES + _KEPT_BYTES * (self.density == "parsimonious")
        pixel = _PIXEL_BYTES + _DEPTH_BYTES * self._supervised
        needed = (gaussian * self.gaussians + pixel * pixels) / _GIGA
        if needed > self.memory:
            longest = max(max(c.intrinsics.width, c.intrinsics.height) for c in pinholes.values())
            raise InputError(
                f"{self.gaussians:,} Gaussians and {len(pinholes)} photographs of {longest} pixels take some"
                f" {needed:.2g} GB, memory={self.memory:g} allows less: set fewer gaussians, a smaller image_side, or"
                " more memory"
            )

    def _density(
        self, split: Split, cameras: Mapping[str, Camera], photographs: Mapping[str, Pyramid]
    ) -> tuple[Density[Training], list[Pyramid]]:
        """Which Gaussians there are, and the photographs that training begins with."""
        names = [name for name in split.train if photographs[name][0].shows]
        if not names:
            raise InputError(f"the masks hide all of the {len(split.train)} photographs to train on: black is left out")
        seen = [photographs[name] for name in names]
        if self.density == "fixed" or (self.density == "parsimonious" and len(seen) < _CHOOSING):
            return Density(), seen
        if self._rules is not None:
            return replace(self._rules, most=self.gaussians), seen
        choosing = for_choosing(names, {name: camera.position for name, camera in cameras.items()})
        judges = [[photographs[name] for name in block] for block in choosing.blocks]
        return Parsimonious(judges), [photographs[name] for name in choosing.train]

    def _train(
        self,
        folder: Path,
        photographs: list[Pyramid],
        split: Split,
        begun: Reconstruction,
        frame: LocalFrame,
        workspace: Path,
        key: str,
    ) -> None:
        progress("placing Gaussians")
        of = {pyramid[0].name: pyramid for pyramid in photographs}
        density, seen = self._density(split, begun.cameras, of)
        supervision = None
        if self._supervised:
            shown = [of[name] for name in split.train]
            supervision = read_supervision(workspace / self.start / MAPS, shown, frame.unit)
        first = first_model(begun.cloud, frame, self.gaussians, self.seed, random=self.start == "random")
        training = Training(
            first.to(photographs[0][0].color.device),
            seen,
            Schedule(
                steps=self.steps,
                sh_degree=self.sh_degree,
                seed=self.seed,
                rates=GAO2025_RATES if self.density == "gao2025" else Rates(),
            ),
            density,
            supervision,
        )
        model = trained(training, workspace / "checkpoint.pt", key)
        if isinstance(density, Parsimonious) and density.curve is not None:
            density.curve.write(folder / CURVE)
        (folder / STEPS).write_text(str(training.step), encoding="utf-8")
        save_model(folder / NUMBERS, model)
        write_model(folder / MODEL, model, frame)

    def _write_views(
        self, folder: Path, scene: Scene, split: Split, model: Gaussians, photographs: list[Pyramid]
    ) -> None:
        full = {pyramid[0].name: pyramid[0] for pyramid in photographs}

        def pictures(name: str) -> Pictures:
            photograph = full[name]
            valid = None if photograph.valid is None else photograph.valid.cpu().numpy()
            drawn = render(model, photograph.view).cpu().numpy()
            return Pictures(name, drawn, photograph.color.cpu().numpy(), valid)

        progress("rendering the views")
        write_views(folder, scene.name, "splat", split, pictures)

    def _extracted(self, model: Gaussians, frame: LocalFrame, pinholes: Mapping[str, Camera]) -> Cloud:
        if self.cloud == "means":
            return extract.means(model, frame, min_opacity=self.min_opacity or None)
        return extract.surface(model, frame, pinholes)


def first_model(cloud: Cloud, frame: LocalFrame, most: int, seed: int, *, random: bool = False) -> Gaussians:
    """What training begins with: Gaussians at points of a cloud, or at random places in their box.

    Args:
        most: Gaussians.

    Raises:
        ReconstructionError: there is less than two points.
    """
    points, colors = cloud.points, cloud.colors
    rng = np.random.default_rng([seed, 2])
    if random:
        lower, upper = robust_bounds(points)
        points, colors = rng.uniform(lower, upper, size=(most, 3)), None
    elif len(points) > most:
        # At random: a dense cloud has more points where photographs are closer, and so shall the model.
        which = np.sort(rng.choice(len(points), most, replace=False))
        points, colors = points[which], None if colors is None else colors[which]
    if len(points) < 2:
        raise ReconstructionError(f"expected points to begin with, got {len(points)}: begin at random (start=random)")
    shades = np.full((len(points), 3), 0.5) if colors is None else colors / 255
    return Gaussians.at_points(points, shades, frame)
