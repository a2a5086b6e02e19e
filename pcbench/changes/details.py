"""Places where a part may have changed that is too small for an even sample of the whole scene.

A large scene has few sampled points on a car or a manhole cover. So some hundred thousand points of both clouds are
compared with the other cloud, and cells in which they lie off it, unlike their surroundings, are searched again with
a finer sample. A place is only a suspicion: the search decides.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pcbench.changes.offsets import shortest_width
from pcbench.changes.samples import MAX_SAMPLE, SIDE_VOXELS
from pcbench.geometry.arrays import FloatArray, IntArray
from pcbench.geometry.neighbors import Index
from pcbench.geometry.order_statistics import medians_of_rows
from pcbench.geometry.voxels import cells

# Ratio of the length scales of the whole scene's sample and of the finer one.
MIN_GAIN, MAX_GAIN = 1.25, 8.0
MAX_SCREENED = 480_000  # points of each cloud
_FAR = 2.0  # distance from the other cloud's points, in length scales of the finer sample
_MIN_FAR = 6  # far points of a suspicious cell
_MIN_SHEET, _MIN_T = 6, 6.0  # points on a smooth surface, and their mean offset over its standard error
_MIN_ERROR = 1e-3  # of an offset, in length scales of the finer sample: exact surfaces have none
_BLOCK_CELLS = 8_192  # whose surroundings are searched at a time, to limit memory
_REGION_CELLS = 25  # around a cell, whose median offset is expected in it
_RING = 2  # cells around a suspicious one that are searched too: its surroundings decide what is normal
_MAX_PLACES = 2_000
_FAR_RATIO = 5.0  # and of the usual distance in the region
_SURFACE_FOLD = 2.0  # area of the surface in a cell, over that of its face


@dataclass(frozen=True, eq=False)
class Places:
    """Cubic cells of a grid that are searched again; a `pcbench.geometry.regions.Region`.

    Attributes:
        cells: (C, 3) numbers of the cells along each axis.
        side: edge length of a cell.
        corner: (3,) lowest corner of the cell (0, 0, 0).
        left_out: number of further suspicious cells, which exceed the sample.
    """

    cells: IntArray
    side: float
    corner: FloatArray
    left_out: int = 0

    @property
    def text(self) -> str:
        """Readable name."""
        return "places"

    def describe(self) -> str:
        """Return a readable name."""
        return "the places that are searched again"

    def shifted(self, origin: FloatArray) -> Places:
        """Return the same cells in coordinates from which `origin` (3,) has been subtracted."""
        return replace(self, corner=self.corner - origin)

    def contains(self, points: FloatArray) -> NDArray[np.bool_]:
        """Return the mask (N,) of the points (N, 3) inside."""
        if not len(points):
            return np.zeros(0, bool)
        grid = cells(points, self.side, self.corner)
        numbers = cell_numbers(points[grid.first], self.side, self.corner)
        near = np.flatnonzero(((numbers >= self.cells.min(axis=0)) & (numbers <= self.cells.max(axis=0))).all(axis=1))
        _, label = np.unique(np.concatenate([self.cells, numbers[near]]), axis=0, return_inverse=True)
        own, others = np.split(label.ravel(), [len(self.cells)])
        inside = np.zeros(len(numbers), bool)
        inside[near] = np.isin(others, own)
        mask: NDArray[np.bool_] = inside[grid.of_point]
        return mask


def cell_numbers(points: FloatArray, side: float, corner: FloatArray) -> IntArray:
    """Return the numbers (N, 3) of the cells of points (N, 3) along each axis, up to 2^31, as in `cells`."""
    return np.floor(np.clip((points - corner) / side, -(2.0**31), 2.0**31 - 1)).astype(np.int64)


@dataclass(frozen=True, eq=False)
class Screened:
    """Some points of a cloud beside the other one, N points.

    Attributes:
        points: (N, 3) points.
        distances: (N,) distances to the other cloud's closest points.
        signed: (N,) signed distances, candidate minus reference, along the reference's normals.
        is_sheet: (N,) whether the reference is a smooth surface there and the other cloud faces the point.
        weight: points of the cloud that each stands for.
    """

    points: FloatArray
    distances: FloatArray
    signed: FloatArray
    is_sheet: NDArray[np.bool_]
    weight: float


def find_places(
    screens: tuple[Screened, Screened], side: float, finer: float, changed: FloatArray, corner: FloatArray
) -> Places | None:
    """Return the cells that are searched again, those with the largest offsets if there are many.

    Args:
        screens: points of the reference and of the candidate.
        side: length scale of the sample of the whole scene, the edge length of a cell.
        finer: length scale of the finer sample.
        changed: (K, 3) sampled points of parts that the search of the whole scene found.
        corner: (3,) corner of the cells.
    """
    of_point, numbers = _grid(np.concatenate([screen.points for screen in screens]), side, corner)
    count = len(numbers)
    centers = (numbers + 0.5) * side + corner
    distances = np.concatenate([screen.distances for screen in screens])
    strength = np.maximum(
        _far_distances(distances, of_point, centers, finer), _offsets(screens, of_point, centers, finer)
    )
    if len(changed):
        strength[Index(changed).query(centers).distances <= (_RING + 1) * side] = 0
    order = np.argsort(-strength, kind="stable")[: np.count_nonzero(strength)]
    weights = np.concatenate([np.full(len(screen.points), screen.weight) for screen in screens])
    most = SIDE_VOXELS**2 * _SURFACE_FOLD * (side / finer) ** 2
    expected = np.minimum(np.bincount(of_point, weights, count) / 2, most)
    return _largest(order, numbers, expected, side, corner)


def _grid(points: FloatArray, side: float, corner: FloatArray) -> tuple[IntArray, IntArray]:
    """Return the cell (N,) of each point (N, 3), and the numbers (C, 3) of the occupied cells along each axis."""
    grid = cells(points, side, corner)
    return grid.of_point, cell_numbers(points[grid.first], side, corner)


def _medians_around(values: FloatArray, centers: FloatArray) -> FloatArray:
    """Return the medians (C,) of values (C,) over the region around each cell, given by its centre (C, 3)."""
    index, medians = Index(centers), np.empty(len(centers))
    for start in range(0, len(centers), _BLOCK_CELLS):
        block = slice(start, start + _BLOCK_CELLS)
        near = index.query(centers[block], min(_REGION_CELLS, len(centers))).indices
        medians[block] = medians_of_rows(values, near.reshape(len(near), -1))
    return medians


def _far_distances(distances: FloatArray, of_point: IntArray, centers: FloatArray, finer: float) -> FloatArray:
    """Return the sum (C,) of the distances of far points in each cell; 0 if they are few."""
    count = len(centers)
    mean = np.bincount(of_point, distances, count) / np.bincount(of_point, minlength=count)
    far = np.maximum(_FAR * finer, _FAR_RATIO * _medians_around(mean, centers))
    is_far = distances > far[of_point]
    numbers = np.bincount(of_point[is_far], minlength=count)
    return np.where(numbers >= _MIN_FAR, np.bincount(of_point[is_far], distances[is_far], count), 0.0)


def _offsets(screens: tuple[Screened, Screened], of_point: IntArray, centers: FloatArray, finer: float) -> FloatArray:
    """Return the offset (C,) of each cell from its surroundings times its points; 0 if it is not significant."""
    count = len(centers)
    rows = np.flatnonzero(np.concatenate([screen.is_sheet for screen in screens]))
    values = np.concatenate([screen.signed for screen in screens])[rows]
    cell = of_point[rows]
    numbers, strength = np.bincount(cell, minlength=count), np.zeros(count)
    tested = np.flatnonzero(numbers >= _MIN_SHEET)
    if not len(tested):
        return strength
    numbers, mean = numbers[tested], np.bincount(cell, values, count) / np.maximum(numbers, 1)
    variance = np.bincount(cell, np.square(values - mean[cell]), count)[tested] / (numbers - 1)
    contrast = mean[tested] - _medians_around(mean[tested], centers[tested])
    error = np.maximum(np.sqrt(variance / numbers), max(shortest_width(contrast), _MIN_ERROR * finer))
    strength[tested] = np.where(np.abs(contrast) >= _MIN_T * error, np.abs(contrast) * numbers, 0.0)
    return strength


def _largest(
    order: IntArray, numbers: IntArray, expected: FloatArray, side: float, corner: FloatArray
) -> Places | None:
    """Return the first places in an order, cells with their surroundings, that a sample of limited size holds.

    Args:
        order: suspicious cells, the most suspicious one first.
        numbers: (C, 3) numbers of all occupied cells along each axis.
        expected: (C,) number of points that the finer sample of a cloud has in each cell.
        side: edge length of a cell.
        corner: (3,) corner of the cells.
    """
    if not len(order):
        return None
    first_places = order[:_MAX_PLACES]
    near = Index(numbers.astype(np.float64)).query_radius(numbers[first_places].astype(np.float64), _RING + 0.5)
    cells_of_places, first = np.unique(near.indices, return_index=True)
    place = np.repeat(np.arange(len(first_places)), near.counts)[first]  # the first place that contains a cell
    points = np.cumsum(np.bincount(place, expected[cells_of_places], len(first_places)))
    chosen = cells_of_places[np.flatnonzero(place < max(1, int(np.count_nonzero(points <= MAX_SAMPLE))))]
    return Places(numbers[chosen], side, corner, int(np.count_nonzero(~np.isin(order, chosen))))
