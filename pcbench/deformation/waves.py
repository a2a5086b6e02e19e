"""Search for waves in what the largest model leaves: strip errors, corrugation, doming in blocks.

A cubic field has no more than two turns. What it leaves is projected onto plane waves of many lengths and directions,
each of which displaces the surface along one axis. Noise has a spectrum that is smooth, because it is correlated over a
short length: the power of a wave is compared with that of waves of nearly the same length. So a wave stands out even
though it also enlarged the estimate of the noise. Under stationary noise the ratio is an exponential variable; uneven
noise and the outline of the scene make it larger, so a wave must also continue over the scene: fitted to one half of
a chequerboard, it has to predict the other.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcbench.deformation.pairs import Pairs
from pcbench.deformation.parts import Wave, WaveLimit
from pcbench.deformation.sides import extent
from pcbench.deformation.size import MAX_P_SIGNIFICANT
from pcbench.deformation.verdict import in_standard_errors
from pcbench.geometry.arrays import FloatArray, IntArray
from pcbench.geometry.order_statistics import percentiles_of_columns

_STEP = (
    0.5  # cycles along the extent between two wave numbers: waves between them keep at least two thirds of the power
)
_MIN_CYCLES, _MAX_CYCLES = 3.5, 24.0  # along the extent of the scene: a cubic field shows the longest waves
_PAIRS_ALONG = 6.0  # pairs along the shortest wave
_NEIGHBORS = 24  # waves with next smaller, and with next larger wave numbers, whose median power is that of noise
_MIN_INFORMATION = 0.05  # share of the weight that observes the axis of a displacement
_TILES_ALONG = 8  # tiles of a chequerboard: waves fitted to one colour have to predict the other
_MIN_GAIN = 5.0  # by this many standard errors over the tiles; noise that is correlated over a tenth gains at most 2.6
_LEAST_POWER = 0.66  # share of the power of a wave between two wave numbers
_POWER_Z = 1.282  # normal quantile of the power of 90 %


class WaveSearch(NamedTuple):
    """The wave that stands out most, if any does, and the size above which one would have."""

    wave: Wave | None
    limit: WaveLimit | None


def find_waves(pairs: Pairs) -> WaveSearch:
    """Search the residuals of the largest model for a significant wave that continues over the scene."""
    counted = pairs.weights > 0
    places, normals, remainders, weights = (
        values[counted] for values in (pairs.places, pairs.normals, pairs.remainders, pairs.weights)
    )
    size = extent(places)
    plane = np.sort(np.argsort(np.ptp(percentiles_of_columns(places, [1, 99]), axis=0))[1:])
    across = (places[:, plane] - places[:, plane].mean(axis=0)) / size
    most = min(_MAX_CYCLES, math.sqrt(len(places)) / _PAIRS_ALONG)
    numbers = _wave_numbers(most)
    if len(numbers) <= 4 * _NEIGHBORS:
        return WaveSearch(None, None)
    axes = [axis for axis in range(3) if weights @ np.square(normals[:, axis]) > _MIN_INFORMATION * weights.sum()]
    taper, waves = _taper(across), _Waves.of(across, numbers)
    best, limit = None, None
    for axis in axes:
        loads = weights * normals[:, axis] * taper
        powers = np.square(np.abs(waves.spectrum(loads * remainders)))
        expected = _power_nearby(powers) / math.log(2)
        inner = slice(_NEIGHBORS, len(numbers) - _NEIGHBORS)
        ratios = powers[inner] / np.maximum(expected[inner], 1e-300)
        tests = len(axes) * len(ratios)
        peak = int(np.argmax(ratios))
        if best is None or ratios[peak] > best[0]:
            best = float(ratios[peak]), axis, numbers[inner][peak], tests
        # The ratio that a wave between two wave numbers reaches in nine of ten cases.
        needed = (math.sqrt(math.log(tests / MAX_P_SIGNIFICANT)) + _POWER_Z / math.sqrt(2)) ** 2 / _LEAST_POWER
        seen = float(loads @ normals[:, axis]) ** 2 / float(weights @ np.square(normals[:, axis])) * weights.sum() / 2
        if axis not in plane:
            lengths = size / np.linalg.norm(numbers[inner], axis=1)
            rms = math.sqrt(needed * float(np.percentile(expected[inner], 95)) / seen)
            limit = WaveLimit(float(lengths.min()), float(lengths.max()), rms)
    if best is None:
        return WaveSearch(None, limit)
    ratio, axis, number, tests = best
    if tests * math.exp(-ratio) > MAX_P_SIGNIFICANT:
        return WaveSearch(None, limit)
    loads = weights * normals[:, axis]
    number = _refined(across, loads * remainders * taper, number)
    phases = 2 * math.pi * across @ number
    columns = np.stack([np.cos(phases), np.sin(phases)], axis=1) * normals[:, [axis]]
    gain = _prediction_gain(across, columns, remainders, weights)
    if gain < _MIN_GAIN:
        return WaveSearch(None, limit)
    explained = _explained(columns, remainders, weights)
    rms = math.sqrt(max(0.0, explained * (1 - 1 / ratio)) / float(weights.sum()))
    error = 1.96 * rms / math.sqrt(2 * ratio)
    vector = np.zeros(3)
    vector[plane] = number / np.linalg.norm(number)
    x, y, z = map(float, vector)
    return WaveSearch(
        Wave(
            length=size / float(np.linalg.norm(number)),
            direction=(x, y, z),
            axis="xyz"[axis],
            rms=rms,
            ci=(max(0.0, rms - error), rms + error),
            gain=gain,
        ),
        limit,
    )


def _wave_numbers(most: float) -> FloatArray:
    """Return wave numbers (M, 2) of half a plane, in cycles along the extent, sorted by length."""
    along = np.arange(-math.floor(most / _STEP), math.floor(most / _STEP) + 1) * _STEP
    numbers = np.stack(np.meshgrid(along, along, indexing="ij"), axis=-1).reshape(-1, 2)
    length = np.hypot(*numbers.T)
    is_half = (numbers[:, 1] > 0) | ((numbers[:, 1] == 0) & (numbers[:, 0] > 0))
    kept = (length >= _MIN_CYCLES) & (length <= most) & is_half
    ascending: FloatArray = numbers[kept][np.argsort(length[kept], kind="stable")]
    return ascending


class _Waves(NamedTuple):
    """Complex waves at N positions: products of factors along both axes, whose wave numbers are multiples of a step.

    Waves along opposite directions of the first axis share the real and the imaginary part of a factor.
    """

    first: FloatArray  # (2 F, N) cosines, and sines, of the multiples 0 to F - 1
    second: FloatArray  # (N, 2 S) cosines and sines of the multiples 0 to S - 1, alternating
    multiples: IntArray  # (M, 2) of each wave; those of the second axis are not negative

    @classmethod
    def of(cls, across: FloatArray, numbers: FloatArray) -> _Waves:
        """Return waves of the numbers (M, 2), multiples of the step, at positions (N, 2)."""
        multiples = np.rint(numbers / _STEP).astype(np.int64)
        first, second = (_powers(across[:, axis], 1 + int(np.abs(multiples[:, axis]).max())) for axis in range(2))
        return cls(np.concatenate([first.real, first.imag]), second.T.copy().view(np.float64), multiples)

    def spectrum(self, values: FloatArray) -> NDArray[np.complex128]:
        """Return the sums (M,), complex, of values (N,) times each wave."""
        by_cosine, by_sine = np.split((self.first @ (self.second * values[:, None])).view(np.complex128), 2)
        of_first, of_second = self.multiples.T
        places, signs = (np.abs(of_first), of_second), np.sign(of_first)
        spectrum: NDArray[np.complex128] = by_cosine[places] + 1j * signs * by_sine[places]
        return spectrum


def _powers(places: FloatArray, count: int) -> NDArray[np.complex128]:
    """Return the waves (count, N) of 0, 1, 2, ... steps at places (N,): powers of the first, by repeated doubling."""
    waves = np.ones((count, len(places)), dtype=np.complex128)
    step = np.exp(-2j * np.pi * _STEP * places)
    done = 1
    while done < count:
        more = min(done, count - done)
        np.multiply(waves[:more], step, out=waves[done : done + more])
        step, done = step * step, 2 * done
    return waves


def _taper(across: FloatArray) -> FloatArray:
    """Return factors (N,) that fall to zero at the border, so that power does not leak to other wave numbers."""
    inside = np.clip(across - (across.min(axis=0) + across.max(axis=0)) / 2, -0.5, 0.5)
    factors: FloatArray = np.square(np.cos(math.pi * inside)).prod(axis=1)
    return factors


def _power_nearby(powers: FloatArray) -> FloatArray:
    """Return the larger median (M,) of the neighbours on either side: the spectrum of correlated noise is steep."""
    medians = np.median(np.lib.stride_tricks.sliding_window_view(powers, _NEIGHBORS), axis=1)
    nearby = np.full(len(powers), np.inf)
    nearby[_NEIGHBORS:-_NEIGHBORS] = np.maximum(medians[: -_NEIGHBORS - 1], medians[_NEIGHBORS + 1 :])
    return nearby


def _refined(across: FloatArray, values: FloatArray, number: FloatArray) -> FloatArray:
    """Return the wave number near a given one at which the power is largest, to an eighth of a step."""
    for step in (_STEP / 2, _STEP / 4, _STEP / 8):
        near = number + step * np.stack(np.meshgrid([-1, 0, 1], [-1, 0, 1]), axis=-1).reshape(-1, 2)
        powers = [abs(np.exp(-2j * np.pi * (across @ each)) @ values) for each in near]
        number = near[int(np.argmax(powers))]
    return number


def _explained(columns: FloatArray, remainders: FloatArray, weights: FloatArray) -> float:
    """Return the weighted sum of squares of residuals (N,) that columns (N, 2) explain."""
    scores = columns.T @ (weights * remainders)
    return float(scores @ np.linalg.solve((columns * weights[:, None]).T @ columns, scores))


def _prediction_gain(across: FloatArray, columns: FloatArray, remainders: FloatArray, weights: FloatArray) -> float:
    """Return how much better a wave predicts the other half of a chequerboard than none, in standard errors."""
    tiles = np.floor(across * _TILES_ALONG).astype(np.int64)
    _, tile = np.unique(tiles, axis=0, return_inverse=True)
    colour = tiles.sum(axis=1) % 2
    gains = np.zeros(int(tile.max()) + 1)
    for out in (0, 1):
        fitted, tested = colour != out, colour == out
        if not fitted.any() or not tested.any():
            return 0.0
        normal = (columns[fitted] * weights[fitted, None]).T @ columns[fitted]
        scores = columns[fitted].T @ (weights * remainders)[fitted]
        predicted = columns[tested] @ np.linalg.lstsq(normal, scores, rcond=None)[0]
        gain = weights[tested] * (np.square(remainders[tested]) - np.square(remainders[tested] - predicted))
        gains += np.bincount(tile[tested].ravel(), gain, len(gains))
    return in_standard_errors(gains)
