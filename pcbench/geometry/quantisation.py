"""The step in which the coordinates of a cloud are stored, measured from the coordinates.

Files round coordinates: LAS to multiples of a scale, texts to some decimals, float32 to 24 significant bits, which far
from the origin are steps of centimetres to metres. A rounded coordinate is off by up to half a step, with a variance of
step^2 / 12 (Widrow & Kollar 2008, "Quantization Noise", eq. 4.2).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import numpy as np

from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.transform import Similarity

_SAMPLE_POINTS = 100_000  # every n-th point, as in an evenly thinned cloud on disk
_MIN_VALUES = 10  # distinct values on a lattice; fewer may be levels of a model
_MIN_LEVELS, _MAX_LEVEL_STEP = 3, 1.0  # or this many, without a gap and with a step that files have
_MIN_SHARE = 0.95  # of the differences between neighbouring values that are multiples of the step
_TESTED_GAPS, _MIN_TESTED_SHARE = 64, 0.75  # gaps that rule out most steps, and their share of multiples
_MAX_ERROR = 0.05  # of these multiples, in steps
_DECIMAL_FACTORS = (1.0, 0.5, 0.25, 0.2)
_FOOT, _SURVEY_FOOT = 0.3048, 1200 / 3937
_DECADES, _OCTAVES = 12, 24  # from about the smallest gap downwards
_RANKS = (0.0, 1.0, 10.0)  # percentiles of the differences that may be one step
_MAX_GRID_DOUBLES, _MIN_GRID_SHARE = 0.05, 0.3  # points that share a node, and nodes with a point, of a regular grid
_NEGLIGIBLE_SHARE = 1e-7  # of the largest coordinate range: float32 without an offset
_MAX_FINE_STEP = 0.1  # in spacings: with larger steps, points coincide, or lie in lines, by rounding


@dataclass(frozen=True, eq=False)
class Quantisation:
    """The lattice on which the coordinates of a cloud lie.

    Attributes:
        steps: (3,) step of each axis, root mean square if it varies; 0 if no rounding coarser than float64 is visible.
        offsets: (3,) a coordinate of each axis on the lattice.
    """

    steps: FloatArray
    offsets: FloatArray

    @classmethod
    def of(cls, points: FloatArray, count: int | None = None) -> Quantisation:
        """Measure the steps of points (N, 3), in the coordinates in which they were stored.

        The positions of a regular grid are no rounding: the step of its axes is 0.

        Args:
            points: (N, 3) points of a cloud, of which an even sample is used.
            count: number of points of the cloud if these are such a sample themselves; None: they are all.
        """
        sample = points[:: max(1, len(points) // _SAMPLE_POINTS)]
        axes = [_axis_lattice(np.ascontiguousarray(values)) for values in sample.T]
        steps = np.array([axis.step for axis in axes])
        offsets = np.array([axis.offset for axis in axes])
        for first, second in ((0, 1), (0, 2), (1, 2)):
            pair = [first, second]
            if steps[pair].all() and _is_grid(sample[:, pair], steps[pair], offsets[pair], count or len(points)):
                steps[pair] = 0.0
        return cls(steps, offsets)

    @property
    def coarsest(self) -> float:
        """The largest step of the three axes."""
        return float(self.steps.max())

    @property
    def covariance(self) -> FloatArray:
        """Covariance (3, 3) of the rounding error of a point."""
        covariance: FloatArray = np.diag(np.square(self.steps) / 12)
        return covariance

    def rounded(self, points: FloatArray) -> FloatArray:
        """Return points (N, 3) as this cloud stores them."""
        has_steps = self.steps > 0
        steps = np.where(has_steps, self.steps, 1.0)
        on_lattice = np.round((points - self.offsets) / steps) * steps + self.offsets
        return np.where(has_steps, on_lattice, points)

    def is_negligible(self, extent: float) -> bool:
        """Return whether the steps are no larger than those of float32 in a scene of this extent at the origin."""
        return self.coarsest <= _NEGLIGIBLE_SHARE * extent


class PlacedQuantisation(NamedTuple):
    """The lattice of a cloud, and the motion from the cloud's coordinates to those of a comparison."""

    quantisation: Quantisation
    pose: Similarity

    def is_coarse(self, spacing: float) -> bool:
        """Return whether points coincide, or lie in lines, because they are rounded."""
        return self.quantisation.coarsest > _MAX_FINE_STEP * spacing

    @property
    def covariance(self) -> FloatArray:
        """Covariance (3, 3) of the rounding error of a moved point."""
        linear = self.pose.matrix[:3, :3]
        covariance: FloatArray = linear @ self.quantisation.covariance @ linear.T
        return covariance

    def normal_variances(self, normals: FloatArray) -> FloatArray:
        """Return the variance (N,) of the rounding error along unit normals (N, 3)."""
        variances: FloatArray = np.einsum("ni,ij,nj->n", normals, self.covariance, normals)
        return variances

    def rounded(self, points: FloatArray) -> FloatArray:
        """Return points (N, 3) of the comparison as the cloud stores them."""
        stored = self.quantisation.rounded(self.pose.inverse().apply(points))
        return self.pose.apply(stored)

    def moved_in_cells(self, points: FloatArray, normals: FloatArray | None, seed: int) -> FloatArray:
        """Return places (N, 3) on the surface that could have been rounded to these points: random ones in their cells.

        Args:
            points: (N, 3) points of the comparison.
            normals: (N, 3) unit normals of the surface, to which the places are restricted; None: they are not.
            seed: random seed.
        """
        cells = np.random.default_rng(seed).uniform(-0.5, 0.5, points.shape) * self.quantisation.steps
        shifts = cells @ self.pose.matrix[:3, :3].T
        if normals is not None:
            shifts -= np.einsum("ni,ni->n", shifts, normals)[:, None] * normals
        return points + shifts


