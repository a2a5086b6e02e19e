"""Dense multi-view stereo: PatchMatch depth and normal maps, filtered against each other and fused by COLMAP.

The method is COLMAP's dense stereo and fusion (Schonberger et al. 2016), which Gao et al. use for their reference. The
bundled matcher is of the same family and runs on any CPU.
"""

from __future__ import annotations

import shutil
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from pcbench.errors import InputError, ReconstructionError
from pcbench.extras import import_problem
from pcbench.geometry.arrays import freeze
from pcbench.geometry.cameras import Camera, Intrinsics
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.geodesy import Gps
from pcbench.io.colmap_model import write_colmap_model
from pcbench.plugins import Gauge, Reconstruction
from pcbench.plugins.progress import progress, with_time_left
from pcbench.plugins.stages import stage
from pcbench.registration import SurveyResiduals
from pcbench.scenes import Scene
from pcbench.scenes.decode import decode_image
from pcbench.scenes.scene import first_names
from reconstructors.mvs.backend import Backend, choose_backend, compute_colmap_maps
from reconstructors.mvs.blocks import FilteredImage, fuse_blocks, fused_files, plan_cells
from reconstructors.mvs.bundled import Matching, compute_bundled_maps, stage_digest
from reconstructors.mvs.confidence import CONFIDENCE, MIN_SCENE_ANGLE_DEG, depth_percents, keep_precise
from reconstructors.mvs.filter import Criteria, filter_map
from reconstructors.mvs.fusion import OverlapSamples, sample_overlap, write_mesh
from reconstructors.mvs.halos import remove_halos
from reconstructors.mvs.maps import read_depth, write_map
from reconstructors.mvs.plan import MAX_SOURCES_PER_IMAGE, ImageSurvey, MatchingPlan, make_plan, measure_textured_share
from reconstructors.mvs.sources import MIN_POINTS, MatchedImage, choose_references
from reconstructors.mvs.sparse import SparseModel, recenter_camera, sparse_from_colmap, without_points
from reconstructors.mvs.views import IMAGE, ViewCache, luminance, pinhole, stage_location, view_stage
from reconstructors.sfm.features import NoPointsError
from reconstructors.sfm.images import drop_unreadable
from reconstructors.sfm.sfm import ColmapSfm

MAPS = "maps"  # in the workspace: one folder per image, and the model of their cameras
MESH = "mesh.ply"  # in the workspace
MIN_MEMORY_GB = 0.01

VIEW_COUNTS = "views.npy"  # in the folder of a map: how many images agree at each pixel, (H, W)
PERCENTS = "percents.npy"  # beside it: the score of each depth in percent, (H, W)
_OVERLAP_FILE = "links.npz"
_SFM = "sfm"  # in the workspace: the files of `sfm`
_MAX_CONFIRMING_VIEWS = 12  # images whose maps may confirm a depth
_MAX_TEXTURE_SAMPLES = 8  # images from which the share of texture is estimated
_MAX_SAMPLE_SIDE_PX = 1000  # longer side of these images
_BYTES_PER_PIXEL = 3 * 20 + 4 + 36  # depth, normal and confidence three times, the photograph, the cloud
_EXTRA_CACHED_VIEWS = 3  # cached views and maps beyond those of a reference and its sources
_TWO_IMAGES_NOTE = "two images: no third one confirms the points on which both agree, so more of them are wrong"


class _FilteredStage(NamedTuple):
    """Stage of a filtered map, and the number of its depths."""

    folder: Path
    depths: int


class _CameraSolution(NamedTuple):
    """Cameras, and sparse points if there are any, in the frame of the result; the fields of a `Reconstruction`."""

    cameras: Mapping[str, Camera]
    sparse: SparseModel
    gauge: Gauge
    unit: str | None
    notes: Sequence[str]
    residuals: SurveyResiduals
    origin: Gps | None


