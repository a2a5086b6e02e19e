"""Displacements of single cells, their noise, and local changes."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from pcbench.deformation.chi_squares import chi_square_tails
from pcbench.deformation.model import MIN_INFORMATION, Geometry, Noise, Scores
from pcbench.deformation.polynomials import monomials
from pcbench.deformation.result import Bin, LocalChanges, Trend
from pcbench.deformation.sums import TileSums
from pcbench.geometry.arrays import FloatArray

FDR = 0.05
# Weight and share of smooth surface in a cell that is tested; bushes change without a deformation.
_MIN_SMOOTH_WEIGHT, _MIN_SMOOTH_SHARE = 3.0, 0.1
_MIN_TESTED = 30  # cells; their median then estimates the scale of the noise


class CellDisplacements:
    """Vertical displacements of the cells and their covariance.

    Attributes:
        vertical: (C,) vertical displacements beyond the rigid motion; NaN if not observable.
        sigma: (C,) their standard deviations under the noise.
        distance: (C,) horizontal distance from the centre of the scene.
        height: (C,) height above the lowest cell.
    """

    def __init__(self, geometry: Geometry, scores: Scores, noise: Noise, sums: TileSums) -> None:
        self._geometry, self._scores, self._noise = geometry, scores, noise
        rigid = geometry.fit("rigid", scores.total)
        residual = scores.translations - np.einsum("cik,i->ck", geometry.translations, rigid)
        information = geometry.information[:, 2, 2]
        is_observed = (information > 0.1 * geometry.weights) & (sums.counts >= 5)
        with np.errstate(invalid="ignore", divide="ignore"):
            self.vertical = np.where(is_observed, residual[:, 2] / information, np.nan)
        self._observed = np.flatnonzero(is_observed)
        self._weights = information[is_observed]
        load = geometry.load[is_observed, 2, 2] / self._weights
        covariance = load[:, None] * geometry.mixture(noise)[np.ix_(self._observed, self._observed)] * load
        white = geometry.white_information[is_observed, 2, 2] / np.square(self._weights)
        self._covariance = covariance + np.diag(noise.white * white)
        self.sigma = np.full(len(is_observed), np.nan)
        self.sigma[self._observed] = np.sqrt(np.diag(self._covariance))
        middle = np.average(geometry.means, axis=0, weights=geometry.weights)
        self.distance = np.hypot(*(geometry.means - middle)[:, :2].T)
        self.height = geometry.means[:, 2] - geometry.means[:, 2].min()

    def trend(self, along: FloatArray) -> Trend | None:
        """Return slope and binned means (up to eight bins) of the vertical displacement against a coordinate (C,)."""
        x, y, w = along[self._observed], self.vertical[self._observed], self._weights
        if len(x) < 3 or np.ptp(x) == 0:
            return None
        centred = x - np.average(x, weights=w)
        a = w * centred / float(w @ np.square(centred))
        slope, sigma = float(a @ y), math.sqrt(float(a @ self._covariance @ a))
        rank = np.argsort(x, kind="stable")
        bins = np.empty(len(x), dtype=np.int64)
        share = (np.cumsum(w[rank]) - 0.5 * w[rank]) / w.sum()
        bins[rank] = np.minimum((8 * share).astype(np.int64), 7)
        profile = []
        for index in np.unique(bins):
            within = np.where(bins == index, w, 0.0) / w[bins == index].sum()
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
        """Return the displacements (C, 3) of a model beyond the rigid motion, in each cell's observable directions."""
        geometry = self._geometry
        coefficients = geometry.fit(model, self._scores.total) - geometry.fit("rigid", self._scores.total)
        values = geometry.to_orthonormal @ monomials((geometry.means - geometry.center) / geometry.radius)  # (20, C)
        fields = values.T @ coefficients.reshape(-1, 3)
        share, directions = np.linalg.eigh(geometry.information / np.maximum(geometry.weights, 1e-300)[:, None, None])
        along = np.einsum("cik,ci->ck", directions, fields) * (share >= MIN_INFORMATION)
        displacements: FloatArray = np.einsum("cik,ck->ci", directions, along)
        return displacements


def local_changes(
    geometry: Geometry, noise: Noise, sums: TileSums, resolution: float
) -> tuple[NDArray[np.bool_], FloatArray, LocalChanges]:
    """Find cells that changed separately, beyond the noise and the resolution.

    The scale of the noise is estimated by the median over the cells (the empirical null of Efron 2004). The false
    discovery rate is controlled as in Benjamini & Hochberg 1995.

    Returns:
        Which cells changed (C,), the length of each cell's residual from the largest model (C,), NaN if it is not
        tested, and a summary.
    """
    weight = np.trace(sums.spread, axis1=1, axis2=2)
    tested = (weight >= _MIN_SMOOTH_WEIGHT) & (weight >= _MIN_SMOOTH_SHARE * sums.counts)
    if np.count_nonzero(tested) < _MIN_TESTED:
        tested[:] = False
    scale = np.square(np.trace(geometry.load, axis1=1, axis2=2) / np.maximum(geometry.weights, 1e-300))
    correlated, white = scale * np.diag(geometry.mixture(noise)), scale * noise.white
    values, vectors = np.linalg.eigh(sums.spread)
    constrained = values >= np.maximum(0.05 * values.sum(axis=1, keepdims=True), 1.0)
    safe = np.where(constrained, values, 1.0)
    along = np.einsum("cik,ci->ck", vectors, sums.local)
    expected = white[:, None] * safe + correlated[:, None] * np.square(safe) + 1e-300
    squares = np.where(constrained, np.square(along) / expected, 0.0)
    statistic, freedom = squares.sum(axis=1), np.maximum(constrained.sum(axis=1), 1)
    ratio = statistic / (freedom * (1 - 2 / (9 * freedom)) ** 3)
    typical = max(float(np.median(ratio[tested])), 0.25) if tested.any() else 1.0
    p = np.where(tested, chi_square_tails(statistic / typical, freedom), 1.0)
    order = np.argsort(p, kind="stable")
    limits = FDR * np.arange(1, len(p) + 1) / max(1, int(tested.sum()))
    passed = np.flatnonzero(p[order] <= limits)
    changed = np.zeros(len(p), dtype=bool)
    if len(passed):
        changed[order[: passed[-1] + 1]] = True
    offsets = np.where(constrained, np.einsum("cik,ci->ck", vectors, sums.apart) / safe, 0.0)
    length = np.sqrt(np.square(offsets).sum(axis=1))
    changed &= tested & (length > resolution)
    farthest = int(np.argmax(np.where(changed, length, -1.0)))
    x, y, z = map(float, geometry.means[farthest])
    summary = LocalChanges(
        tiles_tested=int(tested.sum()),
        tiles_changed=int(changed.sum()),
        fdr=FDR,
        largest=float(length[farthest]) if changed.any() else None,
        at=(x, y, z) if changed.any() else None,
    )
    return changed, np.where(tested, length, np.nan), summary
