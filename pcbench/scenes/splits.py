"""Split the images of a scene into training images and held-out images."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from pcbench.errors import InputError
from pcbench.geometry.arrays import FloatArray

HoldOut = Literal["none", "every", "blocks"]
"""Hold-out setting of a reconstructor: no image, `every` 8th image, or 8 blocks (`split_blocks`)."""

_DEFAULT_BLOCKS = 8
_MIN_BLOCK_IMAGES = 2  # a single image has training neighbours on both sides, as in `split_every`
_MAX_DETOUR = 2.0  # maximum length of the given order, relative to the nearest-neighbour path


@dataclass(frozen=True)
class Split:
    """Partition of images into training and test images.

    Attributes:
        train: names of the training images, in the scene's order.
        blocks: names of the held-out images, in runs of consecutively captured images. Errors within a block are
            correlated, so compute a standard error from the block means.
        words: description of the split.
    """

    train: tuple[str, ...]
    blocks: tuple[tuple[str, ...], ...]
    words: str

    @property
    def test(self) -> tuple[str, ...]:
        """Names of all held-out images."""
        return tuple(name for block in self.blocks for name in block)


def hold_out(names: Sequence[str], setting: HoldOut, positions: Mapping[str, FloatArray] | None = None) -> Split:
    """Split images by a hold-out setting.

    Args:
        names: image names in the scene's order.
        setting: hold-out setting.
        positions: camera positions (3,) by name; see `capture_order`.

    Raises:
        InputError: there are too few images.
    """
    if setting == "none":
        return Split(tuple(names), (), "no image")
    return split_every(names) if setting == "every" else split_blocks(names, positions=positions)


def split_every(names: Sequence[str], n: int = 8) -> Split:
    """Hold out every n-th image, starting with the first, as is usual since Mip-NeRF 360 (Barron et al. 2022).

    Each held-out image is between training images, which is the easy case.

    Raises:
        InputError: there are at most n images, or n is less than 2.
    """
    if n < 2:
        raise InputError(f"expected to hold out every 2nd image or fewer, got every {n}th: increase n")
    if len(names) <= n:
        raise InputError(
            f"expected at least {n + 1} images to hold out one in {n}, got {len(names)}: add images or lower n"
        )
    test = names[::n]
    return Split(_without(names, test), tuple((name,) for name in test), f"one image in {n}")


def split_blocks(
    names: Sequence[str],
    count: int = _DEFAULT_BLOCKS,
    share: float = 1 / 8,
    positions: Mapping[str, FloatArray] | None = None,
) -> Split:
    """Hold out blocks of consecutively captured images, each in the middle of one of `count` equal parts.

    The inner images of a block have no neighbouring training image, so this is harder than `split_every`.

    Args:
        names: image names in the scene's order.
        count: number of blocks; use eight or more for statistics.
        share: share of the images to hold out; it is exceeded if blocks would be shorter than two images.
        positions: camera positions (3,) by name; see `capture_order`.

    Raises:
        InputError: more than half of the images would be held out, or `count` is less than 1.
    """
    if count < 1:
        raise InputError(f"expected at least 1 block, got {count}")
    length = max(_MIN_BLOCK_IMAGES, round(share * len(names) / count))
    if 2 * length * count > len(names):
        raise InputError(
            f"expected at least {2 * length * count} images to hold out {count} blocks of {length}, got {len(names)}:"
            " use fewer blocks, or hold out every n-th image"
        )
    order = capture_order(names, positions or {})
    starts = [((2 * k + 1) * len(names) - length * count) // (2 * count) for k in range(count)]
    blocks = tuple(tuple(order[start : start + length]) for start in starts)
    held_out = [name for block in blocks for name in block]
    return Split(_without(names, held_out), blocks, f"{count} blocks of {length} images")


def split_for_selection(names: Sequence[str], positions: Mapping[str, FloatArray] | None = None) -> Split:
    """Hold out images for model selection.

    At least 32 images: 8 blocks. Fewer: every 3rd image, which is at least eight images of 24.

    Raises:
        InputError: there are fewer than four images.
    """
    if len(names) >= _DEFAULT_BLOCKS * _MIN_BLOCK_IMAGES * 2:
        return split_blocks(names, _DEFAULT_BLOCKS, positions=positions)
    return split_every(names, 3)


def capture_order(names: Sequence[str], positions: Mapping[str, FloatArray]) -> tuple[str, ...]:
    """Return names in the probable order of capture.

    This is the given order, unless its path through the positions is more than twice as long as the path that always
    continues to the nearest remaining position. In that case the names say nothing about the order, as with photographs
    by many people, and the nearest-neighbour path is returned.

    Args:
        names: image names.
        positions: camera positions (3,) by name; if one is missing, the given order is returned.
    """
    original_order = tuple(names)
    if len(original_order) < 3 or any(name not in positions for name in original_order):
        return original_order
    points = np.array([positions[name] for name in original_order], dtype=np.float64)
    path = _nearest_neighbor_path(points)
    return (
        tuple(original_order[k] for k in path)
        if _path_length(points) > _MAX_DETOUR * _path_length(points[path])
        else original_order
    )


def _nearest_neighbor_path(points: FloatArray) -> list[int]:
    """Return the path from the first position to the nearest remaining one, and so on; ties go to the lower index."""
    remaining = np.ones(len(points), dtype=bool)
    path = [0]
    remaining[0] = False
    while remaining.any():
        distances = np.square(points - points[path[-1]]).sum(axis=1)
        path.append(int(np.where(remaining, distances, np.inf).argmin()))
        remaining[path[-1]] = False
    return path


def _path_length(points: FloatArray) -> float:
    return float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())


def _without(names: Sequence[str], held_out: Sequence[str]) -> tuple[str, ...]:
    out = set(held_out)
    return tuple(name for name in names if name not in out)