@dataclass(frozen=True)
class DenseMvs:
    """Dense multi-view stereo: PatchMatch on the CPU, or COLMAP's on a GPU with CUDA, and COLMAP's fusion.

    poses: `given` uses the scene's cameras as they are, `solve` computes them as `sfm` does; `auto` uses the scene's
    cameras if it has some.
    spacing: desired distance between points, in the unit of the cameras; images are matched at the size that it needs.
    By default they are matched at up to 2000 pixels.
    sources: images that each image is matched with; by default up to 8, if as many overlap.
    backend: `colmap` needs a pycolmap with CUDA and a GPU, `bundled` runs anywhere; `auto` uses COLMAP if it can run.
    precision: expected share of the points within two pixel footprints of the surface; the least confident points are
    dropped until it is reached, and 0 keeps all. The default leaves a margin for a true share of 0.9.
    correlation: minimum correlation of the images at a depth, from 0 to 1.
    views: minimum number of images that agree on a point; 3 gives fewer points and fewer errors. In any case more
    images must confirm a point than see through it.
    memory: gigabytes that fusion may use for points. A scene that needs more is fused in blocks, one after the other.
    mesh: also write a Poisson mesh into the workspace.

    The workspace keeps the depth and normal maps.
    """

    poses: Literal["auto", "given", "solve"] = "auto"
    spacing: float | None = None
    sources: int | None = None
    backend: Backend = "auto"
    precision: float = 0.92
    correlation: float = 0.1
    views: int = 2
    memory: float = 4.0
    mesh: bool = False
    seed: int = 0

    def __post_init__(self) -> None:
        if self.spacing is not None and not (np.isfinite(self.spacing) and self.spacing > 0):
            raise ValueError(f"expected a positive spacing, got {self.spacing}")
        if self.sources is not None and not 1 <= self.sources <= MAX_SOURCES_PER_IMAGE:
            raise ValueError(f"expected 1 to {MAX_SOURCES_PER_IMAGE} sources, got {self.sources}")
        if not 0 <= self.precision <= 1:
            raise ValueError(f"expected a precision from 0 to 1, got {self.precision}")
        if not 0 <= self.correlation <= 1:
            raise ValueError(f"expected a correlation from 0 to 1, got {self.correlation}")
        if self.views < 2:
            raise ValueError(f"expected points of at least 2 images, got views={self.views}")
        if not (np.isfinite(self.memory) and self.memory >= MIN_MEMORY_GB):
            raise ValueError(f"expected at least {MIN_MEMORY_GB:g} gigabytes of memory, got {self.memory:g}")
        if not 0 <= self.seed < 2**31:
            raise ValueError(f"expected a seed from 0 to 2^31 - 1, got {self.seed}")

    @classmethod
    def missing(cls) -> str | None:
        """Return why the reconstructor cannot run here; None if it can."""
        return import_problem("pycolmap", "PIL", extra="mvs")

    def reconstruct(self, scene: Scene, workspace: Path) -> Reconstruction:
        """Compute the cloud; stages in the workspace that are complete are used again.

        Raises:
            InputError: there are too few images, or the backend cannot run.
            ReconstructionError: the images do not overlap, no depth is confirmed, or the disk is full.
        """
        if len(scene) < self.views:
            raise InputError(f"expected at least {self.views} images (views={self.views}), got {len(scene)}")
        backend, why = choose_backend(self.backend)
        solved = self._solve_cameras(scene, workspace)
        # Fusion computes in float32, which needs small coordinates.
        origin = next(iter(solved.cameras.values())).position.round()
        sparse = solved.sparse.recenter(origin)
        references, plan, notes = self._plan_matching(scene, sparse)
        notes += [f"backend {backend}: {why}", *plan.reasons]

        cameras = {name: pinhole(sparse.cameras[name], plan.scale) for name in _matched_names(references)}
        _check_disk(workspace, cameras)
        views = {
            name: view_stage(scene, sparse.cameras[name], camera, workspace)
            for name, camera in with_time_left(list(cameras.items()), "undistorting")
        }
        photographs = ViewCache(cameras, views, _MAX_CONFIRMING_VIEWS + _EXTRA_CACHED_VIEWS)
        matching = Matching(photographs, views, plan, self.seed)
        # Sources are chosen greedily, so the first N of them are the choice for at most N. Only these are matched; the
        # maps of all confirm depths, which is cheap.
        matched = [r._replace(sources=r.sources[: plan.sources]) for r in references]
        if backend == "colmap":
            maps = compute_colmap_maps(matching, matched, sparse, workspace)
        else:
            maps = compute_bundled_maps(matching, matched, workspace)

        filtered = self._filter_maps(photographs, references, maps, workspace)
        photographs.clear()
        notes += _describe_missing_maps(filtered, references)
        write_colmap_model(workspace / MAPS, [recenter_camera(cameras[name], -origin) for name in filtered])
        images = {
            name: FilteredImage(
                cameras[name],
                views[name] / IMAGE,
                folder,
                folder / VIEW_COUNTS,
                folder / PERCENTS,
                _read_overlap(folder),
                depths,
            )
            for name, (folder, depths) in filtered.items()
        }
        cells = plan_cells(images, self.memory)
        fused = fuse_blocks(images, cells, plan.spacing, self.views, workspace)
        angle_deg = float(np.median([r.angle_deg for r in references]))
        cloud = fused if angle_deg < MIN_SCENE_ANGLE_DEG else keep_precise(fused, self.precision)
        cloud = replace(cloud, points=freeze(cloud.points + origin), unit=solved.unit)
        in_blocks = f" in {len(cells)} blocks" if len(cells) > 1 else ""
        notes.append(
            f"{len(images)} depth maps fused{in_blocks}; median of {np.median(cloud.attributes['views']):.0f} images"
            " per point"
        )
        notes += _describe_dropped(fused, cloud, self.precision, angle_deg)
        if len(images) == 2:
            notes.append(_TWO_IMAGES_NOTE)
        if self.mesh:
            progress("meshing")
            faces = write_mesh(fused_files(workspace), workspace / MESH, origin, cloud.unit)
            notes.append(f"Poisson mesh with {faces} faces: {workspace / MESH}")
        notes = [*solved.notes, *notes]
        return Reconstruction(cloud, solved.gauge, solved.cameras, notes, solved.residuals, solved.origin)

    def _solve_cameras(self, scene: Scene, workspace: Path) -> _CameraSolution:
        """Compute cameras and sparse points with `sfm`. With given cameras, one feature scale yields enough points.

        Given cameras also suffice without any point: their viewing volumes bound the depths.
        """
        import pycolmap

        keeps_cameras = self.poses == "given" or (self.poses == "auto" and bool(scene.cameras))
        progress("sparse points" if keeps_cameras else "cameras and sparse points")
        (workspace / _SFM).mkdir(exist_ok=True)
        # Only the model of this result is used: the minimum number of images per point is applied later.
        sfm = ColmapSfm(poses=self.poses, upsample=not keeps_cameras, min_views=2, seed=self.seed)
        try:
            solved = sfm.reconstruct(scene, workspace / _SFM)
        except NoPointsError as error:
            if not keeps_cameras:
                raise
            readable, notes = drop_unreadable(scene.select(scene.cameras), workspace / _SFM)
            notes.append(f"warning: no sparse points, so the given cameras cannot be checked: {error}")
            unit = None if scene.origin is None else "m"
            cameras = readable.cameras
            sparse = without_points(cameras)
            return _CameraSolution(cameras, sparse, "georeferenced", unit, notes, SurveyResiduals(), scene.origin)
        sparse = sparse_from_colmap(pycolmap.Reconstruction(workspace / _SFM / "model"), solved.cameras)
        unit, gauge = solved.cloud.unit, solved.gauge
        return _CameraSolution(solved.cameras, sparse, gauge, unit, solved.notes, solved.residuals, solved.origin)

    def _plan_matching(self, scene: Scene, sparse: SparseModel) -> tuple[list[MatchedImage], MatchingPlan, list[str]]:
        """Choose the sources of each image and the matching plan; the notes name the images that are left out."""
        references, isolated = choose_references(sparse, _MAX_CONFIRMING_VIEWS)
        plan = make_plan(_survey_images(scene, sparse, references), self.spacing, self.sources)
        if not any(len(r.sources) >= self.views - 1 for r in references):
            raise ReconstructionError(
                f"no overlap: no image shares its view with {self.views - 1} others: take more images, or --set"
                f" views={max(2, max(len(r.sources) for r in references) + 1)}"
            )
        notes = []
        if len(sparse.points) < MIN_POINTS:
            notes.append(
                f"{len(sparse.points)} sparse points are too few for depth ranges: these follow from where the viewing"
                " volumes of neighbouring cameras meet"
            )
        if isolated:
            notes.append(
                f"{len(isolated)} images overlap too little with others to compute depths: {first_names(isolated)}"
            )
        return references, plan, notes

    def _filter_maps(
        self, photographs: ViewCache, references: Sequence[MatchedImage], maps: Mapping[str, Path], workspace: Path
    ) -> dict[str, _FilteredStage]:
        """Keep the depths that other maps confirm and that are no halos, in one stage per image.

        Returns:
            The stages of the maps that have depths, by image name.

        Raises:
            ReconstructionError: no map has a confirmed depth.
        """
        criteria = Criteria(confidence=self.correlation, views=self.views)
        stages = {}
        for reference in with_time_left([r for r in references if r.name in maps], "filtering"):
            sources = [name for name in reference.sources if name in maps]

            def make(folder: Path, name: str = reference.name, sources: Sequence[str] = sources) -> None:
                camera, view = photographs.cameras[name], photographs.view(name)
                others = [(photographs.cameras[source], photographs.map(maps[source])) for source in sources]
                filtered = filter_map(camera, photographs.map(maps[name]), others, criteria, view.valid)
                kept, agree = remove_halos(filtered, view.gray)
                write_map(folder, kept)
                np.save(folder / VIEW_COUNTS, np.where(kept.known, 1 + agree.sum(axis=0), 0).astype(np.uint8))
                source_cameras = [photographs.cameras[source] for source in sources]
                np.save(folder / PERCENTS, depth_percents(camera, kept, agree, source_cameras, view.gray))
                overlap = sample_overlap(camera, kept, agree, sources)
                names = np.array(sources, dtype=str)
                np.savez(folder / _OVERLAP_FILE, points=overlap.points, agree=overlap.agreement, sources=names)

            inputs = {
                "maps": {name: stage_digest(maps[name]) for name in (reference.name, *sources)},
                "criteria": repr(criteria),
                "files": [VIEW_COUNTS, PERCENTS, _OVERLAP_FILE],
            }
            folder = stage(*stage_location(workspace / MAPS, reference.name), inputs, make)
            if depths := int(np.count_nonzero(read_depth(folder))):
                stages[reference.name] = _FilteredStage(folder, depths)
        if not stages:
            raise ReconstructionError(
                f"no depth map has confirmed depths: in {len(maps)} images no depth has enough correlation"
                f" (correlation={self.correlation}) and is confirmed by {self.views} images. The images lack texture,"
                " are blurred or masked, or the cameras are wrong"
            )
        return stages


