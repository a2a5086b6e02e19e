"""Density and spacing: along the surface, and in plan view for clouds that are seen from above.

The density along the surface at a point is (k - 1) / (pi r_k^2), where r_k is the distance to its k-th neighbour: the
unbiased estimate for points strewn over a plane. The density in plan view is the number of points in square cells over
the area of the cells that have points. The USGS Lidar Base Specification 2.1 calls the density of pulses (first
returns) ANPD, and the spacing ANPS = 1 / sqrt(ANPD).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcbench.geometry.arrays import FloatArray, even_rows
from pcbench.geometry.neighbors import Index
from pcbench.geometry.sampling import Sampling
from pcbench.measure.intervals import partition
from pcbench.measure.quality.bootstrap import BlockEstimate, mean_estimate, median_estimate

NEIGHBORS = 16
"""Neighbours from which the density at a point is estimated."""
_SAMPLE = 20_000
_BLOCKS_ALONG = 20  # blocks of cells along the longer side, for intervals
POINTS_PER_CELL = 16.0
"""Mean number of points in a cell of the map."""
MAX_MAP_CELLS = 600
"""Largest number of cells of the map along one side."""
_MAX_EVENNESS = 12.0  # ratio of the densities of the 95th and the 5th percentile of cells of an even cloud
_MAX_HEIGHT_SHARE = 0.5  # of the smaller side of the area, for the heights of a cloud that is seen from above
_INNER = (1, 99)


class PlanMap(NamedTuple):
    """Square cells in plan view, rows from north to south.

    Attributes:
        west: x of the left edge.
        north: y of the upper edge.
        cell: edge of a cell.
        values: (rows, columns) values; NaN: none.
    """

    west: float
    north: float
    cell: float
    values: FloatArray

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """West, east, south and north edges."""
        rows, columns = self.values.shape
        return self.west, self.west + columns * self.cell, self.north - rows * self.cell, self.north


class CloudDensity(NamedTuple):
    """The density of a cloud.

    Attributes:
        spacing: median distance between neighbours, see `pcbench.geometry.sampling.median_spacing`.
        definition: definition of the spacing in words.
        surface: median density along the surface, in points per squared unit.
        surface_ratio: ratio of the 95th to the 5th percentile of the densities along the surface.
        plan: points per squared unit in plan view.
        pulse: first returns per squared unit in plan view; None if returns are not known.
        pulse_spacing: 1 / sqrt(pulse), or of all points if returns are not known.
        plan_area: area of the cells with points.
        filled_share: share of the cells of twice the pulse spacing, in the area, that have a pulse.
        is_seen_from_above: whether the cloud is wide, low and even, so that voids in plan view mean gaps.
        why_not: why it is not; empty if it is.
    """

    spacing: BlockEstimate
    definition: str
    surface: BlockEstimate
    surface_ratio: float
    plan: BlockEstimate
    pulse: BlockEstimate | None
    pulse_spacing: float
    plan_area: float
    filled_share: float | None
    is_seen_from_above: bool
    why_not: str


def measure_density(
    index: Index, sampling: Sampling, is_first: NDArray[np.bool_] | None, seed: int
) -> tuple[CloudDensity | None, PlanMap | None]:
    """Return the density of a cloud and its map; None if the points cover no area.

    Args:
        index: index of the points.
        sampling: their sampling.
        is_first: (N,) whether points are first returns; None: not known.
        seed: seed of the bootstrap.
    """
    points = index.points
    rows = even_rows(len(points), _SAMPLE)
    k = min(1 + max(NEIGHBORS, round(NEIGHBORS * sampling.copies)), len(points))
    reach = index.query(points[rows], k).distances.reshape(len(rows), -1)[:, -1]
    size = np.ptp(points[:, :2], axis=0)
    if k < 4 or not (reach > 0).any() or not size.all():
        return None, None
    kept = reach > 0
    densities = (k - 2) / (math.pi * reach[kept] ** 2)
    blocks = partition(points[rows[kept]]).of_point
    surface = median_estimate(densities, blocks, seed)
    nearest = index.query(points[rows], 2).distances[:, 1]
    spread = median_estimate(nearest, partition(points[rows]).of_point, seed)
    assert surface is not None and spread is not None
    scale = (
        sampling.spacing / spread.value if spread.value > 0 else math.nan
    )  # lines and copies have another definition
    low, high = np.percentile(densities, (5, 95))
    grid = plan_counts(points, POINTS_PER_CELL)
    pulses = points if is_first is None else points[is_first]
    plan, area = _plan_density(points, grid, seed)
    pulse = None
    if is_first is not None and len(pulses):
        pulse, _ = _plan_density(pulses, grid, seed)
    pulse_spacing = 1 / math.sqrt((pulse or plan).value)
    why_not = _why_not_above(points, grid)
    density = CloudDensity(
        spacing=BlockEstimate(sampling.spacing, spread.low * scale, spread.high * scale),
        definition=sampling.definition,
        surface=surface,
        surface_ratio=float(high / low),
        plan=plan,
        pulse=pulse,
        pulse_spacing=pulse_spacing,
        plan_area=area,
        filled_share=None if why_not else _filled_share(pulses, pulse_spacing),
        is_seen_from_above=not why_not,
        why_not=why_not,
    )
    counts = grid.values
    return density, grid._replace(values=np.where(counts > 0, counts / grid.cell**2, np.nan))


def plan_counts(points: FloatArray, points_per_cell: float) -> PlanMap:
    """Return the number of points (N, 3) in square cells of a size that has that many points on average."""
    low, high = points[:, :2].min(axis=0), points[:, :2].max(axis=0)
    size = np.maximum(high - low, 1e-9 * max(float((high - low).max()), 1e-300))
    coarse = math.sqrt(float(size.prod()) / max(len(points) / points_per_cell, 1))
    covered = len(np.unique(np.floor((points[:, :2] - low) / coarse).astype(np.int64) @ [1, 1 << 31])) * coarse**2
    cell = max(math.sqrt(covered * points_per_cell / len(points)), float(size.max()) / MAX_MAP_CELLS)
    return counted(points, low, high, cell)


def counted(points: FloatArray, low: FloatArray, high: FloatArray, cell: float) -> PlanMap:
    """Return the number of points (N, 3) in square cells between two corners (2,)."""
    columns, rows = (np.floor((high - low) / cell).astype(np.int64) + 1).tolist()
    column, row = np.floor((points[:, :2] - low) / cell).astype(np.int64).T
    inside = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
    place = (rows - 1 - row[inside]) * columns + column[inside]
    counts = np.bincount(place, minlength=rows * columns).reshape(rows, columns).astype(np.float64)
    return PlanMap(float(low[0]), float(low[1]) + rows * cell, cell, counts)


def _plan_density(points: FloatArray, grid: PlanMap, seed: int) -> tuple[BlockEstimate, float]:
    """Return the number of points (N, 3) per area of the cells of a grid that have points, and that area.

    Cells at the border are covered in part. So the density is the mean over the cells with eight occupied neighbours,
    or of all occupied cells if there are few of those.
    """
    low = np.array([grid.west, grid.north - grid.values.shape[0] * grid.cell])
    high = low + np.array(grid.values.shape[::-1]) * grid.cell * (1 - 1e-12)
    counts = counted(points, low, high, grid.cell).values[: grid.values.shape[0], : grid.values.shape[1]]
    occupied = grid.values > 0
    inner = _inner(occupied)
    chosen = inner if np.count_nonzero(inner) >= 0.2 * np.count_nonzero(occupied) else occupied
    values = counts[chosen]
    row, column = np.nonzero(chosen)
    side = max(max(grid.values.shape) // _BLOCKS_ALONG, 1)
    estimate = mean_estimate(values, (row // side) * (_BLOCKS_ALONG + 2) + column // side, seed)
    assert estimate is not None
    area = float(np.count_nonzero(occupied)) * grid.cell**2
    return BlockEstimate(*(end / grid.cell**2 for end in estimate)), area


def _inner(occupied: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return which occupied cells (H, W) are surrounded by occupied cells."""
    padded = np.pad(occupied, 1)
    rows, columns = occupied.shape
    inner = occupied.copy()
    for down in range(3):
        for right in range(3):
            inner &= padded[down : down + rows, right : right + columns]
    return inner


