"""Statistics of errors on a surface: quantiles, and correlation over distance."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pcbench.geometry.neighbors import Index
from pcbench.measure.metrics import nmad

Array = NDArray[np.float64]

STATISTICS = Path(__file__).parent / "studies" / "stress" / "photogrammetric_noise.json"
SHARES = (0.01, 0.05, 0.25, 0.5, 0.75, 0.95, 0.99)
LAGS = (1.5, 2.5, 4.0, 6.0, 8.0, 12.0, 16.0)  # spacings
_CLIP = 3.0  # NMAD: the correlation of unclipped errors would be that of a few outliers
_POINTS = 4000  # points whose pairs are used


def statistics(errors: Array, points: Array, normals: Array, spacing: float) -> dict[str, list[float]]:
    """Return quantiles, and correlations between points of one plane of errors that are clipped at 3 NMAD.

    Args:
        errors: (N,) signed errors.
        points: (N, 3) points of the surface.
        normals: (N, 3) normals there.
        spacing: spacing of the points, the unit of the lags.
    """
    scaled = (errors - np.median(errors)) / nmad(errors)
    clipped = np.clip(scaled, -_CLIP, _CLIP)
    centred = clipped - clipped.mean()
    rows = np.random.default_rng(0).permutation(len(points))[:_POINTS]
    near = Index(points).query_radius(points[rows], 1.15 * LAGS[-1] * spacing)
    i, j = np.repeat(rows, near.counts), near.indices
    distances = np.linalg.norm(points[i] - points[j], axis=1) / spacing
    same = np.einsum("ni,ni->n", normals[i], normals[j]) > 0.9
    correlations = []
    for lag in LAGS:
        use = same & (distances > 0.85 * lag) & (distances < 1.15 * lag)
        correlations.append(float((centred[i[use]] * centred[j[use]]).mean() / centred.var()))
    quantiles = np.quantile(errors, SHARES)
    return {"quantiles": quantiles.round(4).tolist(), "correlations": np.round(correlations, 4).tolist()}


def correlation_length(correlations: Array) -> float:
    """Return the lag in spacings at which the correlation is half of that at the shortest lag, linear between lags."""
    values = np.asarray(correlations)
    below = np.flatnonzero(values < values[0] / 2)
    if not len(below):
        return LAGS[-1]
    k = int(below[0])
    share = (values[k - 1] - values[0] / 2) / (values[k - 1] - values[k])
    return float(LAGS[k - 1] + share * (LAGS[k] - LAGS[k - 1]))
