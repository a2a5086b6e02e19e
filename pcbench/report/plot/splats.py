"""Render points as round dots in a parallel view, the nearest on top.

No graphics library is needed, so that pictures are the same on each machine.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pcbench.geometry.arrays import FloatArray
from pcbench.report.plot.views import Viewpoint

_SUPERSAMPLING = 2  # along each side, for round dots with smooth edges
_DEPTH_TOLERANCE_SHARE = 0.01  # of a view's height; points within this depth are drawn in random order
_MIN_DOT_PX, _MAX_DOT_PX = 2.2, 9.0


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
    """Render the points inside a window as an image (height, width, 3).

    Args:
        points: (N, 3) relative to the centre of the frame.
        colors: (N, 3) colours.
        view: the viewpoint.
        window: (2, 2) lower left and upper right corner of the window.
        pixels: width and height of the image.
        ground: (3,) background colour.
        shaded: whether to darken points behind edges, which makes shapes visible. Colours that show values need False.
    """
    width, height = _SUPERSAMPLING * pixels[0], _SUPERSAMPLING * pixels[1]
    right, up, toward = points @ view.axes.T[:, 0], points @ view.axes.T[:, 1], points @ view.axes.T[:, 2]
    (left, bottom), (_, top) = window
    scale = height / (top - bottom)
    column, row = ((right - left) * scale).astype(np.int64), ((top - up) * scale).astype(np.int64)
    inside = np.flatnonzero((column >= 0) & (column < width) & (row >= 0) & (row < height))
    dot = float(np.clip(1.3 * np.sqrt(pixels[0] * pixels[1] / max(len(inside), 1)), _MIN_DOT_PX, _MAX_DOT_PX))
    radius = 0.5 * dot * _SUPERSAMPLING
    edge = int(radius)
    if shaded:
        order = inside[np.argsort(toward[inside])]  # from back to front: the last point at a pixel is visible
    else:
        order = _random_order(
            inside, column, row, toward, max(1, round(2 * radius)), _DEPTH_TOLERANCE_SHARE * float(top - bottom)
        )
    across = width + 2 * edge
    position = (row[order] + edge) * across + column[order] + edge
    top_most = np.zeros(across * (height + 2 * edge), dtype=np.int32)  # 1 + the index in the order; 0 for none
    top_most[position] = np.arange(1, len(order) + 1)
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
    parts = [
        fine[down::_SUPERSAMPLING, along::_SUPERSAMPLING]
        for down in range(_SUPERSAMPLING)
        for along in range(_SUPERSAMPLING)
    ]
    small = sum(parts[1:], start=parts[0]) + len(parts) // 2
    return (small // len(parts)).astype(np.uint8)


def _random_order(
    inside: NDArray[np.int64],
    column: NDArray[np.int64],
    row: NDArray[np.int64],
    toward: FloatArray,
    side: int,
    depth_tolerance: float,
) -> NDArray[np.int64]:
    """Return the visible points in random order.

    Drawing only the nearest points would show the top of a noisy surface and make it look lifted. Points less than
    `depth_tolerance` behind the nearest one in a square of `side` pixels therefore have equal probability.
    """
    down = row[inside] // side
    cell = down * (int(column[inside].max(initial=0)) // side + 1) + column[inside] // side
    nearest = np.full(int(cell.max(initial=0)) + 1, -np.inf)
    np.maximum.at(nearest, cell, toward[inside])
    visible = inside[toward[inside] >= nearest[cell] - depth_tolerance]
    return np.random.default_rng(0).permutation(visible)


def _shade(image: NDArray[np.int32], depths: FloatArray, extent: float) -> NDArray[np.float32]:
    """Return the brightness of each pixel, 0.35 to 1, by eye-dome lighting (Boucheny 2009).

    A pixel is darker the farther it lies behind its neighbours. `depths` (N,) increase towards the viewer.
    """
    known = image > 0
    far = float(depths.min(initial=0.0)) - extent
    depth = np.concatenate([[far], depths]).astype(np.float32)[image]
    hidden = np.zeros_like(depth)
    for step in (2, 5):
        for axis in (0, 1):
            for offset in (-step, step):
                near = np.roll(depth, offset, axis=axis)
                hidden += np.clip(near - depth, 0, 0.02 * extent)
    return np.where(known, np.maximum(np.exp(-hidden * (12.0 / extent)), 0.35), 1.0).astype(np.float32)
