"""Dense multi-view stereo: depth and normal maps by PatchMatch, confirmed by each other, fused by COLMAP.

Schonberger et al. 2016 (COLMAP's dense stereo and its fusion), as Gao et al. make their reference with it; the bundled
matcher is of the same family and runs on any CPU.
"""

from __future__ import annotations

import errno
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from pcbench.errors import InputError, ReconstructionError
from pcbench.extras import unavailable
from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.cameras import Camera
from pcbench.io.colmap_model import write_colmap_model
from pcbench.plugins import Reconstruction
from pcbench.plugins.progress import progress, with_time_left
from pcbench.plugins.stages import stage
from pcbench.scenes import Scene
from pcbench.scenes.decode import decode_image
from reconstructors.mvs.backend import Backend, choose_backend, colmap_maps
from reconstructors.mvs.bundled import Matching, bundled_maps, digest_of
from reconstructors.mvs.filter import Criteria, filter_map
from reconstructors.mvs.fusion import (
    FUSED,
    Links,
    fuse,
    link_maps,
    links,
    read_fused,
    tracks_of,
    write_mesh,
    write_workspace,
)
from reconstructors.mvs.maps import read_map, write_map
from reconstructors.mvs.plan import MOST_SOURCES, ImageSurvey, MatchingPlan, make_plan, textured_share
from reconstructors.mvs.sources import MatchedImage, choose_references
from reconstructors.mvs.sparse import Sparse, shifted, sparse_of
from reconstructors.mvs.views import IMAGE, Photographs, in_folder, luminance, pinhole, view_stage
from reconstructors.sfm.features import some
from reconstructors.sfm.sfm import ColmapSfm

MAPS = "maps"  # in the workspace: a folder for each image, and the model of their cameras
MESH = "mesh.ply"  # in the workspace

COUNTS = "views.npy"  # in the folder of a map: the number (H, W) of images that agree at each pixel
_LINKS = "links.npz"
_SFM = "sfm"  # in the workspace: what `sfm` keeps
_FEWEST = 3  # images: sparse points are of three
_CONFIRMING = 12  # images whose maps may confirm a depth
_SAMPLED = 8  # images that tell how much texture there is
_SAMPLE_SIDE = 1000  # pixels of their longer side
_BYTES = 3 * 20 + 4 + 26  # a pixel: depth, normal and confidence three times, the photograph, its part of the cloud
_KEEP = 3  # views and maps that are kept beside those of a reference and its sources


class _Filtered(NamedTuple):
    """The stages of the filtered maps that are not empty, and the names of those that are."""

    folders: dict[str, Path]
    empty: list[str]


