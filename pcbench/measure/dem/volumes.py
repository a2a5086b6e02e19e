"""Volumes of change from a DEM of difference, each with its interval."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pcbench.geometry.arrays import FloatArray
from pcbench.measure.dem.covariance import Mask
from pcbench.measure.dem.difference import WHOLE_GRID, DemOfDifference, Window

WHOLE_AREA = "all"
"""Name of the area that both epochs cover."""
MOST_PARTS = 100
"""Largest number of changed parts that are listed."""


class EstimatedChange(NamedTuple):
    """A value with its 95 % interval; without an estimate of the errors the ends are NaN."""

    value: float
    low: float
    high: float

    @classmethod
    def within(cls, value: float, half_width: float, *, least: float = -np.inf) -> EstimatedChange:
        """Return a value with a symmetric interval, cut off at the least possible value."""
        return cls(value, max(value - half_width, least) if half_width == half_width else np.nan, value + half_width)

    def scaled(self, factor: float) -> EstimatedChange:
        """Return the value in another unit."""
        return EstimatedChange(self.value * factor, self.low * factor, self.high * factor)


@dataclass(frozen=True)
class CutFill:
    """Volumes over the cells of an area, in cubic units.

    Attributes:
        fill: volume of the raised cells, at least 0.
        cut: volume of the lowered cells, at least 0.
        net: fill less cut.
    """

    fill: EstimatedChange
    cut: EstimatedChange
    net: EstimatedChange


@dataclass(frozen=True)
class AreaChange:
    """The change of an area: of all that both epochs cover, of a zone, or of a changed part.

    Attributes:
        name: name of the area.
        area: area with a difference, in squared units.
        void_area: area without points in an epoch, which no volume includes.
        filled_area: part of `area` of which the differences were filled from the neighbours.
        volumes: volumes of all cells: each changed part by the sign of its sum, the rest by its sum. Without a model of
            the errors, fill and cut are those of `by_sign`.
        by_sign: fill and cut as plain sums by sign, which errors enlarge on both sides.
        detected: volumes of the cells beyond the level of detection alone.
        mean: mean change of height.
        largest: largest rise of a cell.
        lowest: largest fall of a cell, negative.
        undetected_share: share of the area whose change is below the level of detection.
        centre: x and y of the centre of the change.
    """

    name: str
    area: float
    void_area: float
    filled_area: float
    volumes: CutFill
    by_sign: tuple[float, float]
    detected: CutFill
    mean: EstimatedChange
    largest: float
    lowest: float
    undetected_share: float
    centre: tuple[float, float]


def whole_change(difference: DemOfDifference) -> AreaChange:
    """Return the change of all cells."""
    return area_change(difference, WHOLE_AREA, np.ones(difference.dz.shape, dtype=bool))


def part_changes(difference: DemOfDifference) -> Iterator[AreaChange]:
    """Yield the change of each changed part, the largest first, up to `MOST_PARTS`."""
    for number in range(1, min(int(difference.parts.max(initial=0)), MOST_PARTS) + 1):
        yield area_change(difference, f"part {number}", difference.parts == number)


def area_change(difference: DemOfDifference, name: str, mask: Mask) -> AreaChange:
    """Return the change of the cells (H, W) of a mask."""
    window = _bounding_window(mask)
    mask, dz = mask[window], difference.dz[window]
    measured = np.isfinite(dz)
    cells = mask & measured
    dz = np.where(cells, dz, 0.0)
    cell_area, count = difference.grid.cell_area, int(np.count_nonzero(cells))
    beyond = cells & difference.significant[window]
    by_sign = float(np.maximum(dz, 0).sum()) * cell_area, float(np.maximum(-dz, 0).sum()) * cell_area
    if difference.model is None:
        fill, cut, net = (EstimatedChange(each, np.nan, np.nan) for each in (*by_sign, by_sign[0] - by_sign[1]))
        volumes = CutFill(fill, cut, net)
    else:
        volumes = _volumes(difference, window, cells, dz)
    values = dz[cells]
    return AreaChange(
        name=name,
        area=count * cell_area,
        void_area=float(np.count_nonzero(mask & ~measured)) * cell_area,
        filled_area=float(np.count_nonzero(cells & difference.filled[window])) * cell_area,
        volumes=volumes,
        by_sign=by_sign,
        detected=_detected_volumes(difference, window, beyond, dz),
        mean=volumes.net.scaled(1 / (count * cell_area) if count else np.nan),
        largest=float(values.max(initial=0.0)),
        lowest=float(values.min(initial=0.0)),
        undetected_share=1 - np.count_nonzero(beyond) / count if count else 1.0,
        centre=_centre(difference, window, np.abs(dz), cells),
    )


def _bounding_window(mask: Mask) -> Window:
    """Return the rows and columns around the cells of a mask; the whole grid if it has none."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    if not len(rows):
        return WHOLE_GRID
    return slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)