def _why_not_above(points: FloatArray, grid: PlanMap) -> str:
    """Return why voids in plan view are no gaps of a survey; empty if they are."""
    low, high = np.percentile(points[even_rows(len(points), _SAMPLE)], _INNER, axis=0)
    size = high - low
    if size[2] > _MAX_HEIGHT_SHARE * size[:2].min():
        return "the cloud is not wide and low"
    counts = grid.values[_inner(grid.values > 0)]
    if len(counts) < 30:
        return "the cloud has few points in the area that it covers"
    few, many = np.percentile(counts, (5, 95))
    if many > _MAX_EVENNESS * max(few, 1):
        return "the density is uneven, as in a scan from one place"
    return ""


def _filled_share(pulses: FloatArray, spacing: float) -> float:
    """Return the share of cells of twice the spacing with a pulse, among those with pulses on two opposite sides."""
    low, high = pulses[:, :2].min(axis=0), pulses[:, :2].max(axis=0)
    filled = counted(pulses, low, high, 2 * spacing).values > 0
    padded = np.pad(filled, 1)
    across = (padded[1:-1, :-2] & padded[1:-1, 2:]) | (padded[:-2, 1:-1] & padded[2:, 1:-1])
    inside = filled | across
    inside[[0, -1]] = inside[:, [0, -1]] = False
    total = np.count_nonzero(inside)
    return float(np.count_nonzero(filled & inside)) / total if total else 1.0
