"""Statistics of errors at check points."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pcbench.geometry.arrays import FloatArray
from pcbench.measure.metrics import nmad

OUTLIER_NMADS = 3.0
_MIN_FOR_OUTLIERS = 5
_CONFIDENCE = 0.95


@dataclass(frozen=True)
class ErrorStatistics:
    """Statistics of errors of one kind, cloud minus survey, in the unit of the cloud.

    Attributes:
        count: number of errors.
        mean: mean, the bias.
        median: median.
        rmse: root mean square about zero.
        rmse_interval: 95 % confidence interval of the RMSE, if errors are independent and normal.
        standard_deviation: standard deviation about the mean; None for one error.
        nmad: 1.4826 times the median absolute deviation from the median: a standard deviation robust against outliers.
        p68: 68.3rd percentile of the absolute errors.
        p95: 95th percentile of the absolute errors.
        largest: largest absolute error.
    """

    count: int
    mean: float
    median: float
    rmse: float
    rmse_interval: tuple[float, float]
    standard_deviation: float | None
    nmad: float
    p68: float
    p95: float
    largest: float

    @classmethod
    def of(cls, errors: FloatArray) -> ErrorStatistics:
        """Return the statistics of errors (N,), N >= 1. Percentiles interpolate linearly between errors."""
        count, absolute = len(errors), np.abs(errors)
        rmse = math.sqrt(float(np.mean(np.square(errors))))
        p68, p95 = np.quantile(absolute, [0.683, 0.95]).tolist()
        return cls(
            count=count,
            mean=float(errors.mean()),
            median=float(np.median(errors)),
            rmse=rmse,
            rmse_interval=rmse_interval(rmse, count),
            standard_deviation=float(errors.std(ddof=1)) if count > 1 else None,
            nmad=nmad(errors),
            p68=p68,
            p95=p95,
            largest=float(absolute.max()),
        )

    @property
    def is_biased(self) -> bool:
        """Return whether the mean differs from zero at the 95 % level, by Student's t test."""
        if self.standard_deviation is None or self.standard_deviation == 0.0:
            return self.mean != 0.0 and self.count > 1
        from scipy.special import stdtrit

        limit = float(stdtrit(self.count - 1, 0.5 + 0.5 * _CONFIDENCE))
        return abs(self.mean) > limit * self.standard_deviation / math.sqrt(self.count)


def rmse_interval(rmse: float, count: int) -> tuple[float, float]:
    """Return the 95 % confidence interval of a root mean square of independent normal errors with mean zero.

    The sum of their squares over their variance has a chi-square distribution with `count` degrees of freedom.
    """
    from scipy.special import chdtri

    tail = 0.5 * (1.0 - _CONFIDENCE)
    low, high = (float(chdtri(count, p)) for p in (tail, 1.0 - tail))  # chdtri takes the upper tail
    return rmse * math.sqrt(count / low), rmse * math.sqrt(count / high)


def are_outliers(errors: FloatArray) -> NDArray[np.bool_]:
    """Return which errors (N,) lie more than three NMAD from their median; none of fewer than five."""
    scale = nmad(errors) if len(errors) >= _MIN_FOR_OUTLIERS else 0.0
    if scale == 0.0:
        return np.zeros(len(errors), dtype=bool)
    return np.abs(errors - np.median(errors)) > OUTLIER_NMADS * scale


def root_mean_square(values: FloatArray) -> float | None:
    """Return the root mean square of the values that are not NaN; None if there are none."""
    given = values[~np.isnan(values)]
    return math.sqrt(float(np.mean(np.square(given)))) if len(given) else None
