"""Amplitude of a deformation, smallest detectable amplitude, and observable directions."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from pcbench.deformation.chi_squares import chi_squares_quantile
from pcbench.deformation.model import KINDS, MIN_INFORMATION, Geometry, ModelStep, Noise, Scores
from pcbench.deformation.parts import Amplitude, DetectableSize, Interval, Observable
from pcbench.deformation.sums import TileSums, sum_over_tiles
from pcbench.geometry.arrays import FloatArray, IntArray

# The covariance is itself an estimate: if it is a third too small, a nominal p of 1e-5 is in fact 1e-3.
MAX_P_SIGNIFICANT = 1e-5  # significance level of a verdict
DETECTION_POWER = 0.9  # power of the test at the minimum detectable deformation
# Systematic errors of a size, as standard errors: shares of the noise, and of the size.
_BIAS_NOISE_SHARE, _BIAS_SIZE_SHARE = 0.08, 0.04
_POWER_Z = 1.282  # normal quantile of DETECTION_POWER


def amplitude(geometry: Geometry, scores: Scores, noise: Noise, step: ModelStep) -> Amplitude:
    """Estimate the amplitude of the displacement along the normals that a model step explains, corrected for noise."""
    modes = step.modes.T @ scores.total
    covariance = geometry.covariance(step, noise)
    power, bias = float(modes @ modes), float(np.trace(covariance))
    size = max(0.0, power - bias)
    rms, ci = _root_mean_square(modes, covariance, np.eye(len(modes)) / geometry.total)
    surface_form, surface_ci = _root_mean_square(modes, covariance, geometry.surface_form(step))
    coefficients = step.modes @ modes
    per_cell = geometry.squares_per_cell(coefficients)
    weight = geometry.weights
    shrink = math.sqrt(size / power) if power > 0 else 0.0
    enough = weight >= 0.1 * np.median(weight)
    cells = shrink * np.sqrt(np.maximum(per_cell[enough], 0) / weight[enough])
    order = np.argsort(cells)
    below = np.cumsum(weight[enough][order]) / weight[enough].sum()
    return Amplitude(
        rms=rms,
        p95=float(cells[order][np.searchsorted(below, 0.95)]),
        max=float(cells.max()),
        ci=ci,
        rms_surface=surface_form,
        ci_surface=surface_ci,
    )


def with_systematic_errors(size: Amplitude, noise: Noise) -> Amplitude:
    """Return the size with intervals that include systematic errors besides the noise.

    Dense stereo and splats deviate from the truth smoothly by a fraction of their noise, and closest points fall short
    of a displacement by a few per cent. Both were measured on clouds of photographs with exact truth, see
    `docs/trials/deformation.md`.
    """
    error = _systematic_error(size.rms, noise)
    if size.rms == 0 or size.rms_surface is None or size.ci_surface is None:
        return replace(size, ci=_widen(size.rms, size.ci, error))
    surface_error = error * size.rms_surface / size.rms
    return replace(
        size,
        ci=_widen(size.rms, size.ci, error),
        ci_surface=_widen(size.rms_surface, size.ci_surface, surface_error),
    )


def widened(value: float, interval: Interval, noise: Noise) -> Interval:
    """Return the interval of an RMS with systematic errors included."""
    return _widen(value, interval, _systematic_error(value, noise))


def _systematic_error(value: float, noise: Noise) -> float:
    """Return the standard error of an RMS from systematic errors."""
    return math.hypot(_BIAS_NOISE_SHARE * math.sqrt(noise.white + noise.correlated), _BIAS_SIZE_SHARE * value)


def stated_rms(negligible: float, noise: Noise) -> float:
    """Return the RMS from which the interval of a size lies above the negligible size, for its systematic errors."""
    scatter = 1.96 * _BIAS_NOISE_SHARE * math.sqrt(noise.white + noise.correlated)
    rest = 1 - (1.96 * _BIAS_SIZE_SHARE) ** 2
    return (negligible + math.sqrt(negligible**2 - rest * (negligible**2 - scatter**2))) / rest


def _widen(value: float, interval: Interval, error: float) -> Interval:
    """Return an interval with an independent standard error added."""
    low, high = (math.hypot(end - value, 1.96 * error) for end in interval)
    return max(0.0, value - low), value + high


def _root_mean_square(modes: FloatArray, covariance: FloatArray, form: FloatArray) -> tuple[float, Interval]:
    """Estimate the root of m' Q m and its 95 % interval, from modes m + e (K,) with noise e of covariance V; Q (K, K).

    (m + e)' Q (m + e) has the mean m' Q m + tr Q V and the variance 4 m' Q V Q m + 2 tr (Q V)^2. The term m' Q V Q m is
    estimated from the modes in the same way.
    """
    noise = form @ covariance
    scatter = max(0.0, float((noise * noise.T).sum()))  # rounding may make a form of zeros negative
    size = float(modes @ form @ modes) - float(np.trace(noise))
    along = max(0.0, float(modes @ noise @ form @ modes) - float(np.trace(noise @ noise)))
    spread = 1.96 * math.sqrt(2 * scatter + 4 * along)
    low, middle, high = (math.sqrt(max(0.0, size + by)) for by in (-spread, 0.0, spread))
    return middle, (low, high)


def effective_count(geometry: Geometry, noise: Noise) -> float:
    """Number of independent pairs that would determine the non-affine fields as well; less if noise is correlated."""
    covariance = geometry.covariance(geometry.step("affine", "cubic"), noise)
    if not len(covariance):
        return 0.0
    variance = noise.white + noise.correlated
    return min(geometry.total, geometry.total * variance * len(covariance) / max(float(np.trace(covariance)), 1e-300))


def minimum_detectable_rms(geometry: Geometry, null: NullDistribution) -> float | None:
    """RMS of the smallest dome that is detected with power `DETECTION_POWER`; None if domes are not observable."""
    kind = _Kind.of(geometry, "dome")
    return None if kind is None else kind.rms * null.detectable_factor(kind)


def detectable_sizes(geometry: Geometry, null: NullDistribution, stated: float) -> tuple[DetectableSize, ...]:
    """Return the smallest detectable size of each kind of deformation, at least the smallest one that is `stated`."""
    sizes = []
    for name in KINDS:
        kind = _Kind.of(geometry, name)
        factor = math.inf if kind is None else null.detectable_factor(kind)
        if kind is None or not math.isfinite(factor):
            sizes.append(DetectableSize(name))
            continue
        factor = max(factor, stated / kind.rms)
        sizes.append(DetectableSize(name, factor * kind.rms, factor * kind.displacement))
    return tuple(sizes)


class _Kind(NamedTuple):
    """A kind of deformation of any size: its non-affine modes, its RMS along the normals, and its RMS length."""

    modes: FloatArray
    rms: float
    displacement: float

    @classmethod
    def of(cls, geometry: Geometry, name: str) -> _Kind | None:
        """Return a kind; None if the surfaces hardly constrain it."""
        field, affine = geometry.kinds[name], geometry.columns["affine"]
        field = field - affine @ (affine.T @ field)
        modes = geometry.step("affine", "cubic").modes.T @ (geometry.matrix @ field)
        power, length = float(modes @ modes), float(field @ field)
        if power <= MIN_INFORMATION * geometry.total * length:
            return None
        return cls(modes, math.sqrt(power / geometry.total), math.sqrt(length))


class NullDistribution(NamedTuple):
    """Distribution of the test statistic under noise alone: the covariance of the modes, and the critical value."""

    covariance: FloatArray
    limit: float

    @classmethod
    def of(cls, geometry: Geometry, noise: Noise) -> NullDistribution:
        """Return the distribution for the step from the affine to the cubic model."""
        covariance = geometry.covariance(geometry.step("affine", "cubic"), noise)
        weights = np.linalg.eigvalsh(covariance).astype(np.float64)
        return cls(covariance, chi_squares_quantile(MAX_P_SIGNIFICANT, weights))

    def detectable_factor(self, kind: _Kind) -> float:
        """Return the factor by which a kind has to be multiplied to be detected; infinite if none is enough."""
        base, scatter = float(np.trace(self.covariance)), 2 * float((self.covariance**2).sum())
        power, along = float(kind.modes @ kind.modes), float(kind.modes @ self.covariance @ kind.modes)

        def is_found(square: float) -> bool:
            return base + square * power - _POWER_Z * math.sqrt(scatter + 4 * square * along) >= self.limit

        low, high = 0.0, 1.0
        while not is_found(high):
            high *= 2
            if high > 1e300:
                return math.inf
        for _ in range(100):
            middle = (low + high) / 2
            low, high = (low, middle) if is_found(middle) else (middle, high)
        return math.sqrt(high)


def observable_shares(sums: TileSums, tile: IntArray) -> Observable:
    """Share of the tiles that constrain a displacement along each axis, for any displacement along the others."""
    spread = sum_over_tiles(sums.spread, tile)
    mean = spread / np.maximum(np.trace(spread, axis1=1, axis2=2), 1e-300)[:, None, None]
    constrained = 1 / np.diagonal(np.linalg.inv(mean + 1e-9 * np.eye(3)), axis1=1, axis2=2) >= MIN_INFORMATION
    return Observable(*(float(share) for share in constrained.mean(axis=0)))
