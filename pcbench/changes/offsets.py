"""Offsets along the normals: cells whose points lie off the other cloud's surface by more than the noise explains."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcbench.changes.samples import Sample
from pcbench.geometry.arrays import FloatArray, IntArray
from pcbench.geometry.neighbors import Index
from pcbench.geometry.order_statistics import NORMAL_MAD, medians_of_rows
from pcbench.geometry.voxels import cells, robust_extent

_FIRST_SIDE = 4.0  # side of the smallest cells, in voxels of the sample; the others are twice as large, and so on
_MAX_EXTENT_SHARE = 1 / 4  # largest side of a cell, in extents
_MIN_POINTS, _MIN_SHEET_SHARE = 6, 0.5  # points on a smooth surface that a tested cell needs
_MIN_CELLS = 3
_MIN_Z = 5.0  # smallest significant offset, in standard errors of the cell's median
_MIN_SIGMAS = 1.0  # and in standard deviations of a point's noise in the region
_MIN_OWN_RATIO = 3.0  # and over the offsets that nine tenths of the cell show in the reference itself
_MIN_LEVEL_SHARE = 0.5  # of the cell's offset, which a point that belongs to it has
_NULL_SHARE = 0.4  # of the cells, which is stable whatever changed: its width gives the scatter of all stable cells
_NULL_Z = 0.5244  # half width of the inner 40 % of a normal distribution, in standard deviations
_REGION_CELLS = 25
# Smallest noise of a region, in the upper quartile of all regions and in voxels: planes do not resolve less.
_MIN_NOISE_SHARE, _MIN_NOISE_SPACINGS = 0.3, 0.0075
_MEDIAN_ERROR = 1.2533  # standard error of a median over that of a mean, for normal values


class Offsets(NamedTuple):
    """Signed distances of the points of a sample from the other cloud's surface, N points.

    Attributes:
        signed: (N,) candidate minus reference, along the reference's normal.
        normals: (N, 3) those normals.
        is_sheet: (N,) whether the reference is a smooth surface there and the other cloud faces the point.
        own: (N,) absolute offset that the reference shows from itself there.
    """

    signed: FloatArray
    normals: FloatArray
    is_sheet: NDArray[np.bool_]
    own: FloatArray


class OffsetTest(NamedTuple):
    """Result of the test at each point of a sample.

    Attributes:
        is_off: (N,) whether the point lies in a cell that is off the surface, on the same side.
        p: (N,) smallest p-value of its cells.
        noise: standard deviation of a point's noise: the median of the tested cells of the smallest size.
        scatter: standard deviation of the medians of the stable ones of these cells.
    """

    is_off: NDArray[np.bool_]
    p: FloatArray
    noise: float
    scatter: float


def shortest_width(values: FloatArray) -> float:
    """Return the standard deviation of the stable part of values (N,): from the shortest interval of 40 % of them."""
    ordered = np.sort(values)
    count = max(2, int(np.ceil(_NULL_SHARE * len(ordered))))
    if len(ordered) <= count:
        return float(np.std(ordered)) if len(ordered) else 0.0
    return float((ordered[count - 1 :] - ordered[: len(ordered) - count + 1]).min()) / (2 * _NULL_Z)


def find_offsets(sample: Sample, offsets: Offsets, least_error: float = 0.0) -> OffsetTest:
    """Test cells of several sizes for an offset from zero.

    The standard error of a cell's median is that of independent noise in its region, or the scatter of the stable
    cells, whichever is larger: errors may be correlated within a cell.

    Args:
        sample: sample of one cloud.
        offsets: offsets of its points.
        least_error: smallest standard error: the scatter of the whole scene, if the sample shows a part of it.
    """
    points = sample.points
    is_off, p, widths = np.zeros(len(points), bool), np.ones(len(points)), [0.0]
    typical_noise = 0.0
    noise, level = _regional_noise(sample, offsets), sample.smooth(offsets.signed)
    by_offset, by_own = np.argsort(offsets.signed), np.argsort(offsets.own)
    side, largest = _FIRST_SIDE * sample.side, _MAX_EXTENT_SHARE * robust_extent(points)
    while side <= max(largest, _FIRST_SIDE * sample.side):
        grid = cells(points, side)
        cell_of_point, count = grid.of_point, len(grid.first)
        sheet = np.bincount(cell_of_point[offsets.is_sheet], minlength=count)
        tested = (sheet >= _MIN_POINTS) & (sheet >= _MIN_SHEET_SHARE * grid.counts)
        if np.count_nonzero(tested) < _MIN_CELLS:
            break
        rows = by_offset[(offsets.is_sheet & tested[cell_of_point])[by_offset]]
        median = _group_quantiles(offsets.signed[rows], cell_of_point[rows], count, 0.5)
        sigma = grid.means(noise)
        relative = np.maximum(sigma / max(float(np.median(sigma[tested])), 1e-300), 1e-300)
        typical_noise = typical_noise or float(np.median(sigma[tested]))
        widths.append(shortest_width((median / relative)[tested]))
        scatter = np.maximum(relative * widths[-1], least_error)
        error = np.maximum(_MEDIAN_ERROR * sigma / np.sqrt(np.maximum(sheet, 1)), scatter) + 1e-300
        own = _group_quantiles(offsets.own[by_own], cell_of_point[by_own], count, 0.9)
        size = np.abs(median)
        off = tested & (size >= _MIN_Z * error) & (size >= np.maximum(_MIN_SIGMAS * sigma, _MIN_OWN_RATIO * own))
        hit = off[cell_of_point] & (level * np.sign(median[cell_of_point]) >= _MIN_LEVEL_SHARE * size[cell_of_point])
        is_off |= hit
        p_of_cell = np.ones(count)
        p_of_cell[off] = _two_sided_p((size / error)[off])
        p[hit] = np.minimum(p[hit], p_of_cell[cell_of_point[hit]])
        side *= 2
    return OffsetTest(is_off, p, typical_noise, widths[min(1, len(widths) - 1)])


def _two_sided_p(deviates: FloatArray) -> FloatArray:
    """Return the probabilities (N,) that a normal variable exceeds deviates (N,) in size."""
    return np.array([math.erfc(each / math.sqrt(2)) for each in deviates.tolist()])


def _regional_noise(sample: Sample, offsets: Offsets) -> FloatArray:
    """Return (N,) standard deviations of a point's noise: the median of the cells in its region."""
    grid = cells(sample.points, _FIRST_SIDE * sample.side)
    count, sheet = len(grid.first), np.flatnonzero(offsets.is_sheet)

    def medians(values: FloatArray) -> FloatArray:
        ascending = sheet[np.argsort(values[sheet])]
        return _group_quantiles(values[ascending], grid.of_point[ascending], count, 0.5)

    spread = medians(np.abs(offsets.signed - medians(offsets.signed)[grid.of_point]))
    populated = np.flatnonzero(np.bincount(grid.of_point[sheet], minlength=count) >= _MIN_POINTS)
    if not len(populated):
        return np.full(len(sample), shortest_width(offsets.signed))
    places = np.stack([grid.means(sample.points[:, axis]) for axis in range(3)], axis=1)
    around = Index(places[populated]).query(places, min(_REGION_CELLS, len(populated))).indices.reshape(count, -1)
    noise: FloatArray = NORMAL_MAD * medians_of_rows(spread[populated], around)[grid.of_point]
    # Where planes are exact, the noise of a region is zero, but not that of the scene.
    least = max(_MIN_NOISE_SHARE * float(np.percentile(noise[sheet], 75)), _MIN_NOISE_SPACINGS * sample.side)
    return np.maximum(noise, least)


def _group_quantiles(ascending: FloatArray, group: IntArray, count: int, share: float) -> FloatArray:
    """Return a quantile (G,) of ascending values (N,) in each group; 0 in empty ones."""
    counts = np.bincount(group, minlength=count)
    starts = np.cumsum(counts) - counts
    quantiles, some = np.zeros(count), counts > 0
    rank = share * (counts[some] - 1)
    low, high = (starts[some] + np.asarray(f(rank), np.int64) for f in (np.floor, np.ceil))
    # numpy sorts integers of 16 bits by radix.
    ordered = ascending[np.argsort(group.astype(np.min_scalar_type(count)), kind="stable")]
    quantiles[some] = 0.5 * (ordered[low] + ordered[high])
    return quantiles
