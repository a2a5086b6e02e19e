"""The DEM of difference of two epochs, the error of each cell, and the terrain and the parts that changed."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pcbench.geometry.arrays import FloatArray, IntArray
from pcbench.measure.dem.covariance import ErrorModel, Mask, SumWeights
from pcbench.measure.dem.grid import HeightGrid
from pcbench.measure.dem.reml import fit_errors
from pcbench.measure.dem.surface import EpochSurface, slopes_deg
from pcbench.measure.metrics import nmad

Window = tuple[slice, slice]
"""Rows and columns of a part of a grid."""
WHOLE_GRID: Window = (slice(None), slice(None))
LEVEL_Z = 1.96
"""Standard deviations of the level of detection, which 95 % of differences without change do not exceed."""
_OUTLIER_Z = 3.0
_ABOUT_AS_NARROW, _MAX_SPREAD_RATIO = 1.1, 1.5
_ALIKE_SHARE = 0.4  # of cells that lie closest together: up to 60 % may have changed
_NORMAL_WIDTH = 1.0488  # of this share in the middle of a normal distribution, in standard deviations
_MIN_STABLE_SHARE = 0.1  # of the cells outside of changed parts; if fewer are left, the area changed as a whole
_FAMILY_ERROR = 0.01
"""Probability that errors alone make any part that counts as a change, if they are normal."""
MIN_PART_CELLS = 4
_GROWN_CELLS = 2
_SLOPE_EDGES_DEG = (0.0, 5.0, 10.0, 20.0, 30.0, 45.0, 60.0, 90.001)
_COUNT_EDGES = (1, 2, 3, 5, 8, 15, 30, 10**9)
_MIN_BIN_CELLS = 150
_SIGNIFICANT_FACTOR = 1.25
_FILLING_NEIGHBOURS, _FILLING_REACH = 8, 5.0
_FILLED_AT_ONCE = 100_000  # voids, to limit memory


@dataclass(frozen=True)
class ErrorBin:
    """Spread of the differences of stable cells in a range of slope or of points per cell.

    Attributes:
        low: lower end of the range.
        high: upper end of the range.
        cells: number of stable cells.
        nmad: normalised median absolute deviation of their differences, in the unit of heights.
        factor: factor of the standard deviation of the white error in this range.
    """

    low: float
    high: float
    cells: int
    nmad: float
    factor: float


@dataclass(frozen=True, eq=False)
class DemOfDifference:
    """Differences of the heights of two epochs.

    Attributes:
        grid: the cells.
        before: heights of the first epoch.
        after: heights of the second epoch.
        dz: (H, W) differences, later minus earlier; NaN in voids. The offset of the stable terrain is subtracted if
            that terrain was named.
        white: (H, W) variances of the differences as the scatter of the points states them, relative to the model.
        filled: (H, W) cells without points in an epoch whose difference was interpolated.
        stable: (H, W) cells from which the errors were estimated: without change, or those that changed alike if the
            area changed as a whole.
        offset: mean difference of the named stable terrain, which was subtracted; None: none was named.
        model: errors of the cells; None: the stable terrain is too small.
        parts: (H, W) number of the changed part of each cell, from 1; 0 outside, and everywhere without a model.
        by_slope: spread of stable cells by slope.
        by_count: spread of stable cells by the number of points in the sparser epoch.
        datum_sigma: standard deviation of the offset between the epochs.
        slopes_deg: (H, W) slope of the mean of both epochs.
    """

    grid: HeightGrid
    before: EpochSurface
    after: EpochSurface
    dz: FloatArray
    white: FloatArray
    filled: Mask
    stable: Mask
    offset: float | None
    model: ErrorModel | None
    parts: NDArray[np.int32]
    by_slope: tuple[ErrorBin, ...]
    by_count: tuple[ErrorBin, ...]
    datum_sigma: float
    slopes_deg: FloatArray

    @property
    def is_offset_subtracted(self) -> bool:
        """Return whether the mean difference of named stable terrain was subtracted."""
        return self.offset is not None

    @cached_property
    def part_signs(self) -> IntArray:
        """Sign (P + 1,) of the sum of the differences of each part; 0 for the cells outside of all."""
        sums = np.bincount(self.parts.ravel(), np.nan_to_num(self.dz).ravel())
        sums[0] = 0.0
        return np.sign(sums).astype(np.int64)

    @property
    def measured(self) -> Mask:
        """The cells (H, W) that have a difference."""
        return np.isfinite(self.dz)

    @property
    def volume_in_voids(self) -> float:
        """The volume that narrow voids would have if they were filled from the cells around them."""
        dz, _, filled = _filled(self.dz, np.zeros_like(self.dz))
        return float(dz[filled].sum()) * self.grid.cell_area

    @cached_property
    def sigma(self) -> FloatArray:
        """Standard deviation (H, W) of the difference of each cell, from all errors; NaN in voids."""
        return cell_sigma(self.model, self.white, self.datum_sigma)

    @property
    def level_of_detection(self) -> FloatArray:
        """The size (H, W) that 95 % of differences without change do not exceed; NaN in voids."""
        return LEVEL_Z * self.sigma

    @cached_property
    def significant(self) -> Mask:
        """The cells (H, W) whose difference exceeds the level of detection."""
        return np.abs(np.nan_to_num(self.dz)) > np.nan_to_num(self.level_of_detection, nan=np.inf)

    def sum_weights(self, weights: FloatArray, window: Window = WHOLE_GRID) -> SumWeights:
        """Return the moments of a weighted sum of differences, with the error of a subtracted offset.

        Args:
            weights: (h, w) weights of the cells in the window.
            window: rows and columns of the cells.
        """
        if self.is_offset_subtracted:
            everywhere = np.zeros(self.dz.shape)
            everywhere[window] = weights
            weights = everywhere - weights.sum() / np.count_nonzero(self.stable) * self.stable
            window = WHOLE_GRID
        return SumWeights.of(weights, np.nan_to_num(self.white[window]))


def cell_sigma(model: ErrorModel | None, white: FloatArray, datum_sigma: float) -> FloatArray:
    """Return the standard deviation (H, W) of the difference of each cell from all errors."""
    scale, correlated = (1.0, 0.0) if model is None else (model.white_scale, model.correlated_sigma)
    result: FloatArray = np.sqrt(scale * white + correlated**2 + datum_sigma**2)
    return result


def difference_of(
    grid: HeightGrid,
    before: EpochSurface,
    after: EpochSurface,
    *,
    named_stable: Mask | None = None,
    is_filled: bool = False,
    datum_sigma: float = 0.0,
) -> DemOfDifference:
    """Return the DEM of difference of two epochs.

    Args:
        grid: the cells of both.
        before: heights of the first epoch.
        after: heights of the second epoch.
        named_stable: cells (H, W) that are known not to have changed; their mean difference is subtracted.
        is_filled: whether voids are filled from their neighbours.
        datum_sigma: standard deviation of an offset between the epochs, in the unit of heights.
    """
    dz = after.heights - before.heights
    white = before.variances + after.variances
    voids = ~np.isfinite(dz)
    filled = np.zeros(dz.shape, dtype=bool)
    if is_filled and voids.any() and not voids.all():
        dz, white, filled = _filled(dz, white)
    floor = np.nanmedian(white) * 1e-6 if np.isfinite(white).any() else 0.0
    white = np.maximum(white, max(float(floor), 1e-24))
    offset = None
    allowed = np.isfinite(dz) & ~filled
    if named_stable is not None:
        allowed &= named_stable
        offset = float(dz[allowed].mean()) if allowed.any() else 0.0
        dz = dz - offset
    stable = _without_outliers(dz, white, allowed) if named_stable is None else allowed
    slopes = slopes_deg((before.heights + after.heights) / 2, grid.cell)
    counts = np.minimum(before.counts, after.counts)
    by_slope: tuple[ErrorBin, ...] = ()
    by_count: tuple[ErrorBin, ...] = ()
    model, parts = None, np.zeros(dz.shape, np.int32)
    for _ in range(2):  # the parts that the errors of the first pass show are left out in the second
        by_slope, white_by_slope = _by_bin(dz, white, stable, slopes, _SLOPE_EDGES_DEG)
        by_count, scaled = _by_bin(dz, white_by_slope, stable, counts, _COUNT_EDGES)
        model = fit_errors(np.nan_to_num(dz), np.nan_to_num(scaled, nan=1.0), stable)
        parts = changed_parts(dz, cell_sigma(model, scaled, datum_sigma))
        if named_stable is not None:
            break
        outside = allowed & (parts == 0)
        if np.count_nonzero(outside) < _MIN_STABLE_SHARE * np.count_nonzero(allowed):
            break  # the area changed as a whole: the cells that changed alike show the errors
        unchanged, stable = stable, _without_outliers(dz, scaled, outside)
        if np.array_equal(unchanged, stable):
            break
    if model is None:  # without errors, nothing tells a changed part from them
        parts = np.zeros_like(parts)
    return DemOfDifference(
        grid,
        before,
        after,
        dz,
        scaled,
        filled,
        stable,
        offset,
        model,
        parts,
        by_slope,
        by_count,
        datum_sigma,
        slopes,
    )


def changed_parts(dz: FloatArray, sigma: FloatArray) -> NDArray[np.int32]:
    """Return the number (H, W) of the changed part of each cell, from 1 for the largest sum; 0 outside of parts.

    A part consists of connected cells of one sign beyond the level of detection, of which at least one exceeds the
    level that the errors of all cells reach with a probability of `_FAMILY_ERROR`. It is grown by `_GROWN_CELLS` cells,
    so that its flat edge belongs to it.
    """
    from scipy.ndimage import label, minimum_filter
    from scipy.special import ndtri

    size = max(int(np.count_nonzero(np.isfinite(dz))), 1)
    seed_z = float(ndtri(1 - _FAMILY_ERROR / (2 * size)))
    scores, sizes = np.nan_to_num(dz / sigma), np.abs(np.nan_to_num(dz))
    labels, first = np.zeros(dz.shape, np.int32), 0
    for sign in (1, -1):
        numbers, count = label(sign * scores > LEVEL_Z, structure=np.ones((3, 3), dtype=bool))
        labels[numbers > 0] = numbers[numbers > 0] + first
        first += count
    is_part = np.bincount(labels.ravel(), minlength=first + 1) >= MIN_PART_CELLS
    is_part &= np.bincount(labels[np.abs(scores) > seed_z], minlength=first + 1) > 0
    is_part[0] = False
    sums = np.bincount(labels.ravel(), sizes.ravel(), minlength=first + 1)
    ranked = np.flatnonzero(is_part)[np.argsort(-sums[is_part], kind="stable")]
    outside = len(ranked) + 1  # above the numbers of all parts, so that of several parts near a cell the largest grows
    order = np.full(first + 1, outside, np.int32)
    order[ranked] = np.arange(1, outside)
    cores = order[labels]
    grown = minimum_filter(cores, 2 * _GROWN_CELLS + 1, mode="constant", cval=outside)
    parts = np.where(cores < outside, cores, np.where(np.isfinite(dz), grown, outside))
    return np.where(parts < outside, parts, 0).astype(np.int32)


def _without_outliers(dz: FloatArray, white: FloatArray, allowed: Mask) -> Mask:
    """Return the allowed cells without those far from most others, and without the neighbours of groups of these.

    The spread of the others includes the correlated errors, so that these are not cut off.
    """
    from scipy.ndimage import binary_dilation

    if not allowed.any():
        return allowed
    middle, spread = _most_alike(dz[allowed])
    correlated = max(spread**2 - float(np.median(white[allowed])), 0.0)
    with np.errstate(invalid="ignore"):
        outlying = allowed & (np.abs(dz - middle) > _OUTLIER_Z * np.sqrt(white + correlated))
    kept: Mask = allowed & ~binary_dilation(outlying & _is_clustered(outlying), iterations=2) & ~outlying
    return kept if np.count_nonzero(kept) >= 0.1 * np.count_nonzero(allowed) else allowed & ~outlying


def _most_alike(values: FloatArray) -> tuple[float, float]:
    """Return the middle and the standard deviation of the values (N,) that did not change.

    These are the median and the normalised median absolute deviation, unless a group of values lies much closer
    together, as where half of the area rose: then the middle and the width of the shortest interval with this share of
    the values (Andrews et al. 1972, the shorth), of equally short ones the one nearest to zero.
    """
    ascending = np.sort(values)
    count = max(round(_ALIKE_SHARE * len(ascending)), 1)
    low, high = ascending[: len(ascending) - count + 1], ascending[count - 1 :]
    widths = high - low
    spread, overall = float(widths.min()) / _NORMAL_WIDTH, nmad(values)
    if overall <= _MAX_SPREAD_RATIO * spread:
        return float(np.median(values)), overall
    middles = ((low + high) / 2)[widths <= _ABOUT_AS_NARROW * widths.min()]
    return float(middles[np.abs(middles).argmin()]), spread


def _is_clustered(mask: Mask) -> Mask:
    """Return the cells of a mask of which at least three more of the 24 around are in the mask."""
    from scipy.ndimage import uniform_filter

    result: Mask = mask & (uniform_filter(mask.astype(float), 5, mode="constant") * 25 > 3.5)
    return result


def _by_bin(
    dz: FloatArray,
    white: FloatArray,
    stable: Mask,
    classes: NDArray[np.floating[Any] | np.integer[Any]],
    edges: tuple[float, ...],
) -> tuple[tuple[ErrorBin, ...], FloatArray]:
    """Return the spread of stable cells by ranges of a property, and white variances that follow it.

    The variances follow where the standardised differences in a range spread clearly more or less than in all.
    """
    numbers = np.clip(np.digitize(classes, edges) - 1, 0, len(edges) - 2)
    residuals = np.where(stable, dz, 0.0)
    residuals = residuals - (np.median(dz[stable]) if stable.any() else 0.0)
    factors = np.ones(len(edges) - 1)
    bins: list[ErrorBin] = []
    overall = nmad(residuals[stable] / np.sqrt(white[stable])) if stable.any() else 0.0
    for number in range(len(edges) - 1):
        chosen = stable & (numbers == number)
        cells = int(np.count_nonzero(chosen))
        if cells < _MIN_BIN_CELLS or not overall > 0:
            continue
        factor = nmad(residuals[chosen] / np.sqrt(white[chosen])) / overall
        if not 1 / _SIGNIFICANT_FACTOR < factor < _SIGNIFICANT_FACTOR:
            factors[number] = factor
        bins.append(ErrorBin(edges[number], edges[number + 1], cells, nmad(residuals[chosen]), float(factors[number])))
    return tuple(bins), white * factors[numbers] ** 2


def _filled(dz: FloatArray, white: FloatArray) -> tuple[FloatArray, FloatArray, Mask]:
    """Fill voids with the mean difference of the eight nearest cells, at most five cells away.

    The variance of a filled cell is the mean variance of these cells and the variance between them.
    """
    from scipy.ndimage import maximum_filter
    from scipy.spatial import KDTree

    measured = np.isfinite(dz)
    reach = 2 * int(_FILLING_REACH) + 1  # side of a window
    sources = measured & maximum_filter(~measured, reach)  # a survey with an outline has many cells far from both
    voids = np.argwhere(~measured & maximum_filter(measured, reach))
    tree = KDTree(np.argwhere(sources))
    count = min(_FILLING_NEIGHBOURS, tree.n)
    values, variances = np.append(dz[sources], 0.0), np.append(white[sources], 0.0)
    new_dz, new_white, filled = dz.copy(), white.copy(), np.zeros(dz.shape, dtype=bool)
    for start in range(0, len(voids), _FILLED_AT_ONCE):
        some = voids[start : start + _FILLED_AT_ONCE]
        queried = tree.query(some, k=count, distance_upper_bound=_FILLING_REACH)
        distances, rows = (np.reshape(each, (len(some), count)) for each in queried)
        near = np.isfinite(distances)
        enough = near.sum(axis=1) >= min(3, count)
        total = np.maximum(near.sum(axis=1), 1)
        means = (values[rows] * near).sum(axis=1) / total
        between = (((values[rows] - means[:, None]) ** 2) * near).sum(axis=1) / total
        places = tuple(some[enough].T)
        new_dz[places] = means[enough]
        new_white[places] = ((variances[rows] * near).sum(axis=1) / total + between)[enough]
        filled[places] = True
    return new_dz, new_white, filled
