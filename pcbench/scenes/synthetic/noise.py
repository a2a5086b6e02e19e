"""Fractal noise over the surfaces of a city: a position has the same noise at any texel size."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcbench.geometry.arrays import FloatArray

Plane = NDArray[np.float32]  # (rows, columns)


class Grid(NamedTuple):
    """Texel centres of a texture, in metres from its corner; some lie beyond its edges, as a margin."""

    u: FloatArray  # (columns,)
    v: FloatArray  # (rows,)
    width: float
    height: float

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return len(self.v), len(self.u)


class FractalNoise:
    """Windows of a periodic tile of fractal noise with mean 0 and variance 1, averaged over the texel area.

    Args:
        seed: seed of the tile.
        cell: side of the finest cells in metres.
        side: cells along each side; the noise repeats after cell * side metres.
    """

    def __init__(self, seed: int, cell: float, side: int = 2048) -> None:
        from scipy import fft

        rng = np.random.default_rng([seed, 2])
        f = fft.fftfreq(side)[:, None], fft.rfftfreq(side)[None, :]
        # Amplitudes fall with about 1/f, so that there are structures of all sizes.
        amplitude = (1 / np.maximum(np.hypot(*f), 1 / side) ** 1.05).astype(np.float32)
        amplitude[0, 0] = 0
        white = rng.standard_normal((side, side), dtype=np.float32)
        tile = fft.irfft2(amplitude * fft.rfft2(white), s=(side, side))
        self._cell = cell
        self._levels: list[Plane] = [(tile / tile.std()).astype(np.float32)]
        while len(self._levels[-1]) > 16:
            half = len(self._levels[-1]) // 2
            self._levels.append(self._levels[-1].reshape(half, 2, half, 2).mean(axis=(1, 3)))

    def __call__(self, grid: Grid, rng: np.random.Generator, stretch: float = 1.0) -> Plane:
        """Return a window at a random position, at the texels (rows, columns) of `grid`.

        Args:
            grid: texel centres.
            rng: random generator of the position.
            stretch: scale factor of all structures.
        """
        cell = stretch * self._cell
        start = rng.integers(0, len(self._levels[0]), 2)
        texel = (grid.v[-1] - grid.v[0]) / max(1, len(grid.v) - 1) or cell
        level = int(np.clip(np.round(np.log2(abs(texel) / cell)), 0, len(self._levels) - 1))
        tile, size = self._levels[level], cell * 2**level
        rows, columns = (
            positions / size + shift / 2**level - 0.5 for positions, shift in zip((grid.v, grid.u), start, strict=True)
        )
        window = tile[np.ix_(*(_index_range(positions) % len(tile) for positions in (rows, columns)))]
        return np.ascontiguousarray(_interpolate_rows(_interpolate_rows(window, rows).T, columns).T)


def _index_range(positions: FloatArray) -> NDArray[np.int64]:
    """Return all integers needed to interpolate at `positions`."""
    return np.arange(int(np.floor(positions.min())), int(np.floor(positions.max())) + 2)


def _interpolate_rows(window: Plane, positions: FloatArray) -> Plane:
    """Interpolate linearly between rows of a window whose first row is at floor(min(at))."""
    low = np.floor(positions).astype(int)
    part = (positions - low).astype(np.float32)[:, None]
    low -= low.min()
    between: Plane = (1 - part) * window[low] + part * window[low + 1]
    return between
