"""Render points as round dots in a parallel view, the nearest on top.

No graphics library is needed, so that pictures are the same on each machine.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcbench.geometry.arrays import FloatArray
from pcbench.report.plot.views import Viewpoint

_SUPERSAMPLING = 2  # along each side, for round dots with smooth edges
_DEPTH_TOLERANCE_SHARE = 0.01  # of a view's height; points within this depth are drawn in random order
_MIN_DOT_PX, _MAX_DOT_PX = 2.2, 9.0
# Diameters as multiples of the mean distance of points in the image: of a cloud, of few points over a backdrop, and of
# a cloud that must have no gaps.
_DOT_SIZE, _SPARSE_DOT_SIZE, _SOLID_DOT_SIZE = 1.3, 0.9, 2.2
_MIN_DENSE_SHARE = 0.5  # of the backdrop's points, for drawing points that show values without gaps
_MIN_BRIGHTNESS, _MIN_VALUE_BRIGHTNESS = 0.35, 0.55  # of colours of a cloud, and of colours that show values
_BACKDROP_CONTRAST = 0.55  # of the backdrop's grey: 0 is the background, 1 a middle grey


class Backdrop(NamedTuple):
    """The shape of a scene in a view, from a cloud that is dense and has little noise.

    Attributes:
        colors: (H, W, 3) the cloud in a shaded grey near the background colour.
        brightness: (H, W) brightness of its shading, from 0 to 1.
        points: number of points of the cloud.
    """

    colors: NDArray[np.uint8]
    brightness: NDArray[np.float32]
    points: int

    @classmethod
    def of(
        cls,
        points: FloatArray,
        view: Viewpoint,
        window: FloatArray,
        pixels: tuple[int, int],
        ground: NDArray[np.uint8],
    ) -> Backdrop:
        """Render points (N, 3), relative to the centre of the frame; the other arguments are those of `splat`."""
        grid = _PixelGrid.of(view, window, pixels)
        color = np.rint(ground + _BACKDROP_CONTRAST * (138.0 - ground)).astype(np.uint8)
        layer = grid.draw(points, np.broadcast_to(color, points.shape), ground, dot_size=_SOLID_DOT_SIZE)
        brightness = layer.brightness(grid.extent)
        return cls(_darken(layer.colors, brightness, _MIN_BRIGHTNESS), brightness, len(points))


def splat(
    points: FloatArray,
    colors: NDArray[np.uint8],
    view: Viewpoint,
    window: FloatArray,
    pixels: tuple[int, int],
    ground: NDArray[np.uint8],
    *,
    backdrop: Backdrop | None = None,
) -> NDArray[np.uint8]:
    """Render the points inside a window as an image (height, width, 3).

    Points behind edges are darker, which makes shapes visible.

    Args:
        points: (N, 3) relative to the centre of the frame.
        colors: (N, 3) colours.
        view: the viewpoint.
        window: (2, 2) lower left and upper right corner of the window.
        pixels: width and height of the image.
        ground: (3,) background colour.
        backdrop: the scene behind points whose colours show values. The points then have its shading, weak enough to
            leave the colours readable, and both sides of a rough surface are drawn equally often.
    """
    grid = _PixelGrid.of(view, window, pixels)
    dot_size = _DOT_SIZE
    if backdrop is not None and backdrop.points > 0:
        is_dense = len(points) >= _MIN_DENSE_SHARE * backdrop.points
        dot_size = _SOLID_DOT_SIZE if is_dense else _SPARSE_DOT_SIZE
    layer = grid.draw(points, colors, ground, random=backdrop is not None, dot_size=dot_size)
    if backdrop is None:
        fine = _darken(layer.colors, layer.brightness(grid.extent), _MIN_BRIGHTNESS)
    else:
        values = _darken(layer.colors, backdrop.brightness, _MIN_VALUE_BRIGHTNESS)
        fine = np.where(layer.is_drawn[..., None], values, backdrop.colors)
    parts = [
        fine[down::_SUPERSAMPLING, along::_SUPERSAMPLING].astype(np.uint16)
        for down in range(_SUPERSAMPLING)
        for along in range(_SUPERSAMPLING)
    ]
    small = sum(parts[1:], start=parts[0]) + len(parts) // 2
    return (small // len(parts)).astype(np.uint8)


class _Layer(NamedTuple):
    """A cloud on the pixels of a view: colours (H, W, 3), depths (H, W) towards the viewer, and where it is drawn."""

    colors: NDArray[np.uint8]
    depths: NDArray[np.float32]
    is_drawn: NDArray[np.bool_]

    def brightness(self, extent: float) -> NDArray[np.float32]:
        """Return the brightness (H, W) by eye-dome lighting (Boucheny 2009), from 0 to 1.

        A pixel is darker the farther it lies behind its neighbours. `extent` is the height of the view, in units of
        length.
        """
        hidden = np.zeros_like(self.depths)
        for step in (2, 5):
            for axis in (0, 1):
                for offset in (-step, step):
                    hidden += np.clip(np.roll(self.depths, offset, axis=axis) - self.depths, 0, 0.02 * extent)
        brightness: NDArray[np.float32] = np.where(self.is_drawn, np.exp(-hidden * (12.0 / extent)), 1.0)
        return brightness.astype(np.float32)


class _PixelGrid(NamedTuple):
    """The fine pixels of a view.

    Attributes:
        axes: directions right, up and towards the viewer, as rows (3, 3).
        left, top: position of the upper left corner.
        width, height: number of fine pixels.
        scale: fine pixels per unit of length.
        size: width and height in coarse pixels.
    """

    axes: FloatArray
    left: float
    top: float
    width: int
    height: int
    scale: float
    size: tuple[int, int]

    @classmethod
    def of(cls, view: Viewpoint, window: FloatArray, pixels: tuple[int, int]) -> _PixelGrid:
        """Return the grid of a window (2, 2) with a size in coarse pixels."""
        (left, bottom), (_, top) = window.tolist()
        width, height = _SUPERSAMPLING * pixels[0], _SUPERSAMPLING * pixels[1]
        return cls(view.axes, left, top, width, height, height / (top - bottom), pixels)

    @property
    def extent(self) -> float:
        """Height of the view, in units of length."""
        return self.height / self.scale

    def draw(
        self,
        points: FloatArray,
        colors: NDArray[np.uint8],
        ground: NDArray[np.uint8],
        *,
        random: bool = False,
        dot_size: float = _DOT_SIZE,
    ) -> _Layer:
        """Draw points (N, 3) as round dots, the nearest on top, or in random order where several are about as near."""
        right, up, toward = (points @ axis for axis in self.axes)
        column = ((right - self.left) * self.scale).astype(np.int64)
        row = ((self.top - up) * self.scale).astype(np.int64)
        inside = np.flatnonzero((column >= 0) & (column < self.width) & (row >= 0) & (row < self.height))
        distance_px = np.sqrt(self.size[0] * self.size[1] / max(len(inside), 1))
        dot = float(np.clip(dot_size * distance_px, _MIN_DOT_PX, _MAX_DOT_PX))
        radius = 0.5 * dot * _SUPERSAMPLING
        edge = int(radius)
        if random:
            order = _random_order(
                inside, column, row, toward, max(1, round(2 * radius)), _DEPTH_TOLERANCE_SHARE * self.extent
            )
        else:
            order = inside[_depth_order(toward[inside], self.extent)]  # the last point at a pixel is visible
        row_length = self.width + 2 * edge
        position = (row[order] + edge) * row_length + column[order] + edge
        top_most = np.zeros(row_length * (self.height + 2 * edge), dtype=np.int32)  # 1 + index in the order; 0 for none
        top_most[position] = np.arange(1, len(order) + 1)
        centers = np.flatnonzero(top_most)
        rank = top_most[centers]
        for down in range(-edge, edge + 1):
            for along in range(-edge, edge + 1):
                if (down or along) and down**2 + along**2 <= radius**2:
                    pixels = centers + (down * row_length + along)
                    top_most[pixels] = np.maximum(top_most[pixels], rank)
        image = top_most.reshape(-1, row_length)[edge : edge + self.height, edge : edge + self.width]
        background = float(toward[order].min(initial=0.0)) - self.extent
        depths = np.concatenate([[background], toward[order]]).astype(np.float32)
        return _Layer(np.concatenate([ground[None], colors[order]])[image], depths[image], image > 0)


def _depth_order(depths: FloatArray, extent: float) -> NDArray[np.int64]:
    """Return the order (N,) from back to front of depths (N,) that increase towards the viewer.

    They are sorted in steps of 1/8192 of the view's height `extent`, which is much faster than an exact order.
    """
    steps = np.clip(depths * (8192 / extent) + 32768, 0, 65535).astype(np.uint16)
    return np.argsort(steps, kind="stable")


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


def _darken(colors: NDArray[np.uint8], brightness: NDArray[np.float32], least: float) -> NDArray[np.uint8]:
    """Return colours (H, W, 3) times a brightness (H, W) of at least `least`."""
    return (colors * np.maximum(brightness, np.float32(least))[..., None]).astype(np.uint8)
