"""Tests of summary statistics of many files: they are those of one array in memory."""

import numpy as np
import pytest

from pcbench.measure.deviation import Spread
from pcbench.measure.tiled.spreads import Distribution, spread_of

RNG = np.random.default_rng(8)
VALUES = {
    "signed": RNG.normal(0.3, 1, 25_001),
    "distances": np.abs(RNG.standard_t(2, 30_000)),
    "ties": np.round(RNG.normal(size=1001)),
    "far from zero": RNG.normal(1e4, 1e-3, 5000),
    "one": np.array([-3.25]),
    "two": np.array([1.0, 2.0]),
    "zeros": np.zeros(10),
    "tiny": RNG.normal(0, 1e-12, 999),
}


@pytest.mark.parametrize("name", VALUES)
def test_statistics_of_one_array(name, tmp_path):
    values = VALUES[name]
    parts = [*np.array_split(values, 3), np.empty(0)]
    files = [tmp_path / f"{number}.npy" for number in range(len(parts))]
    for file, part in zip(files, parts, strict=True):
        np.save(file, part)
    merged = Distribution.merge(Distribution.of(part) for part in parts)
    found, expected = spread_of(files, merged), Spread.of(values)
    assert (found.percentiles, found.median, found.nmad) == (expected.percentiles, expected.median, expected.nmad)
    exact = values.astype(np.longdouble)
    assert found.rms == pytest.approx(expected.rms, rel=1e-12)
    assert found.bias == pytest.approx(expected.bias, rel=1e-12, abs=1e-12 * expected.rms)
    assert found.std == pytest.approx(float(exact.std()), rel=1e-12)
    assert spread_of(files[::-1], Distribution.of(values)) == found


def test_the_spread_of_equal_values_is_zero():
    found = Distribution.of(np.full(1000, 0.1))
    assert found.std == 0
    assert found.mean == 0.1


def test_without_values():
    assert spread_of([], Distribution.of(np.empty(0))) == Spread()
    assert np.isnan(Distribution.of(np.empty(0)).std)
