"""Outlines of areas of cells as polygons along the borders of the cells."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pcbench.geometry.arrays import FloatArray
from pcbench.measure.dem.covariance import Mask
from pcbench.measure.dem.grid import HeightGrid

_TURNS = ((0, 1), (1, 0), (0, -1), (-1, 0))  # directions on the lattice of corners as (row, column): E, S, W, N


class Outline(NamedTuple):
    """A polygon: its outer ring (N, 2) and its holes, in x and y, open and with corners only where they turn."""

    outer: FloatArray
    holes: tuple[FloatArray, ...]


def outlines_of(mask: Mask, grid: HeightGrid) -> list[Outline]:
    """Return the polygons of the cells of a mask (H, W), one for each group of cells that share edges.

    The area of the polygons is exactly that of the cells.
    """
    from scipy.ndimage import find_objects, label

    numbers, count = label(mask)
    boxes = find_objects(numbers)
    result = []
    for number, box in zip(range(1, count + 1), boxes, strict=True):
        rings = _rings(numbers[box] == number)
        corner = np.array([box[0].start, box[1].start])
        placed = [_placed(ring + corner, grid) for ring in rings]
        largest = max(range(len(rings)), key=lambda k: _lattice_area(rings[k]))
        result.append(Outline(placed[largest], tuple(ring for k, ring in enumerate(placed) if k != largest)))
    return result


def _rings(mask: Mask) -> list[FloatArray]:
    """Return the rings of a mask as (row, column) of corners, with the cells on the right of each step.

    At a corner where two cells touch, a ring turns to the right, so that each ring surrounds cells that share edges.
    """
    padded = np.pad(mask, 1)
    inside, above, left = padded[1:, 1:], padded[:-1, 1:], padded[1:, :-1]
    starts: dict[tuple[int, int], list[int]] = {}
    for direction, cells in (
        (0, inside & ~above),  # along the upper edge of a cell, eastwards
        (2, above & ~inside),  # along its lower edge, westwards
        (3, inside & ~left),  # along its left edge, northwards: it ends at the corner
        (1, left & ~inside),  # along its right edge, southwards
    ):
        for row, column in np.argwhere(cells).tolist():
            start = {0: (row, column), 2: (row, column + 1), 3: (row + 1, column), 1: (row, column)}[direction]
            starts.setdefault(start, []).append(direction)
    rings = []
    while starts:
        place, directions = next(iter(starts.items()))
        direction = directions[0]
        ring: list[tuple[int, int]] = []
        previous = -1
        while place in starts:
            choices = starts[place]
            if previous >= 0 and len(choices) > 1:
                direction = (previous + 1) % 4  # to the right
            else:
                direction = choices[0]
            choices.remove(direction)
            if not choices:
                del starts[place]
            if direction != previous:
                ring.append(place)
            previous = direction
            place = (place[0] + _TURNS[direction][0], place[1] + _TURNS[direction][1])
        rings.append(np.array(ring, dtype=float))
    return rings


def _placed(ring: FloatArray, grid: HeightGrid) -> FloatArray:
    return np.column_stack([grid.west + ring[:, 1] * grid.cell, grid.north - ring[:, 0] * grid.cell])


def _lattice_area(ring: FloatArray) -> float:
    """Return twice the area of a ring of corners; negative for a hole, which runs the other way."""
    rows, columns = ring.T
    area = columns @ np.roll(rows, -1) - rows @ np.roll(columns, -1)
    return float(area)
