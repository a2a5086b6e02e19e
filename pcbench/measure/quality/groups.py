"""Sums, medians and principal axes of the points of many neighbourhoods at once."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Self

import numpy as np

from pcbench.geometry.arrays import FloatArray, IntArray
from pcbench.geometry.neighbors import Neighborhoods

_SIGMAS_PER_MAD = 1.4826  # of a normal distribution


class PointGroups(NamedTuple):
    """The points of groups, one group after the other; each group has at least one.

    Attributes:
        values: (N, 3) points.
        rows: (N,) their rows in the cloud.
        starts: (G,) first of each group.
        counts: (G,) number of points of each group.
        of_row: (N,) group of each point.
    """

    values: FloatArray
    rows: IntArray
    starts: IntArray
    counts: IntArray
    of_row: IntArray

    @classmethod
    def of(cls, neighborhoods: Neighborhoods, points: FloatArray, kept: IntArray | None = None) -> Self:
        """Return neighbourhoods as groups. A neighbourhood without points has the first point of the cloud.

        Args:
            neighborhoods: neighbourhoods among the searched points.
            points: (N, 3) points of the cloud.
            kept: (M,) rows of the searched points in the cloud; None: all were searched.
        """
        counts, rows = neighborhoods.counts, neighborhoods.indices
        if not counts.all():
            rows = np.insert(rows, neighborhoods.offsets[:-1][counts == 0], 0)
            counts = np.maximum(counts, 1)
        rows = rows if kept is None else kept[rows]
        starts = np.concatenate([[0], np.cumsum(counts)[:-1]])
        return cls(points[rows], rows, starts, counts, np.repeat(np.arange(len(counts)), counts))

    def sums(self, values: FloatArray) -> FloatArray:
        """Return the sum in each group (G,) of values (N,)."""
        sums: FloatArray = np.add.reduceat(values, self.starts)
        return sums

    def along(self, offsets: FloatArray, directions: FloatArray) -> FloatArray:
        """Return the components (N,) of offsets (N, 3) along a direction for each group (G, 3)."""
        components: FloatArray = np.einsum("ni,ni->n", offsets, directions[self.of_row])
        return components

    def principal_axes(self, offsets: FloatArray, weights: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return means (G, 3), eigenvalues (G, 3), ascending, and axes (G, 3, 3) of weighted offsets (N, 3)."""
        totals = np.maximum(self.sums(weights), 1e-12)
        means = np.stack([self.sums(weights * offsets[:, axis]) for axis in range(3)], axis=1) / totals[:, None]
        away = offsets - means[self.of_row]
        covariance = np.empty((len(totals), 3, 3))
        for row in range(3):
            for column in range(row, 3):
                sums = self.sums(weights * away[:, row] * away[:, column])
                covariance[:, row, column] = covariance[:, column, row] = sums / totals
        values, axes = np.linalg.eigh(covariance)
        return means, values, axes

    def ordered(self, values: FloatArray) -> IntArray:
        """Return the rows (N,) that sort values (N,) within each group, up to 1e-11 of the range of all values.

        One sort of the group plus the value, scaled to less than 1, is ten times faster than one by both.
        """
        low, high = float(values.min()), float(values.max())
        scale = 0.999 / (high - low) if high > low else 0.0
        return np.argsort(self.of_row + (values - low) * scale)

    def quantiles(self, values: FloatArray, shares: Sequence[float]) -> list[FloatArray]:
        """Return quantiles in each group, each (G,), of values (N,), with linear interpolation."""
        ordered = values[self.ordered(values)]
        results = []
        for share in shares:
            place = share * (self.counts - 1)
            below = np.floor(place).astype(np.int64)
            above = np.minimum(below + 1, self.counts - 1)
            low, high = ordered[self.starts + below], ordered[self.starts + above]
            results.append(low + (place - below) * (high - low))
        return results

    def median_and_sigma(self, values: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the median (G,) and the normalised median absolute deviation (G,) of values (N,)."""
        (middle,) = self.quantiles(values, (0.5,))
        (deviation,) = self.quantiles(np.abs(values - middle[self.of_row]), (0.5,))
        return middle, _SIGMAS_PER_MAD * deviation