class _AxisLattice(NamedTuple):
    step: float
    offset: float


def _axis_lattice(values: FloatArray) -> _AxisLattice:
    """Return the lattice of the coordinates (N,) of one axis."""
    distinct = np.unique(values)
    if len(distinct) < 2:
        return _AxisLattice(0.0, float(values[0]))
    gaps = np.diff(distinct)
    step, binary = _common_step(gaps, np.spacing(np.abs(distinct))), 0.0
    with np.errstate(over="ignore"):
        is_single = bool((distinct == distinct.astype(np.float32)).all())
    if is_single and len(distinct) >= _MIN_VALUES:
        binary = float(np.sqrt(np.mean(np.square(_single_spacings(values)))))
        # Decimals that became float32 are multiples of a step only up to its rounding.
        step = step if step > binary else _common_step(gaps, 0.5 * _single_spacings(distinct))
    return _AxisLattice(max(step, binary), float(distinct[len(distinct) // 2]) if step > binary else 0.0)


def _single_spacings(values: FloatArray) -> FloatArray:
    """Return the distance of each value (N,) to the next float32."""
    return np.spacing(np.abs(values.astype(np.float32))).astype(np.float64)


def _common_step(gaps: FloatArray, value_errors: FloatArray) -> float:
    """Return the largest step of which gaps (M,) between distinct values are multiples; 0 if there is none.

    Args:
        gaps: (M,) gaps between distinct values in ascending order.
        value_errors: (M + 1,) possible rounding error of each value.
    """
    errors = value_errors[1:] + value_errors[:-1]
    stride = max(1, len(gaps) // _TESTED_GAPS)
    steps = np.unique(_possible_steps(gaps))[::-1]
    shares = _share_of_multiples(gaps[::stride], errors[::stride], steps[:, None])
    for step in map(float, steps[shares >= _MIN_TESTED_SHARE]):
        if _share_of_multiples(gaps, errors, step) < _MIN_SHARE:
            continue
        if len(gaps) + 1 >= _MIN_VALUES:
            return step
        has_all_levels = len(gaps) + 1 >= _MIN_LEVELS and (gaps < 1.5 * step).all()
        return step if has_all_levels and step <= _MAX_LEVEL_STEP else 0.0
    return 0.0


def _share_of_multiples(gaps: FloatArray, errors: FloatArray, steps: FloatArray | float) -> FloatArray:
    """Return the shares (S,) of gaps (M,) that are multiples of each of the steps (S, 1), or of one step."""
    off = np.abs(gaps - np.maximum(np.round(gaps / steps), 1.0) * steps)
    is_multiple = (off <= 2 * errors) & (errors <= _MAX_ERROR * steps)
    return np.asarray(np.count_nonzero(is_multiple, axis=-1) / len(gaps))


def _possible_steps(gaps: FloatArray) -> FloatArray:
    """Return steps (S,) that files have, and small gaps themselves, from about the smallest gap downwards."""
    least = np.percentile(gaps, _RANKS)
    of_gaps = [gaps.sum() / np.maximum(np.round(gaps / gap), 1.0).sum() for gap in least]
    limit = 1.01 * float(least[-1])
    decimals = _decimal_steps(int(np.ceil(np.log10(limit))) + 1)
    binary = np.ldexp(1.0, int(np.floor(np.log2(limit))) - np.arange(_OCTAVES))
    return np.concatenate([of_gaps, decimals[decimals <= limit], binary])


@cache
def _decimal_steps(decade: int) -> FloatArray:
    """Return decimal steps (S,) of the decades up to 10^decade."""
    return np.array(
        [
            unit * factor * 10.0**exponent
            for exponent in range(decade, decade - _DECADES, -1)
            for factor in _DECIMAL_FACTORS
            for unit in (1.0, _FOOT, _SURVEY_FOOT)
        ]
    )


def _is_grid(places: FloatArray, steps: FloatArray, offsets: FloatArray, count: int) -> bool:
    """Return whether coordinates (N, 2), a sample of `count` points, fill a regular grid with one point per node."""
    nodes = np.round((places - offsets) / steps)
    rows, columns = (float(side) + 1 for side in nodes.max(axis=0) - nodes.min(axis=0))
    if min(rows, columns) < 2 or count < _MIN_GRID_SHARE * rows * columns:
        return False
    shifted = (nodes - nodes.min(axis=0)).astype(np.int64)
    doubles = len(places) - np.count_nonzero(np.bincount(shifted[:, 0] * int(columns) + shifted[:, 1]))
    return bool(doubles <= _MAX_GRID_DOUBLES * len(places) ** 2 / count)
