"""Which images of a scene are trained on, and which are held out to see how well new views are made."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from pcbench.errors import InputError
from pcbench.geometry.arrays import FloatArray

HoldOut = Literal["none", "every", "blocks"]
"""How images are held out, as a setting of a reconstructor: none, `every` 8th, or 8 `in_blocks`."""

_DEFAULT_BLOCKS = 8
_MIN_BLOCK_IMAGES = 2  # images of a block: one alone has neighbours on both sides, as every n-th has
_MAX_DETOUR = 2.0


@dataclass(frozen=True)
class Split:
    """Images for training and for testing; every image is one of them, once.

    Attributes:
        train: their names, in the scene's order.
        blocks: names of those that are held out, in runs that were taken one after the other. Errors within a block go
            together, so a standard error is that of the blocks' means.
        words: how it was made.
    """

    train: tuple[str, ...]
    blocks: tuple[tuple[str, ...], ...]
    words: str

    @property
    def test(self) -> tuple[str, ...]:
        """The names of all that are held out."""
        return tuple(name for block in self.blocks for name in block)


def hold_out(names: Sequence[str], how: HoldOut, positions: Mapping[str, FloatArray] | None = None) -> Split:
    """The split that a setting names.

    Args:
        names: in the scene's order.
        positions: of the cameras (3,): see `capture_order`.

    Raises:
        InputError: there are too few images.
    """
    if how == "none":
        return Split(tuple(names), (), "no image")
    return every(names) if how == "every" else in_blocks(names, positions=positions)


def every(names: Sequence[str], n: int = 8) -> Split:
    """Every n-th image, from the first, is held out, as is usual since Mip-NeRF 360 (Barron et al. 2022): each is
    between neighbours that are trained on, which is the easy case.

    Raises:
        InputError: there are no more than n images, or n is less than 2.
    """
    if n < 2:
        raise InputError(f"expected every second image or fewer for testing, got one in {n}")
    if len(names) <= n:
        raise InputError(
            f"expected at least {n + 1} images to train on and to test with one in {n} of them, got {len(names)}"
        )
    test = names[::n]
    return Split(_without(names, test), tuple((name,) for name in test), f"one image in {n}")


def in_blocks(
    names: Sequence[str],
    count: int = _DEFAULT_BLOCKS,
    share: float = 1 / 8,
    positions: Mapping[str, FloatArray] | None = None,
) -> Split:
    """Runs of images that were taken one after the other are held out, in the middles of equal parts of the sequence:
    no neighbour of a block's inner images is trained on, which is harder than `every`.

    Args:
        names: in the scene's order.
        count: blocks. For statistics take eight or more.
        share: of the images that is held out; more where blocks would be shorter than two images.
        positions: of the cameras (3,): see `capture_order`.

    Raises:
        InputError: half of the images or more would be held out, or `count` is less than 1.
    """
    if count < 1:
        raise InputError(f"expected at least one block, got {count}")
    length = max(_MIN_BLOCK_IMAGES, round(share * len(names) / count))
    if 2 * length * count > len(names):
        raise InputError(
            f"expected images for training and for testing: for {count} blocks of {length} that are held out at least"
            f" {2 * length * count} images, got {len(names)}: ask for fewer blocks, or hold out every n-th image"
        )
    order = capture_order(names, positions or {})
    starts = [((2 * k + 1) * len(names) - length * count) // (2 * count) for k in range(count)]
    blocks = tuple(tuple(order[start : start + length]) for start in starts)
    held_out = [name for block in blocks for name in block]
    return Split(_without(names, held_out), blocks, f"{count} blocks of {length} images")


def for_choosing(names: Sequence[str], positions: Mapping[str, FloatArray] | None = None) -> Split:
    """Images that a model is chosen by, while it is trained on the others: 8 blocks of two or more where there are 32
    images, else every 8th, or every third where there are few.

    Raises:
        InputError: there are fewer than four images, of which no two could be spared.
    """
    if len(names) >= _DEFAULT_BLOCKS * _MIN_BLOCK_IMAGES * 2:
        return in_blocks(names, _DEFAULT_BLOCKS, positions=positions)
    return every(names, _DEFAULT_BLOCKS if len(names) >= 3 * _DEFAULT_BLOCKS else 3)


def capture_order(names: Sequence[str], positions: Mapping[str, FloatArray]) -> tuple[str, ...]:
    """Names as they were taken, as far as can be known: in the order that is given, unless the way along it through
    the positions is more than twice as long as one that goes from each to the nearest that is left. Then the names
    carry no order (photographs of many people, say), and that way is it.

    Args:
        positions: of the cameras (3,); where one lacks its own, the order that is given holds.
    """
    given = tuple(names)
    if len(given) < 3 or any(name not in positions for name in given):
        return given
    places = np.array([positions[name] for name in given], dtype=np.float64)
    path = _nearest_neighbor_path(places)
    return tuple(given[k] for k in path) if _path_length(places) > _MAX_DETOUR * _path_length(places[path]) else given


def _nearest_neighbor_path(places: FloatArray) -> list[int]:
    """A way through all places, from the first to the nearest that is left, and so on; ties by number."""
    remaining = np.ones(len(places), dtype=bool)
    path = [0]
    remaining[0] = False
    while remaining.any():
        distances = np.square(places - places[path[-1]]).sum(axis=1)
        path.append(int(np.where(remaining, distances, np.inf).argmin()))
        remaining[path[-1]] = False
    return path


def _path_length(places: FloatArray) -> float:
    return float(np.linalg.norm(np.diff(places, axis=0), axis=1).sum())


def _without(names: Sequence[str], held_out: Sequence[str]) -> tuple[str, ...]:
    out = set(held_out)
    return tuple(name for name in names if name not in out)
