"""Tests of order statistics of many files: they are those of numpy in all bits."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from number_cases import finite_numbers

from pcbench.errors import InputError
from pcbench.geometry import order_statistics
from pcbench.measure.tiled import ranks
from pcbench.measure.tiled.ranks import BitHistogram, Wanted, count_values

PERCENTS = (0.0, 1.0, 5.0, 25.0, 50.0, 75.0, 90.0, 95.0, 99.0, 99.99, 100.0)


INPUTS = dict(finite_numbers())


@pytest.fixture
def little_memory(monkeypatch):
    """All bits are never resolved at once, and files are read in several blocks."""
    monkeypatch.setattr(ranks, "_MAX_RESOLVED", 0)
    monkeypatch.setattr(ranks, "_VALUES_PER_BLOCK", 1000)
    monkeypatch.setattr(ranks, "_HISTOGRAMS_PER_BATCH", 2)


def save(folder, values, parts=4):
    """Write values to several files, one of them empty, and return the files and the histogram of all values."""
    files, histograms = [], []
    for number, part in enumerate([*np.array_split(values, parts), np.empty(0)]):
        files.append(folder / f"{number}.npy")
        np.save(files[-1], part)
        histograms.append(BitHistogram.of(part))
    return files, BitHistogram.merge(histograms)


@pytest.mark.parametrize("name", INPUTS)
@pytest.mark.parametrize("memory", ["enough", "little"])
def test_values_of_numpy(name, memory, tmp_path, request):
    if memory == "little":
        request.getfixturevalue("little_memory")
    values = INPUTS[name]
    files, histogram = save(tmp_path, values)
    assert histogram.count == len(values)
    np.testing.assert_array_equal(ranks.percentiles(files, histogram, PERCENTS), np.percentile(values, PERCENTS))
    middle = ranks.median(files, histogram)
    assert middle == np.median(values)
    assert ranks.median_distance(files, middle) == np.median(np.abs(values - middle))
    assert ranks.median_distance(files, 0.5) == order_statistics.median_distance(values, 0.5)


@settings(max_examples=20, suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
@given(st.lists(st.floats(allow_nan=False, allow_infinity=False), min_size=1, max_size=50), st.booleans())
def test_all_ranks_of_any_values(tmp_path, values, resolved):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ranks, "_MAX_RESOLVED", 10 if resolved else 0)
        files, histogram = save(tmp_path, np.array(values), 3)
        found = ranks.select(files, histogram, np.arange(len(values)))
    np.testing.assert_array_equal(found, np.sort(values))


def test_ranks_in_any_order_and_repeated(tmp_path):
    files, histogram = save(tmp_path, INPUTS["normal 100"])
    wanted = np.array([90, 10, 90, 50, 0, 99])
    np.testing.assert_array_equal(ranks.select(files, histogram, wanted), np.sort(INPUTS["normal 100"])[wanted])


def test_no_bit_depends_on_the_files_or_their_order(tmp_path):
    values = INPUTS["ties 30001"]
    whole = BitHistogram.of(values)
    for parts in (1, 7):
        files, histogram = save(tmp_path, np.random.default_rng(parts).permutation(values), parts)
        np.testing.assert_array_equal(histogram.bins, whole.bins)
        np.testing.assert_array_equal(histogram.counts, whole.counts)
        backwards = ranks.select(files[::-1], histogram, np.arange(0, 30_001, 1000))
        np.testing.assert_array_equal(backwards, np.sort(values)[::1000])


def test_files_are_counted_by_any_workers(tmp_path, little_memory):
    values = INPUTS["normal 30001"]
    files, histogram = save(tmp_path, values)
    with ThreadPoolExecutor(3) as pool:
        found = ranks.percentiles(files, histogram, PERCENTS, map_files=pool.map)
    np.testing.assert_array_equal(found, np.percentile(values, PERCENTS))


def test_passes_over_the_files_are_few(tmp_path):
    values = INPUTS["normal 30001"]
    files, histogram = save(tmp_path, values)
    read = []

    def run(function, files):
        read.extend(files)
        return map(function, files)

    ranks.percentiles(files, histogram, PERCENTS, map_files=run)
    assert sorted(read) == sorted(files)


def test_histograms_stay_small(tmp_path, little_memory):
    values = np.random.default_rng(2).random(200_000)
    files, histogram = save(tmp_path, values, 2)
    wanted = Wanted(None, histogram.bins[[5]], histogram.bits, histogram.bits + 14)
    found = BitHistogram.merge(count_values(file, wanted) for file in files)
    assert found.count == histogram.counts[5]
    assert len(found.bins) <= 2**14
    assert (found.bins >> 14 == histogram.bins[5]).all()


@pytest.mark.parametrize(
    "name", ["normal 30001", "far from zero 30001", "ties 30001", "many magnitudes 30001", "zeros 5"]
)
def test_approximate_percentiles_are_within_a_bin(name):
    values = INPUTS[name]
    histogram = BitHistogram.of(values)
    for rank in PERCENTS:
        exact = np.sort(values)[round((len(values) - 1) * rank / 100)]
        assert abs(histogram.approximate_percentile(rank) - exact) <= 1e-3 * abs(exact)


def test_without_values(tmp_path):
    empty = BitHistogram.of(np.empty(0))
    assert empty.count == 0
    assert np.isnan(empty.approximate_percentile(50))
    some = BitHistogram.of(np.array([1.0]))
    assert BitHistogram.merge([empty, some, empty]).count == 1


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_values_that_are_not_finite_are_refused(bad):
    with pytest.raises(InputError, match="expected finite values, got"):
        BitHistogram.of(np.array([1.0, bad]))


def test_files_of_other_values_are_refused(tmp_path):
    files, histogram = save(tmp_path, INPUTS["normal 100"])
    np.save(files[0], np.full(25, 1e9))
    with pytest.raises(InputError, match=r"values in the files of a comparison, got .*: they changed while it was"):
        ranks.select(files, histogram, np.arange(100))
    np.save(files[0], np.zeros((3, 2)))
    with pytest.raises(InputError, match=r"0\.npy: expected an array \(N,\) of float64, got \(3, 2\) of float64"):
        ranks.median(files, histogram)