@dataclass(frozen=True)
class DenseMvs:
    """Dense points with normals and colours by multi-view stereo: PatchMatch on the CPU, or COLMAP's where there is a
    GPU with CUDA, and COLMAP's fusion.

    poses: `given` takes the scene's cameras as they are, `solve` finds them, as `sfm` does; `auto` is given where there
    are some.
    spacing: of the points that are wanted, in the unit of the cameras: no more is done than it needs; by default what
    images of up to 2000 pixels give. sources: images that each image is matched with; by default 8, as far as they
    overlap.
    backend: `colmap` needs a pycolmap with CUDA and a GPU, `bundled` runs anywhere; `auto` takes COLMAP's where it can.
    confidence: of a depth, from 0 to 1, at least. views: images that have to agree on a point.
    mesh: leave Poisson's mesh in the workspace too. The workspace keeps the depth and normal maps.
    """

    poses: Literal["auto", "given", "solve"] = "auto"
    spacing: float | None = None
    sources: int | None = None
    backend: Backend = "auto"
    confidence: float = 0.3
    views: int = 3
    mesh: bool = False
    seed: int = 0

    def __post_init__(self) -> None:
        if self.spacing is not None and not (np.isfinite(self.spacing) and self.spacing > 0):
            raise ValueError(f"expected a positive spacing, got {self.spacing}")
        if self.sources is not None and not 1 <= self.sources <= MOST_SOURCES:
            raise ValueError(f"expected 1 to {MOST_SOURCES} sources, got {self.sources}")
        if not 0 <= self.confidence <= 1:
            raise ValueError(f"expected a confidence from 0 to 1, got {self.confidence}")
        if self.views < 2:
            raise ValueError(f"expected points of at least 2 images, got views={self.views}")
        if not 0 <= self.seed < 2**31:
            raise ValueError(f"expected a seed from 0 to 2^31 - 1, got {self.seed}")

    @classmethod
    def missing(cls) -> str | None:
        return unavailable("pycolmap", "PIL", extra="mvs")

    def reconstruct(self, scene: Scene, workspace: Path) -> Reconstruction:
        try:
            return self._reconstruct(scene, workspace)
        except OSError as error:
            if error.errno in (errno.ENOSPC, errno.EDQUOT):
                raise ReconstructionError(
                    f"the disk of {workspace} is full: make room and run it again; what is finished is kept"
                ) from error
            raise

    def _reconstruct(self, scene: Scene, workspace: Path) -> Reconstruction:
        least = max(_FEWEST, self.views)
        if len(scene) < least:
            raise InputError(f"expected at least {least} images (three, and {self.views} that agree), got {len(scene)}")
        backend, why = choose_backend(self.backend)
        solved = self._solved(scene, workspace)
        sparse, origin = _local(workspace, solved.cameras)
        references, plan, notes = self._planned(scene, sparse)
        notes += [f"backend {backend}: {why}", *plan.reasons]

        cameras = {name: pinhole(sparse.cameras[name], plan.scale) for name in _taking_part(references)}
        _check_disk(workspace, cameras)
        views = {
            name: view_stage(scene, sparse.cameras[name], camera, workspace)
            for name, camera in with_time_left(list(cameras.items()), "undistorting")
        }
        photographs = Photographs(cameras, views, _CONFIRMING + _KEEP)
        matching = Matching(photographs, views, plan, self.seed)
        # Sources were chosen one after the other: the first of them are those that would be chosen if they were fewer.
        # The maps of all of them confirm depths, which costs little.
        matched = [r._replace(sources=r.sources[: plan.sources]) for r in references]
        if backend == "colmap":
            made = colmap_maps(matching, matched, sparse, workspace)
        else:
            made = bundled_maps(matching, matched, workspace)

        kept = self._filtered(photographs, references, made, workspace)
        notes += _empties(kept, references)
        write_colmap_model(workspace / MAPS, [shifted(cameras[name], -origin) for name in kept.folders])
        fused = self._fused(cameras, views, kept.folders, workspace)
        counts = {name: folder / COUNTS for name, folder in kept.folders.items()}
        cloud = read_fused(fused / FUSED, {name: cameras[name] for name in counts}, counts, self.views)
        cloud = replace(cloud, points=cloud.points + origin, unit=solved.cloud.unit)
        notes.append(
            f"{len(kept.folders)} depth maps fused; points of {np.median(cloud.attributes['views']):.0f} images"
        )
        if self.mesh:
            progress("meshing")
            faces = write_mesh(fused / FUSED, workspace / MESH, origin, cloud.unit)
            notes.append(f"Poisson's mesh of {faces} faces: {workspace / MESH}")
        return Reconstruction(cloud, solved.gauge, solved.cameras, [*solved.notes, *notes], solved.residuals)

    def _solved(self, scene: Scene, workspace: Path) -> Reconstruction:
        """Cameras and sparse points. Given cameras need fewer of these: features are found at one size only."""
        given = self.poses == "given" or (self.poses == "auto" and bool(scene.cameras))
        progress("sparse points" if given else "cameras and sparse points")
        (workspace / _SFM).mkdir(exist_ok=True)
        # Of its cloud only the model is used: how many images have to show a point is decided there.
        sfm = ColmapSfm(poses=self.poses, upsample=not given, min_views=2, seed=self.seed)
        return sfm.reconstruct(scene, workspace / _SFM)

    def _planned(self, scene: Scene, sparse: Sparse) -> tuple[list[MatchedImage], MatchingPlan, list[str]]:
        """What each image is matched with and how much is done, and a note on the images that are left out."""
        references, alone = choose_references(sparse, _CONFIRMING)
        plan = make_plan(_survey(scene, sparse, references), self.spacing, self.sources)
        if not any(len(r.sources) >= self.views - 1 for r in references):
            raise ReconstructionError(
                f"no overlap: no image has {self.views - 1} others that show the same: take more images, or --set"
                f" views={max(2, max(len(r.sources) for r in references) + 1)}"
            )
        notes = [f"{len(alone)} images share too little with others for depths: {some(alone)}"] if alone else []
        return references, plan, notes

    def _filtered(
        self, photographs: Photographs, references: Sequence[MatchedImage], made: Mapping[str, Path], workspace: Path
    ) -> _Filtered:
        """What of the maps other maps confirm, a stage for each image.

        Raises:
            ReconstructionError: nothing is left of any.
        """
        criteria = Criteria(confidence=self.confidence, views=self.views)
        folders, empty = {}, []
        for reference in with_time_left([r for r in references if r.name in made], "filtering"):
            sources = [name for name in reference.sources if name in made]

            def make(folder: Path, name: str = reference.name, sources: Sequence[str] = sources) -> None:
                camera, view = photographs.cameras[name], photographs.view(name)
                others = [(photographs.cameras[source], photographs.map(made[source])) for source in sources]
                kept, agree = filter_map(camera, photographs.map(made[name]), others, criteria, view.valid)
                write_map(folder, kept)
                np.save(folder / COUNTS, np.where(kept.known, 1 + agree.sum(axis=0), 0).astype(np.uint8))
                found = links(camera, kept, agree, sources)
                np.savez(folder / _LINKS, points=found.points, agree=found.agree, sources=np.array(sources, dtype=str))

            inputs = {
                "maps": {name: digest_of(made[name]) for name in (reference.name, *sources)},
                "criteria": repr(criteria),
                "files": [COUNTS, _LINKS],
            }
            folder = stage(*in_folder(workspace / MAPS, reference.name), inputs, make)
            if read_map(folder).known.any():
                folders[reference.name] = folder
            else:
                empty.append(reference.name)
        if not folders:
            raise ReconstructionError(
                f"no map is made: of {len(empty)} images no depth is confident (confidence={self.confidence}) and"
                f" confirmed by {self.views} images: they have no texture, are blurred or masked, or the cameras are"
                " wrong"
            )
        return _Filtered(folders, empty)

    def _fused(
        self, cameras: Mapping[str, Camera], views: Mapping[str, Path], maps: Mapping[str, Path], workspace: Path
    ) -> Path:
        """The stage with the fused cloud and the workspace it comes from."""
        inputs = {"maps": {name: digest_of(folder) for name, folder in maps.items()}}

        def make(folder: Path) -> None:
            progress(f"fusing {len(maps)} maps")
            used = {name: cameras[name] for name in maps}
            found = {name: _read_links(path) for name, path in maps.items()}
            found = {name: _among(link, used) for name, link in found.items()}
            write_workspace(folder, used, {name: views[name] / IMAGE for name in maps}, tracks_of(found, used))
            link_maps(folder, maps)
            fuse(folder, folder / FUSED, used, Criteria.normal_deg)

        return stage(workspace, "fused", inputs, make)


