"""Training block by block, so that its memory does not grow with the scene.

Space is partitioned into cells. Each block is trained alone, on the photographs that show its cell, and keeps the
Gaussians whose means lie in its cell (VastGaussian, Lin et al. 2024; CityGaussian, Liu et al. 2024). Photographs also
show the surroundings of a cell. Gaussians there take part in the training of the block and are dropped afterwards:
otherwise those of the cell would have to explain the surroundings.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import reduce
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcbench.errors import ReconstructionError
from pcbench.geometry.arrays import FloatArray, IntArray
from pcbench.geometry.cameras import Camera
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.visibility import in_frame
from reconstructors.mvs.cells import SpaceCell, bounding_cell, split_space
from reconstructors.splat.model import Gaussians, LocalFrame

_MAX_SAMPLES = 5000  # points from which blocks are planned
_MIN_BLOCK_SAMPLES = 50  # a cell with fewer is not split
# A photograph shows a cell if it shows half of it, or if a tenth of what it shows is in the cell.
_MIN_CELL_SHARE, _MIN_VIEW_SHARE = 0.5, 0.1
_MIN_BLOCK_IMAGES = 3  # that show most of a cell: as many must agree on a point of the surface
_MARGIN_SHARE = 0.1  # margin around a cell with all initial points, relative to its longest side


class TrainingBlock(NamedTuple):
    """A part of the scene that is trained alone.

    Args:
        cell: cell of the block.
        surroundings: the cell with a margin.
        images: names of the photographs that show the cell, in the scene's order.
        start: indices of the points at which training starts: those in the cell and its margin, and at most as many
            beyond, where the photographs see them.
        share: their number relative to that of all points.
    """

    cell: SpaceCell
    surroundings: SpaceCell
    images: tuple[str, ...]
    start: IntArray
    share: float


def plan_blocks(
    points: FloatArray, cameras: Mapping[str, Camera], fits: Callable[[float, Sequence[str]], bool], seed: int
) -> list[TrainingBlock]:
    """Partition a scene into blocks that fit into memory.

    Args:
        points: (N, 3) points at which training starts.
        cameras: pinholes by image name.
        fits: returns whether a block is small enough with a share of the points and images of these names.
        seed: seed of the choice of points beyond a block.

    Returns:
        The blocks. Those that cannot be split further may be too large.
    """
    samples = points[:: max(1, len(points) // _MAX_SAMPLES)]
    seen = np.stack([in_frame(camera, samples) for camera in cameras.values()])
    names = np.array(list(cameras), dtype=object)

    def is_small(rows: IntArray) -> bool:
        shows = _shows(seen, rows)
        inner = _grow(samples[rows], bounding_cell(samples[rows])).contains(samples)
        start = _choose_start(inner, np.asarray(seen[shows].any(axis=0)), np.random.default_rng(seed))
        return len(rows) < _MIN_BLOCK_SAMPLES or fits(len(start) / len(samples), names[shows].tolist())

    blocks = []
    for number, cell in enumerate(split_space(samples, is_small)):
        rows = np.flatnonzero(cell.contains(samples))
        images = tuple(names[_shows(seen, rows)].tolist())
        surroundings = _grow(samples[rows], cell)
        in_view = np.zeros(len(points), dtype=np.bool_)
        for name in images:
            in_view |= in_frame(cameras[name], points)
        start = _choose_start(surroundings.contains(points), in_view, np.random.default_rng([seed, number]))
        blocks.append(TrainingBlock(cell, surroundings, images, start, len(start) / len(points)))
    return blocks


def _shows(seen: NDArray[np.bool_], rows: IntArray) -> NDArray[np.bool_]:
    """Return the mask of the images that show a cell, at least three if as many see any of its points.

    Args:
        seen: (images, N), True if an image sees a point.
        rows: points of the cell.
    """
    in_cell = seen[:, rows].sum(axis=1)
    shows = (in_cell >= _MIN_CELL_SHARE * len(rows)) | (in_cell >= _MIN_VIEW_SHARE * seen.sum(axis=1))
    shows[np.argsort(-in_cell, kind="stable")[:_MIN_BLOCK_IMAGES]] = True
    return np.asarray(shows & (in_cell > 0))


def _grow(points: FloatArray, cell: SpaceCell) -> SpaceCell:
    """Return a cell with a margin that suits its points (N, 3)."""
    return cell.grow(_MARGIN_SHARE * float(np.ptp(points, axis=0).max()))


def _choose_start(inner: NDArray[np.bool_], in_view: NDArray[np.bool_], rng: np.random.Generator) -> IntArray:
    """Return the indices of the inner points, and of at most as many others in view."""
    inside, beyond = np.flatnonzero(inner), np.flatnonzero(in_view & ~inner)
    if len(beyond) > len(inside):
        beyond = rng.choice(beyond, len(inside), replace=False)
    return np.sort(np.concatenate([inside, beyond]))


class TrainedBlock(NamedTuple):
    """The model of a block in its own frame."""

    model: Gaussians
    frame: LocalFrame
    cell: SpaceCell


def merge_models(blocks: Iterable[TrainedBlock], frame: LocalFrame) -> Gaussians:
    """Return the Gaussians of all blocks whose means lie in the cell of their block, in one frame.

    Raises:
        ReconstructionError: there are none.
    """
    import torch

    parts = []
    for model, own_frame, cell in blocks:
        world = own_frame.to_world(model.means.detach().cpu().numpy())
        rows = np.flatnonzero(cell.contains(world))
        means = torch.from_numpy(frame.to_local(world[rows]).astype(np.float32)).to(model.means.device)
        own = model.select(torch.from_numpy(rows).to(model.means.device))
        parts.append(replace(own, means=means, log_scales=own.log_scales + math.log(own_frame.unit / frame.unit)))
    if not any(map(len, parts)):
        raise ReconstructionError("no Gaussian is left in the cell of its block; check the cameras")
    coefficients = max(part.sh.shape[1] for part in parts)
    padded = [
        replace(part, sh=torch.cat([part.sh, part.sh.new_zeros(len(part), coefficients - part.sh.shape[1], 3)], dim=1))
        for part in parts
    ]
    return reduce(Gaussians.concatenate, padded)


def merge_clouds(clouds: Sequence[Cloud]) -> Cloud:
    """Return the points of clouds with the same attributes, one after the other."""
    assert all(cloud.normals is not None and cloud.colors is not None for cloud in clouds)
    return Cloud(
        np.concatenate([cloud.points for cloud in clouds]),
        np.concatenate([cloud.normals for cloud in clouds if cloud.normals is not None]),
        np.concatenate([cloud.colors for cloud in clouds if cloud.colors is not None]),
        {name: np.concatenate([cloud.attributes[name] for cloud in clouds]) for name in clouds[0].attributes},
    )
