"""Points as an image: each a round dot in a parallel view, the nearest on top. Needs no graphics library, so it works,
and looks the same, on every machine.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pcbench.geometry.arrays import FloatArray
from pcbench.report.plot.views import Viewpoint

_FINER = 2  # drawn so many times larger and averaged: round dots, smooth edges
_FUZZ = 0.01  # of a view's height: depths that are told apart no more
_MIN_DOT, _MAX_DOT = 2.2, 9.0  # pixels


def splat(
    points: FloatArray,
    colors: NDArray[np.uint8],
    view: Viewpoint,
    window: FloatArray,
    pixels: tuple[int, int],
    ground: NDArray[np.uint8],
    *,
    shaded: bool = False,
) -> NDArray[np.uint8]:
    """An image (height, width, 3) of what of the points is in the window.

    Args:
        points: (N, 3) from the centre that the window (2, 2) is about.
        colors: (N, 3).
        pixels: width and height.
        ground: colour (3,) where there is no point.
        shaded: whether places behind others' edges are darkened, which shows shapes. Never where colours are values.
    """
    width, height = _FINER * pixels[0], _FINER * pixels[1]
    right, up, toward = points @ view.axes.T[:, 0], points @ view.axes.T[:, 1], points @ view.axes.T[:, 2]
    (left, bottom), (_, top) = window
    scale = height / (top - bottom)
    column, row = ((right - left) * scale).astype(np.int64), ((top - up) * scale).astype(np.int64)
    seen = np.flatnonzero((column >= 0) & (column < width) & (row >= 0) & (row < height))
    dot = float(np.clip(1.3 * np.sqrt(pixels[0] * pixels[1] / max(len(seen), 1)), _MIN_DOT, _MAX_DOT))
    radius = 0.5 * dot * _FINER
    edge = int(radius)
    if shaded:
        order = seen[np.argsort(toward[seen])]  # from back to front: of several in one place the last one stays
    else:
        order = _fair(seen, column, row, toward, max(1, round(2 * radius)), _FUZZ * float(top - bottom))
    across = width + 2 * edge
    place = (row[order] + edge) * across + column[order] + edge
    top_most = np.zeros(across * (height + 2 * edge), dtype=np.int32)  # 1 + the place in the order; 0 for none
    top_most[place] = np.arange(1, len(order) + 1)
    centers = np.flatnonzero(top_most)
    rank = top_most[centers]
    for down in range(-edge, edge + 1):
        for along in range(-edge, edge + 1):
            if (down or along) and down**2 + along**2 <= radius**2:
                at = centers + (down * across + along)
                top_most[at] = np.maximum(top_most[at], rank)
    image = top_most.reshape(-1, across)[edge : edge + height, edge : edge + width]
    palette = np.concatenate([ground[None], colors[order]])
    fine = palette[image].astype(np.uint16)
    if shaded:
        fine = (fine * _shade(image, toward[order], float(top - bottom))[..., None]).astype(np.uint16)
    parts = [fine[down::_FINER, along::_FINER] for down in range(_FINER) for along in range(_FINER)]
    small = sum(parts[1:], start=parts[0]) + len(parts) // 2
    return (small // len(parts)).astype(np.uint8)


def _fair(
    seen: NDArray[np.int64],
    column: NDArray[np.int64],
    row: NDArray[np.int64],
    toward: FloatArray,
    side: int,
    fuzz: float,
) -> NDArray[np.int64]:
    """Of the rows `seen` those that nothing hides, in an order left to chance.

    The nearest points of a rough surface alone would tell of what lies above it, and not of the rest: whatever is
    less than `fuzz` behind the nearest one in a square of `side` has the same chance.
    """
    down = row[seen] // side
    cell = down * (int(column[seen].max(initial=0)) // side + 1) + column[seen] // side
    nearest = np.full(int(cell.max(initial=0)) + 1, -np.inf)
    np.maximum.at(nearest, cell, toward[seen])
    visible = seen[toward[seen] >= nearest[cell] - fuzz]
    return np.random.default_rng(0).permutation(visible)


def _shade(image: NDArray[np.int32], depths: FloatArray, extent: float) -> NDArray[np.float32]:
    """Of each pixel, from 0.35 to 1: eye-dome lighting (Boucheny 2009), darker the farther its neighbours stand out.

    `depths` (N,) are toward the viewer; what lies a hundredth of the extent behind its neighbours is dark.
    """
    known = image > 0
    far = float(depths.min(initial=0.0)) - extent
    depth = np.concatenate([[far], depths]).astype(np.float32)[image]
    hidden = np.zeros_like(depth)
    for step in (2, 5):
        for axis in (0, 1):
            for way in (-step, step):
                near = np.roll(depth, way, axis=axis)
                hidden += np.clip(near - depth, 0, 0.02 * extent)
    return np.where(known, np.maximum(np.exp(-hidden * (12.0 / extent)), 0.35), 1.0).astype(np.float32)