def _local(workspace: Path, cameras: Mapping[str, Camera]) -> tuple[Sparse, FloatArray]:
    """Cameras and sparse points of `sfm` about the first camera's place, and that place: fusion counts in float32."""
    import pycolmap

    model = pycolmap.Reconstruction(workspace / _SFM / "model")
    origin = next(iter(cameras.values())).position.round()
    return sparse_of(model, cameras).about(origin), origin


def _taking_part(references: Sequence[MatchedImage]) -> list[str]:
    """The names of references and their sources."""
    return list(dict.fromkeys(name for r in references for name in (r.name, *r.sources)))


def _survey(scene: Scene, sparse: Sparse, references: Sequence[MatchedImage]) -> ImageSurvey:
    cameras = [sparse.cameras[r.name].intrinsics for r in references]
    names = [r.name for r in references][:: max(1, len(references) // _SAMPLED)]
    samples = []
    for name in names[:_SAMPLED]:
        width, height = scene.size(name)
        part = min(1.0, _SAMPLE_SIDE / max(width, height))
        size = (max(1, round(part * width)), max(1, round(part * height)))
        samples.append(luminance(decode_image(scene.folder / name, size)))
    return ImageSurvey(
        side=round(float(np.median([max(k.width, k.height) for k in cameras]))),
        footprint=float(np.median([r.median_depth / k.fx for r, k in zip(references, cameras, strict=True)])),
        angle_deg=float(np.median([r.angle_deg for r in references])),
        overlap=float(np.median([len(r.sources) for r in references])),
        textured=textured_share(samples),
    )


def _check_disk(workspace: Path, cameras: Mapping[str, Camera]) -> None:
    """Say before an hour of work that its maps do not fit.

    Raises:
        ReconstructionError: they do not.
    """
    pixels = sum(camera.intrinsics.width * camera.intrinsics.height for camera in cameras.values())
    kept = [path for folder in workspace.iterdir() if folder.name != _SFM for path in folder.rglob("*")]
    held = sum(path.stat().st_size for path in kept if path.is_file() and not path.is_symlink())
    needed, free = _BYTES * pixels - held, shutil.disk_usage(workspace).free
    if needed > free:
        raise ReconstructionError(
            f"the disk of {workspace} is too full: the maps of {len(cameras)} images take {_mebibytes(needed)} more,"
            f" and {_mebibytes(free)} are free; make room, or ask for less (--set spacing)"
        )


def _mebibytes(size: int) -> str:
    return f"{size / 2**20:,.0f} MiB"


def _empties(kept: _Filtered, references: Sequence[MatchedImage]) -> list[str]:
    """A note on images without a map, or whose map is empty."""
    lost = [r.name for r in references if r.name not in kept.folders]
    return [f"{len(lost)} of {len(references)} images have no depth that others confirm: {some(lost)}"] if lost else []


def _read_links(folder: Path) -> Links:
    with np.load(folder / _LINKS) as file:
        return Links(file["points"], file["agree"], tuple(str(name) for name in file["sources"]))


def _among(link: Links, cameras: Mapping[str, Camera]) -> Links:
    """What a map's points link among the images that are fused."""
    used = [k for k, name in enumerate(link.sources) if name in cameras]
    return Links(link.points, link.agree[used], tuple(link.sources[k] for k in used))
