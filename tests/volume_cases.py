"""Two epochs of points on terrain with a change of exact volume and with known errors, for tests and benchmarks."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from pcbench.geometry.arrays import FloatArray
from pcbench.measure.dem.difference import DemOfDifference, Mask, difference_of
from pcbench.measure.dem.grid import CellMoments, HeightGrid
from pcbench.measure.dem.surface import GridMethod, surface_of
from pcbench.measure.dem.volumes import EstimatedChange, area_change

CELLS = 60
"""Edge of the area, in cells of 1 m."""
FINE = 8
"""Places along the edge of a cell at which a change is summed."""
Heights = Callable[[FloatArray, FloatArray], FloatArray]
"""Heights (N,) at x and y (N,)."""


class Noise(NamedTuple):
    """Errors of the heights of one epoch.

    Attributes:
        white: standard deviation of each point, in m.
        sigma: standard deviation of the correlated error, in m.
        length: length of its correlation function, in m.
        is_gaussian: whether that function is Gaussian; exponential otherwise.
        thinning: whether the density falls by a factor of five from west to east, and the white error doubles.
    """

    white: float = 0.05
    sigma: float = 0.0
    length: float = 1.0
    is_gaussian: bool = True
    thinning: bool = False


class Case(NamedTuple):
    """A terrain, its change and the errors of both epochs."""

    terrain: str
    noise: Noise
    density: tuple[float, float] = (6.0, 5.0)


class Run(NamedTuple):
    """Measured and true volumes of one pair of epochs, in m3, by kind."""

    measured: dict[str, EstimatedChange]
    true: dict[str, float]


def correlated_field(rng: np.random.Generator, size: int, length: float, is_gaussian: bool) -> FloatArray:
    """Return a Gaussian random field (size, size) of variance 1, by circulant embedding of twice the size."""
    around = np.minimum(np.arange(2 * size), 2 * size - np.arange(2 * size))
    distances = np.hypot(*np.meshgrid(around, around)) / length
    correlation = np.exp(-0.5 * distances**2) if is_gaussian else np.exp(-distances)
    spectrum = np.sqrt(np.maximum(np.fft.fft2(correlation).real, 0.0))
    noise = np.fft.fft2(rng.standard_normal(distances.shape))
    field: FloatArray = np.fft.ifft2(spectrum * noise).real[:size, :size]
    return field


def cone(x: FloatArray, y: FloatArray) -> FloatArray:
    """Return the height of a cone of radius 8 m and height 1.5 m."""
    return 1.5 * np.maximum(1 - np.hypot(x - 22, y - 35) / 8, 0.0)


def box(x: FloatArray, y: FloatArray) -> FloatArray:
    """Return the height of a pit of 14 m x 9 m x 0.8 m, and of a box of 6 m x 6 m x 1 m."""
    pit = (x > 30) & (x < 44) & (y > 20) & (y < 29)
    return 1.0 * ((x > 10) & (x < 16) & (y > 41) & (y < 47)) - 0.8 * pit


def ramp(x: FloatArray, y: FloatArray) -> FloatArray:
    """Return the height of a ramp of 20 m x 10 m that rises to 1.2 m."""
    return np.where((x > 20) & (x < 40) & (y > 25) & (y < 35), 1.2 * (x - 20) / 20, 0.0)


def wedge(x: FloatArray, y: FloatArray) -> FloatArray:
    """Return the depth of a cut of 24 m x 12 m whose sides slope to 0.9 m at its middle."""
    return np.where((x > 18) & (x < 42), -np.maximum(0.9 * (1 - np.abs(y - 30) / 6), 0.0), 0.0)


def no_change(x: FloatArray, y: FloatArray) -> FloatArray:
    """Return zero."""
    return 0.0 * x


CHANGES: tuple[Heights, ...] = (cone, box, ramp, wedge, no_change)
EXACT_M3 = {cone: np.pi * 8**2 * 1.5 / 3, box: 36.0 - 0.8 * 126, ramp: 120.0, wedge: -0.9 * 12 / 2 * 24, no_change: 0.0}


def terrain_of(name: str, rng: np.random.Generator, relief: FloatArray | None = None) -> Heights:
    """Return the heights of a terrain; real terrain is a random part of its relief (H, W), twice per metre."""
    from scipy.ndimage import map_coordinates

    if name == "plane":
        return lambda x, y: 0.02 * x
    if name == "ramp":
        return lambda x, y: 0.55 * x + 0.1 * y
    if name == "hills":
        return lambda x, y: 6 * np.sin(x / 9) * np.cos(y / 11)
    if name == "real":
        assert relief is not None
        row, column = rng.integers(0, np.array(relief.shape) - 2 * CELLS - 1)
        return lambda x, y: map_coordinates(relief, [2 * y + row, 2 * x + column], order=1)
    edge = 4 * (CELLS + 2)
    bumps = 0.35 * correlated_field(rng, edge, 6.0, is_gaussian=True)  # four places per metre
    return lambda x, y: map_coordinates(bumps, [4 * y, 4 * x], order=1, mode="nearest")


def epoch_points(
    rng: np.random.Generator, terrain: Heights | FloatArray, change: Heights, noise: Noise, density: float
) -> FloatArray:
    """Return the points (N, 3) of an epoch at random places of a terrain, or at those of its points (N, 3)."""
    from scipy.ndimage import map_coordinates

    if callable(terrain):
        x, y = rng.uniform(0, CELLS, (2, rng.poisson(density * CELLS**2)))
    else:
        x, y = terrain[:, 0], terrain[:, 1]
    white = np.full(len(x), noise.white)
    kept = np.ones(len(x), dtype=bool)
    if noise.thinning:
        kept = rng.random(len(x)) < 1 - 0.8 * x / CELLS
        white *= 1 + x / CELLS
    z = (terrain(x, y) if callable(terrain) else terrain[:, 2]) + change(x, y) + white * rng.standard_normal(len(x))
    if noise.sigma:
        field = noise.sigma * correlated_field(rng, CELLS + 2, noise.length, noise.is_gaussian)
        z = z + map_coordinates(field, [y + 0.5, x + 0.5], order=1)
    return np.column_stack([x, y, z])[kept]


def cell_sums(change: Heights) -> FloatArray:
    """Return the mean change (CELLS, CELLS) in each cell, with rows from north to south."""
    places = (np.arange(CELLS * FINE) + 0.5) / FINE
    x, y = np.meshgrid(places, places[::-1])
    sums: FloatArray = change(x, y).reshape(CELLS, FINE, CELLS, FINE).mean(axis=(1, 3))
    return sums


def epochs(
    case: Case, change: Heights, rng: np.random.Generator, real: FloatArray | None = None
) -> tuple[FloatArray, FloatArray]:
    """Return the points of both epochs.

    Args:
        case: terrain and errors.
        change: change between the epochs.
        rng: random numbers.
        real: relief (H, W) of real terrain, or points (N, 3) of a forest, of which each epoch gets a random half from
            a random part.
    """
    if case.terrain == "forest":
        assert real is not None
        low, high = real[:, :2].min(axis=0), real[:, :2].max(axis=0)
        corner = low + rng.random(2) * (high - low - CELLS)
        part = real[((real[:, :2] >= corner) & (real[:, :2] < corner + CELLS)).all(axis=1)] - [*corner, 0.0]
        first = rng.random(len(part)) < 0.5
        halves = part[first], part[~first]
        return (
            epoch_points(rng, halves[0], no_change, case.noise, 0.0),
            epoch_points(rng, halves[1], change, case.noise, 0.0),
        )
    terrain = terrain_of(case.terrain, rng, real)
    return (
        epoch_points(rng, terrain, no_change, case.noise, case.density[0]),
        epoch_points(rng, terrain, change, case.noise, case.density[1]),
    )


def difference(
    before: FloatArray, after: FloatArray, cell: float = 1.0, method: GridMethod = GridMethod.MEAN
) -> DemOfDifference:
    """Return the DEM of difference of two epochs."""
    grid = HeightGrid.over(np.zeros(2), np.full(2, CELLS - 1e-6), 1.0)
    surfaces = [surface_of(CellMoments(grid, 0.0).add(points), method, points) for points in (before, after)]
    return difference_of(grid, *surfaces)


def run(
    case: Case, change: Heights, seed: int, real: FloatArray | None = None, method: GridMethod = GridMethod.MEAN
) -> Run:
    """Return measured and true volumes: of the whole area, of a zone around the change, and of the changed part."""
    rng = np.random.default_rng(seed)
    result = difference(*epochs(case, change, rng, real), method=method)
    sums = cell_sums(change)
    sums = np.where(result.measured, sums, 0.0)
    zone = np.zeros(sums.shape, dtype=bool)
    zone[8:42, 6:48] = True
    whole, around = (area_change(result, "", mask) for mask in (np.ones_like(zone), zone))
    measured = {"net": whole.volumes.net, "fill": whole.volumes.fill, "cut": whole.volumes.cut}
    true = {"net": sums.sum(), "fill": np.maximum(sums, 0).sum(), "cut": np.maximum(-sums, 0).sum()}
    measured["zone"], true["zone"] = around.volumes.net, sums[zone].sum()
    number = largest_part_on(result.parts, sums)
    if number:
        part: Mask = result.parts == number
        measured["part"], true["part"] = area_change(result, "", part).volumes.net, sums[part].sum()
    return Run(measured, {name: float(value) for name, value in true.items()})


def largest_part_on(parts: np.ndarray, sums: FloatArray) -> int:
    """Return the number of the part that holds most of a change; 0: none."""
    if not sums.any() or not parts.any():
        return 0
    return int(np.bincount(parts.ravel(), np.abs(sums).ravel())[1:].argmax()) + 1


NOISES = {
    "white": Noise(),
    "thinning": Noise(thinning=True),
    "exponential 3 m": Noise(sigma=0.02, length=3, is_gaussian=False),
    "Gaussian 5 m": Noise(sigma=0.02, length=5),
    "Gaussian 9 m": Noise(sigma=0.02, length=9),
    "exponential 15 m": Noise(sigma=0.02, length=15, is_gaussian=False),
}
"""Errors of each epoch by name."""
TERRAINS = ("plane", "ramp", "hills", "rough", "real")


def cases(terrains: Sequence[str] = TERRAINS) -> list[tuple[str, Case]]:
    """Return all pairs of a terrain and an error with their names."""
    return [(f"{terrain}, {name}", Case(terrain, noise)) for terrain in terrains for name, noise in NOISES.items()]
