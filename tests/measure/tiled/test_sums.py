"""Tests of exact sums: against fractions and math.fsum, and that no bit depends on order, partition or merging."""

import math
import pickle
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pcbench.errors import InputError
from pcbench.measure.tiled.sums import Groups, GroupSums
from pcbench.native import _core

UNIT = Fraction(1, 1 << 128)
REPRESENTABLE = st.floats(-1e28, 1e28).map(lambda v: v if v == 0 or abs(v) > 2.0**-70 else math.copysign(2.0**-70, v))


def truncated(value):
    """The exact value of a double, toward zero to a multiple of 2^-128."""
    return math.trunc(Fraction(value) / UNIT) * UNIT


def same(a, b):
    """Return whether two sums are equal in all bits."""
    return (
        np.array_equal(a.keys, b.keys)
        and np.array_equal(a.counts, b.counts)
        and a.limbs.keys() == b.limbs.keys()
        and all(np.array_equal(a.limbs[name], b.limbs[name]) for name in a.limbs)
    )


@given(st.lists(st.tuples(st.integers(-3, 3), REPRESENTABLE), max_size=60))
def test_sums_are_the_nearest_doubles(pairs):
    keys, values = np.array([k for k, _ in pairs], np.int64), np.array([v for _, v in pairs], float)
    found = GroupSums.of(keys, {"v": values})
    assert found.keys.tolist() == sorted(set(keys.tolist()))
    assert found.counts.tolist() == [int((keys == key).sum()) for key in found.keys]
    assert found.sums("v").tolist() == [math.fsum(values[keys == key]) for key in found.keys]
    assert found.exact_total("v") == sum(map(Fraction, values.tolist()))
    assert found.total("v") == math.fsum(values)
    assert found.count == len(values)


@given(st.lists(st.floats(-(2.0**95), 2.0**95), max_size=40))
def test_bits_below_the_unit_are_dropped_toward_zero(values):
    found = GroupSums.of(None, {"v": np.array(values, float)})
    assert found.exact_total("v") == sum(map(truncated, values))


@settings(max_examples=25)
@given(st.data())
def test_no_bit_depends_on_order_or_partition(data):
    count = data.draw(st.integers(1, 80))
    rng = np.random.default_rng(data.draw(st.integers(0, 1000)))
    keys = rng.integers(-5, 5, count) * data.draw(st.sampled_from([1, 10**12]))
    values = {"a": rng.normal(size=count) * 10.0 ** rng.integers(-30, 25, count), "b": rng.random(count)}
    whole = GroupSums.of(keys, values)
    order = rng.permutation(count)
    cuts = sorted(data.draw(st.lists(st.integers(0, count), max_size=5)))
    parts = [GroupSums.of(keys[rows], {n: v[rows] for n, v in values.items()}) for rows in np.split(order, cuts)]
    assert same(GroupSums.merge(parts), whole)
    at = data.draw(st.integers(0, len(parts) - 1))
    pairwise = GroupSums.merge([GroupSums.merge(parts[at:]), *reversed(parts[:at])])
    assert same(pickle.loads(pickle.dumps(pairwise)), whole)


@given(st.integers(-(1 << 250), 1 << 250), st.integers(0, 200))
def test_rounding_of_any_fixed_point_number(number, dropped):
    number >>= dropped
    digits = np.frombuffer(number.to_bytes(32, "little", signed=True), "<u4").reshape(1, 8).astype(np.uint32)
    found = np.empty(1)
    _core.round_exactly(digits, found)
    assert found[0] == number / (1 << 128)  # Python divides integers with one rounding, ties to even


def test_ties_are_rounded_to_even():
    numbers = [(1 << 90) + (odd << 37) + (1 << 36) + more for odd in (0, 1) for more in (-1, 0, 1)]
    found = np.empty(len(numbers))
    digits = b"".join(number.to_bytes(32, "little", signed=True) for number in numbers)
    _core.round_exactly(np.frombuffer(digits, "<u4").reshape(-1, 8).astype(np.uint32), found)
    assert found.tolist() == [number / (1 << 128) for number in numbers]


