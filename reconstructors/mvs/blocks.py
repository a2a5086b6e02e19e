"""Fusion block by block, so that its memory does not grow with the scene.

Space is partitioned into cells. A block fuses the depths whose points lie in its cell, each depth in exactly one block.
Its fused points stay in the cell, up to rounding, because they are medians per coordinate of such points. So no depth
is lost or used twice at a border. Only where depths of one point lie on both sides of it, they become two points.
Points on flat surface are then smoothed with their neighbors in all blocks.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcbench.errors import ReconstructionError
from pcbench.geometry.arrays import FloatArray, freeze
from pcbench.geometry.cameras import Camera
from pcbench.geometry.cloud import Cloud
from pcbench.io import read_cloud
from pcbench.plugins.progress import progress
from pcbench.plugins.stages import stage
from reconstructors.mvs.bundled import stage_digest
from reconstructors.mvs.cells import SpaceCell, bounding_cell, split_space
from reconstructors.mvs.confidence import CONFIDENCE
from reconstructors.mvs.filter import Criteria, world_points
from reconstructors.mvs.flatten import flatten
from reconstructors.mvs.fusion import (
    FUSED,
    VIEWS,
    OverlapSamples,
    build_tracks,
    count_fused,
    fuse,
    link_maps,
    read_fused,
    write_workspace,
)
from reconstructors.mvs.maps import DEPTH, NORMAL, read_depth, write_raster

BLOCKS = "blocks"  # in the workspace: one stage per block

_NAMES_FILE = "images.json"  # in the stage of a block: names of its images, in the order of COLMAP's workspace
_BYTES_PER_POINT = 600  # of a fused point: in COLMAP, with the images that observe it, and while the cloud is smoothed
_MIN_BLOCK_POINTS = 10_000  # a block with fewer expected points is not split
_MARGIN_SPACINGS = 16  # distance in expected point spacings within which points of other blocks are neighbors
_BYTES_PER_GB = 1e9


class FilteredImage(NamedTuple):
    """An image with its filtered map.

    Args:
        camera: pinhole.
        photograph: file of the undistorted photograph.
        map: folder of the map.
        counts: .npy file with the number (H, W) of images that agree at each pixel.
        percents: .npy file with the score (H, W) of each depth in percent.
        overlap: samples of the points of the map.
        depths: number of depths of the map.
    """

    camera: Camera
    photograph: Path
    map: Path
    counts: Path
    percents: Path
    overlap: OverlapSamples
    depths: int


def plan_cells(images: Mapping[str, FilteredImage], memory: float) -> list[SpaceCell]:
    """Partition space into cells whose fusion takes at most `memory` gigabytes.

    The number of fused points is estimated from the samples: a depth on which n images agree becomes 1/n of a point.
    """
    weight = np.concatenate(
        [
            image.depths / max(1, len(image.overlap.points)) / (1 + image.overlap.agreement.sum(axis=0))
            for image in images.values()
        ]
    )
    points = np.concatenate([image.overlap.points for image in images.values()])
    max_points = max(_MIN_BLOCK_POINTS, memory * _BYTES_PER_GB / _BYTES_PER_POINT)
    return split_space(points, lambda rows: float(weight[rows].sum()) <= max_points)


def fuse_blocks(
    images: Mapping[str, FilteredImage], cells: Sequence[SpaceCell], spacing: float, min_views: int, workspace: Path
) -> Cloud:
    """Return the fused and smoothed cloud of all blocks, one after the other; each block is a stage.

    Args:
        images: the images by name, with pinholes in the workspace's frame.
        cells: partition of space in this frame.
        spacing: expected distance between points.
        min_views: minimum number of images that agree on a point, by the filter's criteria.
        workspace: the reconstructor's folder.

    Raises:
        ReconstructionError: no block has a point.
    """
    root = workspace / BLOCKS
    root.mkdir(exist_ok=True)
    bounds = _bound_maps(images) if len(cells) > 1 else None
    stages = []
    for number, cell in enumerate(cells, start=1):
        progress(f"fusing: block {number} of {len(cells)}")
        stages.append(_fuse_block(images, cell, bounds, root, f"{number:04d}"))
    for folder in set(root.iterdir()).difference(stages):  # of an earlier run with other cells
        shutil.rmtree(folder)
    filled = [folder for folder in stages if count_fused(folder / FUSED)]
    if not filled:
        raise ReconstructionError(
            "fusion produced no points: no depth is confirmed by enough images. Take more images with more overlap,"
            " check the cameras, or lower --set correlation or --set views"
        )
    if len(filled) == 1:
        return flatten(_read_block(filled[0], images, min_views))
    return _smooth_blocks(filled, images, _MARGIN_SPACINGS * spacing, min_views)


def fused_files(workspace: Path) -> list[Path]:
    """Return the fused .ply files of the blocks in a workspace, which are not smoothed."""
    return sorted((workspace / BLOCKS).glob(f"*/{FUSED}"))


def _bound_maps(images: Mapping[str, FilteredImage]) -> dict[str, SpaceCell]:
    """Return the smallest box around the points of each map."""
    return {
        name: bounding_cell(_points(image.camera, depth, depth > 0))
        for name, image in images.items()
        if (depth := read_depth(image.map)).any()
    }


def _points(camera: Camera, depth: NDArray[np.float32], mask: NDArray[np.bool_]) -> FloatArray:
    """Return the world points (N, 3) of the pixels of a mask (H, W), row by row."""
    rows, columns = np.nonzero(mask)
    return world_points(camera, np.stack([columns + 0.5, rows + 0.5], axis=1), depth[rows, columns])


def _fuse_block(
    images: Mapping[str, FilteredImage], cell: SpaceCell, bounds: Mapping[str, SpaceCell] | None, root: Path, name: str
) -> Path:
    """Return the stage of a block: the fused points of the depths in its cell, in `FUSED`, if there are any.

    Args:
        images: the images.
        cell: cell of the block.
        bounds: boxes around the maps; None if the cell contains all of them.
        root: parent folder of the stage.
        name: name of the stage.
    """
    near = {k: image for k, image in images.items() if bounds is None or (k in bounds and bounds[k].meets(cell))}
    inputs = {
        "maps": {name: stage_digest(image.map) for name, image in near.items()},
        "cell": [cell.lower.tolist(), cell.upper.tolist()],
    }

    def make(folder: Path) -> None:
        own = near if bounds is None else _own_depths(near, cell, folder / "own")
        (folder / _NAMES_FILE).write_text(json.dumps(list(own)), encoding="utf-8")
        if not own:
            return
        cameras = {name: image.camera for name, image in own.items()}
        tracks = build_tracks({name: image.overlap.restrict(own) for name, image in own.items()}, cameras)
        write_workspace(folder, cameras, {name: image.photograph for name, image in own.items()}, tracks)
        link_maps(folder, {name: image.map for name, image in own.items()})
        fuse(folder, folder / FUSED, cameras, Criteria.normal_deg)
        for part in ("own", "stereo"):
            shutil.rmtree(folder / part, ignore_errors=True)

    return stage(root, name, inputs, make)


def _own_depths(images: Mapping[str, FilteredImage], cell: SpaceCell, folder: Path) -> dict[str, FilteredImage]:
    """Return the images that have depths in a cell, with maps of only these, written into a folder if they differ."""
    own = {}
    for number, (name, image) in enumerate(images.items()):
        depth = read_depth(image.map)
        has_depth = depth > 0
        is_own = has_depth.copy()
        is_own[has_depth] = cell.contains(_points(image.camera, depth, has_depth))
        if (is_own != has_depth).any():
            masked = folder / f"{number:06d}"
            masked.mkdir(parents=True)
            write_raster(masked / DEPTH, np.where(is_own, depth, np.float32(0)))
            (masked / NORMAL).symlink_to((image.map / NORMAL).absolute())
            image = image._replace(map=masked)
        if is_own.any():
            own[name] = image
    return own


def _read_block(folder: Path, images: Mapping[str, FilteredImage], min_views: int) -> Cloud:
    names = json.loads((folder / _NAMES_FILE).read_text(encoding="utf-8"))
    cameras, counts, percents = (
        {name: getattr(images[name], part) for name in names} for part in ("camera", "counts", "percents")
    )
    return read_fused(folder / FUSED, cameras, counts, percents, min_views)


def _smooth_blocks(stages: Sequence[Path], images: Mapping[str, FilteredImage], margin: float, min_views: int) -> Cloud:
    """Return the clouds of the blocks, each smoothed with its neighbors, one after the other.

    Args:
        stages: stages of blocks with points.
        images: the images.
        margin: distance from a block within which points of other blocks are neighbors.
        min_views: minimum number of images that agree on a point.
    """
    starts = np.cumsum([0, *(count_fused(folder / FUSED) for folder in stages)])
    points, normals = np.empty((starts[-1], 3)), np.empty((starts[-1], 3))
    colors = np.empty((starts[-1], 3), np.uint8)
    attributes = {VIEWS: np.empty(starts[-1], np.int32), CONFIDENCE: np.empty(starts[-1], np.float32)}
    bounds = [bounding_cell(read_cloud(folder / FUSED, on_warning=lambda _: None).points) for folder in stages]
    for k, (folder, start) in enumerate(zip(stages, starts, strict=False)):
        progress(f"smoothing: block {k + 1} of {len(stages)}")
        cloud, near = _read_block(folder, images, min_views), bounds[k].grow(margin)
        around = [
            part
            for other, box in zip(stages, bounds, strict=True)
            if other is not folder and box.meets(near) and (part := _crop(other / FUSED, near)) is not None
        ]
        smooth = flatten(cloud, around)
        assert smooth.normals is not None and smooth.colors is not None
        rows = slice(start, start + len(cloud))
        points[rows], normals[rows], colors[rows] = smooth.points, smooth.normals, smooth.colors
        for name, values in attributes.items():
            values[rows] = smooth.attributes[name]
    return Cloud(
        freeze(points), freeze(normals), freeze(colors), {name: freeze(values) for name, values in attributes.items()}
    )


def _crop(fused: Path, cell: SpaceCell) -> Cloud | None:
    """Return the points of a fused cloud in a cell; None if there are none."""
    cloud = read_cloud(fused, on_warning=lambda _: None)
    inside = cell.contains(cloud.points)
    return cloud.select(inside) if inside.any() else None