def half_width(difference: DemOfDifference, weights: FloatArray, window: Window = WHOLE_GRID) -> float:
    """Return half the width of the 95 % interval of the volume of weighted cells; NaN without a model.

    Args:
        difference: the DEM of difference.
        weights: (h, w) weights of the cells in the window.
        window: rows and columns of the cells.
    """
    if difference.model is None:
        return np.nan
    further = (difference.datum_sigma * float(weights.sum())) ** 2
    heights = difference.model.half_width(difference.sum_weights(weights, window), further_variance=further)
    return heights * difference.grid.cell_area


def _volumes(difference: DemOfDifference, window: Window, cells: Mask, dz: FloatArray) -> CutFill:
    """Return the volumes of cells: each changed part by the sign of its sum, the other cells by their common sum.

    A sum by the sign of each cell would add up the errors of the cells that did not change. What the other cells hide
    is taken as a change of one sign: a volume is that of the parts alone, or with the other cells, whichever is larger.
    """
    cell_area, parts = difference.grid.cell_area, difference.parts[window]
    outside = cells & (parts == 0)
    signs = difference.part_signs[parts]
    rest = float(dz[outside].sum()) * cell_area
    sides = []
    for sign in (1, -1):
        own = cells & (signs == sign)
        volume = abs(float(dz[own].sum())) * cell_area
        alone = half_width(difference, own.astype(float), window)
        both = half_width(difference, (own | outside).astype(float), window)
        low = max(volume + max(sign * rest - both, -alone), 0.0)
        high = volume + max(sign * rest + both, alone)
        sides.append(EstimatedChange(volume + max(sign * rest, 0.0), low, high))
    net = float(dz.sum()) * cell_area
    return CutFill(sides[0], sides[1], EstimatedChange.within(net, half_width(difference, cells.astype(float), window)))


def _detected_volumes(difference: DemOfDifference, window: Window, beyond: Mask, dz: FloatArray) -> CutFill:
    """Return the volumes of the cells beyond the level of detection."""
    cell_area = difference.grid.cell_area
    sides = []
    for sign in (1, -1):
        own = beyond & (sign * dz > 0)
        volume = abs(float(dz[own].sum())) * cell_area
        sides.append(EstimatedChange.within(volume, half_width(difference, own.astype(float), window), least=0.0))
    net = sides[0].value - sides[1].value
    return CutFill(
        sides[0], sides[1], EstimatedChange.within(net, half_width(difference, beyond.astype(float), window))
    )


def _centre(difference: DemOfDifference, window: Window, weights: FloatArray, cells: Mask) -> tuple[float, float]:
    """Return x and y of the centre of the change, weighed by its size."""
    grid = difference.grid
    if not weights.any():
        weights = cells.astype(float)
    total = float(weights.sum()) or 1.0
    x, y = grid.columns_x[window[1]], grid.rows_y[window[0]]
    return float(weights.sum(axis=0) @ x) / total, float(weights.sum(axis=1) @ y) / total
