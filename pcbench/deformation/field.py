"""Results per cell: displacements, their noise, and local changes."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from pcbench.deformation.chi_squares import chi_square_tails
from pcbench.deformation.model import MIN_INFORMATION, Geometry, Noise, Scores
from pcbench.deformation.parts import Bin, LocalChanges, Trend
from pcbench.deformation.polynomials import monomials
from pcbench.deformation.sums import TileSums
from pcbench.geometry.arrays import FloatArray, IntArray

FDR = 0.05
_EQUAL_SHARE = 1e-9  # of the extent, within which coordinates are equal
# Minimum weight of smooth surface in a tested cell, and its minimum share: vegetation always changes.
_MIN_SMOOTH_WEIGHT, _MIN_SMOOTH_SHARE = 3.0, 0.1
_ADJACENT = 1.5  # largest distance of the mean positions of adjacent cells, in edges of a cell
_MIN_TESTED = 30  # cells needed for an empirical null distribution
# Quantiles of the cells at which the null distribution is fitted, with their standard normal deviates. The median alone
# misses the heavy tails of scans; a fifth of the cells may have moved.
_NULL_QUANTILES = ((0.5, 0.0), (0.8, 0.8416))


class CellDisplacements:
    """Vertical displacement of each cell and its noise, with trends and model displacements."""

    def __init__(self, geometry: Geometry, scores: Scores, noise: Noise, sums: TileSums) -> None:
        self._geometry, self._scores, self._noise = geometry, scores, noise
        rigid = geometry.fit("rigid", scores.total)
        remainders = scores.translations - np.einsum("cik,i->ck", geometry.translations, rigid)
        information = geometry.information[:, 2, 2]
        seen = (information > 0.1 * geometry.weights) & (sums.counts >= 5)
        with np.errstate(invalid="ignore", divide="ignore"):
            self.vertical = np.where(seen, remainders[:, 2] / information, np.nan)
        self._seen = np.flatnonzero(seen)
        self._weights = information[seen]
        load = geometry.load[seen, 2, 2] / self._weights
        covariance = load[:, None] * geometry.mixture(noise)[np.ix_(self._seen, self._seen)] * load
        white = geometry.white_information[seen, 2, 2] / np.square(self._weights)
        self._covariance = covariance + np.diag(noise.white * white)
        self.sigma = np.full(len(seen), np.nan)
        self.sigma[self._seen] = np.sqrt(np.diag(self._covariance))
        middle = np.average(geometry.means, axis=0, weights=geometry.weights)
        self.distance = np.hypot(*(geometry.means - middle)[:, :2].T)
        self.height = geometry.means[:, 2] - geometry.means[:, 2].min()

    def trend(self, along: FloatArray) -> Trend | None:
        """Return the trend of the vertical displacement along a coordinate (C,): slope, and means in up to 8 bins."""
        x, y, w = along[self._seen], self.vertical[self._seen], self._weights
        if len(x) < 3 or np.ptp(x) == 0:
            return None
        centred = x - np.average(x, weights=w)
        a = w * centred / float(w @ np.square(centred))
        slope, sigma = float(a @ y), math.sqrt(float(a @ self._covariance @ a))
        # Coordinates that are equal up to rounding belong to one bin: their order is arbitrary.
        _, group = np.unique(np.round(x / (_EQUAL_SHARE * np.ptp(x))), return_inverse=True)
        weight = np.bincount(group, w)
        share = (np.cumsum(weight) - 0.5 * weight) / w.sum()
        bins = np.minimum((8 * share).astype(np.int64), 7)[group]
        profile = []
        for number in np.unique(bins):
            within = np.where(bins == number, w, 0.0) / w[bins == number].sum()
            mean = float(within @ y)
            error = math.sqrt(float(np.square(within) @ np.square(y - mean)))
            profile.append(
                Bin(
                    at=float(within @ x),
                    mean=mean,
                    ci=(mean - 1.96 * error, mean + 1.96 * error),
                    null=1.96 * math.sqrt(float(within @ self._covariance @ within)),
                )
            )
        return Trend(slope, (slope - 1.96 * sigma, slope + 1.96 * sigma), tuple(profile))

    def displacements(self, model: str) -> FloatArray:
        """Return the displacements (C, 3) of a model beyond the rigid motion, in the directions each cell observes."""
        geometry = self._geometry
        coefficients = geometry.fit(model, self._scores.total) - geometry.fit("rigid", self._scores.total)
        values = geometry.to_orthonormal @ monomials((geometry.means - geometry.center) / geometry.radius)  # (20, C)
        fields = values.T @ coefficients.reshape(-1, 3)
        share, directions = np.linalg.eigh(geometry.information / np.maximum(geometry.weights, 1e-300)[:, None, None])
        along = np.einsum("cik,ci->ck", directions, fields) * (share >= MIN_INFORMATION)
        seen: FloatArray = np.einsum("cik,ck->ci", directions, along)
        return seen


def local_changes(
    geometry: Geometry, noise: Noise, sums: TileSums, negligible: float
) -> tuple[NDArray[np.bool_], FloatArray, LocalChanges]:
    """Find cells that changed by more than a negligible length, beyond the largest model.

    The cells give the scale of the noise (empirical null, Efron 2004). The false discovery rate is controlled
    as in Benjamini & Hochberg 1995.

    Returns:
        (C,) whether each cell changed, (C,) the length of its displacement from the largest model (NaN if the cell was
        not tested), and a summary.
    """
    weight = np.trace(sums.spread, axis1=1, axis2=2)
    tested = (weight >= _MIN_SMOOTH_WEIGHT) & (weight >= _MIN_SMOOTH_SHARE * sums.counts)
    if np.count_nonzero(tested) < _MIN_TESTED:
        tested[:] = False
    variance = np.square(np.trace(geometry.load, axis1=1, axis2=2) / np.maximum(geometry.weights, 1e-300))
    correlated, white = variance * np.diag(geometry.mixture(noise)), variance * noise.white
    values, vectors = np.linalg.eigh(sums.spread)
    constrained = values >= np.maximum(0.05 * values.sum(axis=1, keepdims=True), 1.0)
    safe = np.where(constrained, values, 1.0)
    along = np.einsum("cik,ci->ck", vectors, sums.local)
    expected = white[:, None] * safe + correlated[:, None] * np.square(safe) + 1e-300
    squares = np.where(constrained, np.square(along) / expected, 0.0)
    statistic, freedom = squares.sum(axis=1), np.maximum(constrained.sum(axis=1), 1)
    scale = _null_scale(statistic[tested], freedom[tested]) if tested.any() else 1.0
    p = np.where(tested, chi_square_tails(statistic / scale, freedom), 1.0)
    order = np.argsort(p, kind="stable")
    limits = FDR * np.arange(1, len(p) + 1) / max(1, int(tested.sum()))  # Benjamini & Hochberg 1995, eq. 1
    passed = np.flatnonzero(p[order] <= limits)
    changed = np.zeros(len(p), dtype=bool)
    if len(passed):
        changed[order[: passed[-1] + 1]] = True
    offsets = np.where(constrained, np.einsum("cik,ci->ck", vectors, sums.local_sizes) / safe, 0.0)
    length = np.sqrt(np.square(offsets).sum(axis=1))
    changed &= tested & (length > negligible)
    farthest = int(np.argmax(np.where(changed, length, -1.0)))
    x, y, z = map(float, geometry.means[farthest])
    local = LocalChanges(
        tiles_tested=int(tested.sum()),
        tiles_changed=int(changed.sum()),
        fdr=FDR,
        largest=float(length[farthest]) if changed.any() else None,
        at=(x, y, z) if changed.any() else None,
        largest_group=_largest_group(geometry.means[changed], _ADJACENT * sums.side),
    )
    return changed, np.where(tested, length, np.nan), local


def _largest_group(places: FloatArray, reach: float) -> int:
    """Return the size of the largest group of places (K, 3) that are linked by steps of at most `reach`."""
    others, largest = places, 0
    while len(others) > largest:
        front, others, size = [others[0]], others[1:], 1
        while front:
            is_near = np.square(others - front.pop()).sum(axis=1) <= reach**2
            front.extend(others[is_near])
            size += int(np.count_nonzero(is_near))
            others = others[~is_near]
        largest = max(largest, size)
    return largest


def _null_scale(statistic: FloatArray, freedom: IntArray) -> float:
    """Return the factor by which statistics (C,) exceed chi-squared variables of some degrees of freedom (C,).

    Quantiles of the chi-squared distribution are approximated as by Wilson & Hilferty 1931.
    """
    scales = []
    for share, deviate in _NULL_QUANTILES:
        expected = freedom * (1 - 2 / (9 * freedom) + deviate * np.sqrt(2 / (9 * freedom))) ** 3
        scales.append(float(np.quantile(statistic / expected, share)))
    return max(*scales, 0.25)
