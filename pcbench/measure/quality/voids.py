"""Voids: areas without returns, after the USGS Lidar Base Specification 2.1 (collection requirements, data voids).

A void there is an area without first returns of at least (4 x ANPS)^2. Here it is the union of all discs of that area
without a point: points strewn at random leave such a disc empty once in exp(16) places. Such discs reach beyond the
edge of a gap to the points around it, so in the union their radius is a third of a spacing smaller. Voids that reach
the border of the cloud are not counted, because they may lie outside of the survey. The specification allows voids at
water, at dark surfaces, and where another swath fills them; whether a void lies at water is known from points of class
9 around it. Breaklines and polygons are not used.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcbench.geometry.arrays import FloatArray
from pcbench.measure.quality.density import PlanMap, counted

VOID_SPACINGS = 4.0
"""Edge of the square with the least area of a void, in pulse spacings."""
WATER_CLASS = 9
"""Class of water in LAS files."""
_MAX_CELLS = 16_000_000
AT_WATER = 2.0
"""Value of voids at water in the map."""
_RIM_CELLS = 3  # around a void, in which water is looked for
_MIN_WATER_SHARE = 0.5  # of the points around a void, for it to be at water
_CELLS_PER_SPACING = 2.0
_EDGE_SPACINGS = 1 / 3  # from the edge of a gap to the points around it, on average


class Void(NamedTuple):
    """An area without returns.

    Attributes:
        x: x of its centre.
        y: y of its centre.
        area: its area, in squared units.
        is_at_water: whether most points around it are classified as water.
    """

    x: float
    y: float
    area: float
    is_at_water: bool


class Voids(NamedTuple):
    """The voids of a cloud.

    Attributes:
        voids: the voids, the largest first.
        least_area: least area of a void.
        cell: edge of the cells in which the area is measured.
    """

    voids: tuple[Void, ...]
    least_area: float
    cell: float

    @property
    def counted(self) -> tuple[Void, ...]:
        """The voids that are not at water."""
        return tuple(void for void in self.voids if not void.is_at_water)

    @property
    def area(self) -> float:
        """Total area of the voids that are not at water."""
        return sum(void.area for void in self.counted)


def find_voids(pulses: FloatArray, spacing: float, is_water: NDArray[np.bool_] | None) -> tuple[Voids, PlanMap]:
    """Return the voids of a cloud that is seen from above, and their map: 1 in voids, 2 in those at water, else 0.

    Args:
        pulses: (N, 3) first returns, or all points if returns are not known.
        spacing: their spacing (ANPS).
        is_water: (N,) whether points are classified as water; None: not known.
    """
    from scipy.ndimage import binary_dilation, distance_transform_edt, find_objects, label

    low, high = pulses[:, :2].min(axis=0), pulses[:, :2].max(axis=0)
    least = (VOID_SPACINGS * spacing) ** 2
    reach = math.sqrt(least / math.pi)
    cell = max(spacing / _CELLS_PER_SPACING, math.sqrt(float((high - low).prod()) / _MAX_CELLS))
    margin = 2 * math.ceil(reach / cell) + 2
    grid = counted(pulses, low - margin * cell, high + margin * cell, cell)
    empty = grid.values == 0
    # Distances are between centres of cells; a point lies off its centre by 0.38 cells on average.
    centres = distance_transform_edt(empty) * cell > reach
    shown = reach - _EDGE_SPACINGS * spacing
    area = empty & (distance_transform_edt(~centres) * cell <= shown)
    labels, count = label(area)
    outside = np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]])
    numbers = np.setdiff1d(np.arange(1, count + 1), outside)
    water = None
    if is_water is not None and is_water.any():
        water = counted(pulses[is_water], low - margin * cell, high + margin * cell, cell).values
    boxes, voids, shown_voids = find_objects(labels), list[Void](), np.zeros(labels.shape)
    for number in numbers.tolist():
        box = tuple(slice(max(side.start - _RIM_CELLS, 0), side.stop + _RIM_CELLS) for side in boxes[number - 1])
        mask = labels[box] == number
        is_at_water = False
        if water is not None:
            rim = binary_dilation(mask, iterations=_RIM_CELLS)
            is_at_water = bool(water[box][rim].sum() >= _MIN_WATER_SHARE * max(grid.values[box][rim].sum(), 1))
        row, column = np.argwhere(mask).mean(axis=0) + [box[0].start, box[1].start]
        x, y = grid.west + (column + 0.5) * cell, grid.north - (row + 0.5) * cell
        voids.append(Void(float(x), float(y), float(np.count_nonzero(mask)) * cell**2, is_at_water))
        shown_voids[box][mask] = AT_WATER if is_at_water else 1.0
    inner = slice(margin, -margin)
    plan = PlanMap(grid.west + margin * cell, grid.north - margin * cell, cell, shown_voids[inner, inner])
    return Voids(tuple(sorted(voids, key=lambda void: -void.area)), least, cell), plan