def _matched_names(references: Sequence[MatchedImage]) -> list[str]:
    """Return the names of the references and their sources, each once."""
    return list(dict.fromkeys(name for r in references for name in (r.name, *r.sources)))


def _survey_images(scene: Scene, sparse: SparseModel, references: Sequence[MatchedImage]) -> ImageSurvey:
    """Measure image size, footprint, angles, overlap and texture for the matching plan."""
    cameras = [sparse.cameras[r.name].intrinsics for r in references]
    names = [r.name for r in references][:: max(1, len(references) // _MAX_TEXTURE_SAMPLES)]
    samples = []
    for name in names[:_MAX_TEXTURE_SAMPLES]:
        width, height = scene.size(name)
        part = min(1.0, _MAX_SAMPLE_SIDE_PX / max(width, height))
        size = (max(1, round(part * width)), max(1, round(part * height)))
        samples.append(luminance(decode_image(scene.folder / name, size)))
    return ImageSurvey(
        side_px=round(float(np.median([max(k.width, k.height) for k in cameras]))),
        footprint=median_footprint([r.median_depth for r in references], cameras),
        angle_deg=float(np.median([r.angle_deg for r in references])),
        overlap=float(np.median([len(r.sources) for r in references])),
        textured_share=measure_textured_share(samples),
    )


def median_footprint(depths: Sequence[float], cameras: Sequence[Intrinsics]) -> float:
    """Return the median size of a pixel on the surface, over all pairs of a place and an image that shows it.

    Each image counts by the area that it shows, which is proportional to its pixels and the square of their size.
    Otherwise close images would count like distant ones, which show most of the surface.

    Args:
        depths: median depth of each image.
        cameras: intrinsics of each image.
    """
    sizes = np.array([depth / k.fx for depth, k in zip(depths, cameras, strict=True)])
    areas = np.array([k.width * k.height for k in cameras]) * sizes**2
    order = np.argsort(sizes, kind="stable")
    cumulative = np.cumsum(areas[order])
    return float(sizes[order[np.searchsorted(cumulative, 0.5 * cumulative[-1])]])


def _check_disk(workspace: Path, cameras: Mapping[str, Camera]) -> None:
    """Refuse to start if the maps do not fit on the disk.

    Raises:
        ReconstructionError: the disk has too little free space.
    """
    pixels = sum(camera.intrinsics.width * camera.intrinsics.height for camera in cameras.values())
    present = [path for folder in workspace.iterdir() if folder.name != _SFM for path in folder.rglob("*")]
    present_bytes = sum(path.stat().st_size for path in present if path.is_file() and not path.is_symlink())
    needed, free = _BYTES_PER_PIXEL * pixels - present_bytes, shutil.disk_usage(workspace).free
    if needed > free:
        raise ReconstructionError(
            f"the disk of {workspace} is too full: the maps of {len(cameras)} images need {_mebibytes(needed)} more,"
            f" and {_mebibytes(free)} are free; free some space, or ask for fewer points (--set spacing)"
        )


def _mebibytes(size: int) -> str:
    return f"{size / 2**20:,.0f} MiB"


def _describe_missing_maps(filtered: Collection[str], references: Sequence[MatchedImage]) -> list[str]:
    """Return a note on the images without a confirmed depth, if there are any."""
    missing = [r.name for r in references if r.name not in filtered]
    if not missing:
        return []
    return [f"{len(missing)} of {len(references)} images have no depth that others confirm: {first_names(missing)}"]


def _describe_dropped(fused: Cloud, cloud: Cloud, precision: float, angle_deg: float) -> list[str]:
    """Return a note on the points that were dropped, or on the reason why none were, although they are uncertain."""
    if len(cloud) < len(fused):
        least = float(cloud.attributes[CONFIDENCE].min())
        return [
            f"{1 - len(cloud) / len(fused):.1%} of the points have a confidence below {least:.2f} and were dropped:"
            f" {precision:.0%} of the others are expected within two pixel footprints; --set precision=0 keeps all"
        ]
    expected = float(np.mean(fused.attributes[CONFIDENCE], dtype=np.float64))
    if expected >= precision:
        return []
    if angle_deg < MIN_SCENE_ANGLE_DEG:
        reason = f"confidences are calibrated for images that are at least {MIN_SCENE_ANGLE_DEG:g} degrees apart"
    else:
        reason = f"none has a confidence of {precision:g}; {expected:.0%} are expected within two pixel footprints"
    return [f"warning: no uncertain points were dropped: {reason}"]


def _read_overlap(folder: Path) -> OverlapSamples:
    with np.load(folder / _OVERLAP_FILE) as file:
        return OverlapSamples(file["points"], file["agree"], tuple(str(name) for name in file["sources"]))