def test_opposite_values_cancel_exactly():
    values = np.array([1e28, 1e-30, -1e28, 3.0, -1e-30])
    found = GroupSums.of(None, {"v": values})
    assert found.total("v") == 3.0
    assert found.mean("v") == 0.6


def test_subnormal_values_count_as_zero():
    found = GroupSums.of(None, {"v": np.array([5e-324, -1e-310, -0.0, 2.0**-128, -(2.0**-128.5)])})
    assert found.exact_total("v") == UNIT
    assert found.count == 5


def test_many_values_of_one_key_reach_all_limbs():
    values = np.full(200_000, np.nextafter(2.0**96, 0))
    found = GroupSums.of(None, {"v": -values})
    assert found.exact_total("v") == -200_000 * Fraction(values[0])
    assert GroupSums.merge([found] * 5).total("v") == -1e6 * values[0]


def test_sums_beyond_their_range_are_refused():
    part = GroupSums.of(None, {"v": np.full(10**6, 2.0**95)})
    for _ in range(4):
        part = GroupSums.merge([part] * 8)
    with pytest.raises(InputError, match=r"^expected sums below 1e38 in magnitude, got larger ones$"):
        GroupSums.merge([part] * 2)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, 2.0**96, -1e200])
def test_values_out_of_range_are_refused(bad):
    with pytest.raises(InputError, match=r"expected finite values below 8e28 to sum \(d1_mse\), got"):
        GroupSums.of(None, {"d1_mse": np.array([1.0, bad, 2.0])})


def test_without_values():
    nothing = GroupSums.of(np.empty(0, np.int64), {"v": np.empty(0)})
    alone = GroupSums.of(None, {"v": np.empty(0)})
    for empty in (nothing, alone):
        assert len(empty.keys) == len(empty.sums("v")) == empty.count == empty.total("v") == 0
        assert math.isnan(empty.mean("v"))
    some = GroupSums.of(np.array([7]), {"v": np.array([0.5])})
    assert same(GroupSums.merge([nothing, some, nothing]), some)
    assert len(GroupSums.merge([nothing, nothing]).keys) == 0


def test_keys_of_any_size_are_grouped():
    extreme = np.array([2**63 - 1, -(2**63), 0, -(2**63)])
    found = Groups.of(extreme)
    assert found.keys.tolist() == [-(2**63), 0, 2**63 - 1]
    np.testing.assert_array_equal(found.keys[found.of_value], extreme)
    dense = np.random.default_rng(0).integers(100, 130, 50)
    np.testing.assert_array_equal(Groups.of(dense).keys[Groups.of(dense).of_value], dense)


def test_means_divide_sums_by_counts():
    found = GroupSums.of(np.array([4, 4, 9]), {"v": np.array([1.0, 2.0, 5.0])})
    np.testing.assert_array_equal(found.means("v"), [1.5, 5.0])
    assert found.mean("v") == 8 / 3


def test_kernels_refuse_arrays_that_do_not_fit():
    limbs = np.zeros((2, 8), np.uint32)
    with pytest.raises(IndexError, match="groups that have limbs"):
        _core.add_exactly(np.ones(1), np.array([2]), limbs)
    with pytest.raises(IndexError, match="groups that have limbs"):
        _core.add_exactly(np.ones(1), np.array([-1]), limbs)
    with pytest.raises(ValueError, match="one group for each"):
        _core.add_exactly(np.ones(2), np.array([0]), limbs)
    with pytest.raises(ValueError, match="one result per sum"):
        _core.round_exactly(np.zeros((2, 8), np.uint32), np.empty(1))


def test_parts_are_added_in_place():
    rng = np.random.default_rng(3)
    keys, values = rng.integers(0, 7, 300), rng.normal(size=300) * 10.0 ** rng.integers(-30, 25, 300)
    total = GroupSums.empty(7, ["v"])
    for part in np.array_split(np.arange(300), 40):
        total.add(GroupSums.of(keys[part], {"v": values[part]}))
    assert same(total, GroupSums.of(keys, {"v": values}))
