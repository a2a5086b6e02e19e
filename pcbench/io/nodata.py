"""Find points that stand for missing data: fill values such as -9999 in a coordinate, far from all other points.

A value is a fill value if programs are known to write it and it lies outside the range of the other points, or if it
is repeated exactly, is the smallest or the largest, and is isolated. Water at z = 0 beside terrain, flat roofs, grids
and single outliers are none of these.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcbench.geometry.arrays import FloatArray, even_rows
from pcbench.geometry.cloud import Cloud

_KNOWN_VALUES = (  # as programs for rasters, point clouds and depth maps write them
    *(sign * 10.0**power for power in (10, 20, 30, 38) for sign in (-1, 1)),
    *(sign * value for value in (9999.0, 9999.9, 99999.0, 99999.9, 999999.0, 1.70141e38, 3.4e38) for sign in (-1, 1)),
    *(-32768.0, -32767.0, 32767.0, 65535.0, -2147483648.0, 2147483647.0, 4294967295.0),
    *(sign * float(np.finfo(np.float32).max) for sign in (-1, 1)),
)
_SAME = 1e-7  # relative difference of values that are the same: float32, and LAS integers times a scale, are rounded
_LARGEST = float(np.finfo(np.float64).max)
_SAME_ABSURD = 1e-5  # likewise of values that are no coordinates, in texts of six digits
MIN_ABSURD = 1e15
"""Smallest value that is no coordinate in metres, feet or millimetres."""
_SAMPLE_POINTS = 500  # per piece, from which the range of the other points is estimated
_MIN_OTHERS = 10  # points in the sample, for a range
_MAX_REPEATED_SHARE = 0.5  # of the points with a repeated value; more are a surface
_RANGE_RANKS = (0.5, 99.5)  # percentiles: few outliers do not widen the range
_MIN_KNOWN_GAP = 1.0  # distance of a known fill value from the others, in ranges of these
_MIN_ZERO_GAP, _MIN_ZERO_GAP_ACROSS = 2.0, 0.1  # of z = 0, in ranges, and in extents along the other axes
_MIN_CORNER_GAP = 5.0  # of x = y = 0, in ranges
_MIN_REPEATED_GAP, _MIN_REPEATED_GAP_ACROSS = 10.0, 0.5  # of any other value
_MIN_REPEATS = 5  # of any other value; two echoes can have the same height
_MIN_DISTINCT_SHARE = 0.5  # of the other points' values; flat roofs and models have fewer
_MAX_DISTINCT_SAMPLE = 200  # points in which these are counted: in more, heights in steps of 1 cm repeat, too
_MIN_NULL_POINTS, _MIN_NULL_SHARE = 100, 0.001  # of points at (0, 0, 0), which may lie in the midst of a scan

_AXES = "xyz"
_REMEDY = "remove them with pcbench convert FILE OUT --drop-nodata"


class ValueCount(NamedTuple):
    """A value of one axis (0 to 2), and the number of points that have exactly this value."""

    axis: int
    value: float
    points: int


@dataclass(frozen=True, eq=False)
class CoordinateCounts:
    """Counts of values that may stand for missing data, for the points of a cloud or of a piece of it.

    Attributes:
        points: number of points.
        at_origin: points that are exactly (0, 0, 0).
        at_corner: points with x = y = 0.
        fill_values: known fill values that occur, including 0.
        ends: smallest and largest value of each axis.
        sample: (M, 3) some points at even steps.
    """

    points: int = 0
    at_origin: int = 0
    at_corner: int = 0
    fill_values: tuple[ValueCount, ...] = ()
    ends: tuple[ValueCount, ...] = ()
    sample: FloatArray | None = None

    @classmethod
    def of(cls, points: FloatArray) -> CoordinateCounts:
        """Count the values of finite points (N, 3)."""
        if not len(points):
            return cls()
        fill_values, ends, zeros = list[ValueCount](), list[ValueCount](), list[NDArray[np.bool_]]()
        for axis, values in enumerate(points.T):
            low, high = float(values.min()), float(values.max())
            ends += [ValueCount(axis, end, int(np.count_nonzero(values == end))) for end in {low, high}]
            zeros.append(values == 0)
            possible = (v for v in _KNOWN_VALUES if low - _SAME * abs(v) <= v <= high + _SAME * abs(v))
            counts = [(value, np.count_nonzero(_is_same(values, value))) for value in possible]
            counts.append((0.0, np.count_nonzero(zeros[-1])))
            fill_values += [ValueCount(axis, value, int(count)) for value, count in counts if count]
        corner = zeros[0] & zeros[1]
        return cls(
            points=len(points),
            at_origin=int(np.count_nonzero(corner & zeros[2])),
            at_corner=int(np.count_nonzero(corner)),
            fill_values=tuple(fill_values),
            ends=tuple(ends),
            sample=points[even_rows(len(points), _SAMPLE_POINTS)],
        )

    @classmethod
    def merge(cls, parts: Iterable[CoordinateCounts]) -> CoordinateCounts:
        """Return the counts of all pieces of a cloud."""
        filled = [part for part in parts if part.sample is not None]
        if not filled:
            return cls()
        fill_values = _totals(value for part in filled for value in part.fill_values)
        ends = _totals(value for part in filled for value in part.ends)
        limits = {(axis, pick(v for a, v in ends if a == axis)) for axis in range(3) for pick in (min, max)}
        return cls(
            points=sum(part.points for part in filled),
            at_origin=sum(part.at_origin for part in filled),
            at_corner=sum(part.at_corner for part in filled),
            fill_values=tuple(fill_values.values()),
            ends=tuple(ends[limit] for limit in sorted(limits)),
            sample=np.concatenate([part.sample for part in filled if part.sample is not None]),
        )


@dataclass(frozen=True)
class Nodata:
    """The fill values of a cloud.

    Attributes:
        points: number of points of the cloud.
        values: fill values, each of one axis.
        at_corner: number of points with x = y = 0 that stand for missing data.
        at_origin: number of points at (0, 0, 0) that do.
    """

    points: int
    values: tuple[ValueCount, ...] = ()
    at_corner: int = 0
    at_origin: int = 0

    def __bool__(self) -> bool:
        return bool(self.values or self.at_corner or self.at_origin)

    @classmethod
    def of(cls, counts: CoordinateCounts) -> Nodata:
        """Find the fill values of a cloud from its counts."""
        at_origin = counts.at_origin
        if not max(_MIN_NULL_POINTS, _MIN_NULL_SHARE * counts.points) <= at_origin < counts.points:
            at_origin = 0
        if counts.sample is None:
            return cls(0)
        others = _Others.of(counts)
        if others is None:
            return cls(counts.points, at_origin=at_origin)
        values = [v for v in counts.fill_values if others.contradict_known(v)]
        for end in counts.ends:
            is_known = any(v.axis == end.axis and _is_same(end.value, v.value) for v in values)
            if not is_known and others.contradict_end(end):
                values.append(end)
        at_corner = counts.at_corner if others.contradict_corner() else 0
        if at_corner:
            values = [v for v in values if v.axis == 2 or v.value != 0]
        return cls(counts.points, tuple(values), at_corner, 0 if at_corner else at_origin)

    def mask(self, points: FloatArray) -> NDArray[np.bool_]:
        """Return which points (N, 3) stand for missing data."""
        missing = np.zeros(len(points), bool)
        for axis, value, _ in self.values:
            missing |= _is_same(points[:, axis], value)
        if self.at_corner:
            missing |= (points[:, :2] == 0).all(axis=1)
        if self.at_origin:
            missing |= (points == 0).all(axis=1)
        return missing

    def text(self) -> str:
        """Return what stands for missing data, such as "100 of 5,000 points have z = -9999"."""
        parts = [f"{words} in {count:,}" for words, count in self._parts()]
        return f"missing data seem to be stored as points ({', '.join(parts)} of {self.points:,} points)"

    def _parts(self) -> Iterator[tuple[str, int]]:
        axes: dict[tuple[float, int], str] = {}
        for axis, value, count in self.values:
            axes[value, count] = f"{axes[value, count]} = {_AXES[axis]}" if (value, count) in axes else _AXES[axis]
        for (value, count), names in axes.items():
            yield f"{names} = {value:.9g}", count
        if self.at_corner:
            yield "x = y = 0", self.at_corner
        if self.at_origin:
            yield "x = y = z = 0", self.at_origin


def nodata_warning(nodata: Nodata) -> str | None:
    """Return the warning about the fill values of a cloud; None if it has none."""
    if not nodata:
        return None
    return f"{nodata.text()}: they count in all numbers; {_REMEDY}"


def nodata_reason(clouds: Mapping[str, Cloud]) -> str:
    """Return why a computation with clouds, by their names in messages, may have failed; "" without fill values."""
    nodata_of = {name: Nodata.of(CoordinateCounts.of(cloud.points)) for name, cloud in clouds.items()}
    reasons = [f"in the {name}, {nodata.text()}" for name, nodata in nodata_of.items() if nodata]
    return f"{'; '.join(reasons)}: {_REMEDY}; " if reasons else ""


def without_nodata(cloud: Cloud, warn: Callable[[str], None] = lambda _: None) -> Cloud:
    """Return a cloud without the points that stand for missing data.

    Args:
        cloud: the cloud.
        warn: called with a line that says how many points were removed and why, if there are any.
    """
    nodata = Nodata.of(CoordinateCounts.of(cloud.points))
    if not nodata:
        return cloud
    missing = nodata.mask(cloud.points)
    warn(f"removed {np.count_nonzero(missing):,} points: {nodata.text()}")
    return cloud.select(~missing)


@dataclass(frozen=True, eq=False)
class _Others:
    """A sample (M, 3) of the points without those that may stand for missing data, and its range (3,) on each axis."""

    sample: FloatArray
    low: FloatArray
    high: FloatArray

    @classmethod
    def of(cls, counts: CoordinateCounts) -> _Others | None:
        """Return the other points; None if the sample has too few."""
        assert counts.sample is not None
        sample = counts.sample[(np.abs(counts.sample) < MIN_ABSURD).all(axis=1)]
        for axis, value, _ in counts.fill_values:
            if value != 0:
                sample = sample[~_is_same(sample[:, axis], value)]
        keep = np.ones(len(sample), bool)
        for axis, value, points in (*counts.fill_values, *counts.ends):
            has_value = _is_same(sample[:, axis], value)
            if points >= _MIN_REPEATS and np.count_nonzero(has_value) < _MAX_REPEATED_SHARE * len(sample):
                keep &= ~has_value
        sample = sample[keep]
        if len(sample) < _MIN_OTHERS:
            return None
        low, high = np.percentile(sample, _RANGE_RANKS, axis=0)
        return cls(sample, low, high)

    def contradict_known(self, count: ValueCount) -> bool:
        """Return whether a known fill value stands for missing data; 0 only in z."""
        if count.value != 0:
            return self._gap(count) > _MIN_KNOWN_GAP * self._range(count.axis)
        return count.axis == 2 and count.points > 1 and self._is_isolated(count, _MIN_ZERO_GAP, _MIN_ZERO_GAP_ACROSS)

    def contradict_end(self, count: ValueCount) -> bool:
        """Return whether the smallest or largest value of an axis stands for missing data."""
        if abs(count.value) >= MIN_ABSURD:
            return True
        return count.points >= _MIN_REPEATS and self._is_isolated(count, _MIN_REPEATED_GAP, _MIN_REPEATED_GAP_ACROSS)

    def contradict_corner(self) -> bool:
        """Return whether points with x = y = 0 stand for missing data: the others are far away."""
        corner = (ValueCount(axis, 0.0, 1) for axis in range(2))
        return any(self._gap(end) > _MIN_CORNER_GAP * self._range(end.axis) for end in corner)

    def _is_isolated(self, count: ValueCount, ranges: float, extents: float) -> bool:
        gap, across = self._gap(count), max(self._range(axis) for axis in range(3) if axis != count.axis)
        values = self.sample[even_rows(len(self.sample), _MAX_DISTINCT_SAMPLE), count.axis]
        return (
            gap > ranges * self._range(count.axis)
            and gap > extents * across
            and len(np.unique(values)) >= _MIN_DISTINCT_SHARE * len(values)
        )

    def _gap(self, count: ValueCount) -> float:
        low, high = float(self.low[count.axis]), float(self.high[count.axis])
        return max(low - count.value, count.value - high, 0.0)

    def _range(self, axis: int) -> float:
        return float(self.high[axis]) - float(self.low[axis])


def is_stated_nodata(values: FloatArray, stated: float) -> NDArray[np.bool_]:
    """Return which values of a grid are the finite number that it states for missing data.

    They may be float32, and their text may have fewer digits than that number, as -3.40282e+38 has.
    """
    digits = _SAME_ABSURD if abs(stated) >= MIN_ABSURD else _SAME
    with np.errstate(over="ignore", invalid="ignore"):
        is_missing: NDArray[np.bool_] = np.abs(values - stated) <= digits * min(abs(stated), _LARGEST)
    return is_missing


def _is_same(values: Any, value: float) -> Any:
    """Return whether values are a fill value up to rounding."""
    return np.abs(values - value) <= _SAME * abs(value)


def _totals(values: Iterable[ValueCount]) -> dict[tuple[int, float], ValueCount]:
    """Return the values with the sums of their counts, by axis and value."""
    totals: dict[tuple[int, float], ValueCount] = {}
    for axis, value, count in values:
        before = totals.get((axis, value))
        totals[axis, value] = ValueCount(axis, value, count + (0 if before is None else before.points))
    return totals
