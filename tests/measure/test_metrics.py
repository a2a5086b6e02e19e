"""Metrics as pure functions: closed forms, brute force, and invariances."""

import re

import numpy as np
import oracles
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from wording import check_error

from pcbench import Cloud, metrics, write_cloud
from pcbench.geometry.neighbors import Index
from pcbench.geometry.voxels import cells

# Coordinates on a 2^-10 grid: shifts and powers of two are exact, so that equality can be exact.
GRID_COORDINATES = st.integers(-(2**14), 2**14).map(lambda v: v / 1024)
GRID_CLOUDS = arrays(np.float64, st.tuples(st.integers(1, 40), st.just(3)), elements=GRID_COORDINATES)


def directed_distances(queries, points):
    return Index(np.ascontiguousarray(points)).query(np.ascontiguousarray(queries)).distances


def distances_both_ways(first, second):
    return directed_distances(first, second), directed_distances(second, first)


def all_metrics(a, b):
    return {
        "d1": metrics.mean_square(a),
        "hausdorff": metrics.hausdorff(a, b),
        "unsquared": metrics.chamfer_unsquared(a, b),
        "squared": metrics.chamfer_squared(a, b),
        "fscore": metrics.fscore(a, b, 0.25).fscore,
    }


def test_closed_form_of_two_parallel_grids():
    x, y = np.meshgrid(np.arange(5.0), np.arange(5.0))
    lower = np.stack([x.ravel(), y.ravel(), np.zeros(25)], axis=1)
    a, b = distances_both_ways(lower + [0, 0, 0.5], lower)
    assert metrics.mean_square(a) == 0.25
    assert metrics.hausdorff(a, b) == 0.5
    assert metrics.chamfer_unsquared(a, b) == 1.0
    assert metrics.chamfer_squared(a, b) == 0.5
    assert metrics.fscore(a, b, 0.5) == (0.5, 1.0, 1.0, 1.0)  # a distance equal to the threshold counts as within
    assert metrics.fscore(a, b, 0.49).fscore == 0.0
    assert np.all(metrics.plane_distances(lower + [3, 4, 0.5], lower, np.tile([0, 0, 1.0], (25, 1))) == 0.5)


@given(GRID_CLOUDS, GRID_CLOUDS)
@settings(max_examples=15, deadline=None)
def test_metrics_equal_brute_force(first, second):
    a, b = distances_both_ways(first, second)
    # 1e-12: sums of at most 40 terms in another order.
    assert metrics.mean_square(a) == pytest.approx(oracles.d1(first, second), rel=1e-12, abs=1e-300)
    assert metrics.hausdorff(a, b) == pytest.approx(oracles.hausdorff(first, second), rel=1e-12)
    assert metrics.chamfer_unsquared(a, b) == pytest.approx(oracles.chamfer_unsquared(first, second), rel=1e-12)
    assert metrics.chamfer_squared(a, b) == pytest.approx(oracles.chamfer_squared(first, second), rel=1e-12, abs=1e-300)
    assert metrics.fscore(a, b, 0.7).fscore == pytest.approx(oracles.fscore(first, second, 0.7)[2])


@given(GRID_CLOUDS, GRID_CLOUDS, st.tuples(GRID_COORDINATES, GRID_COORDINATES, GRID_COORDINATES))
@settings(max_examples=15, deadline=None)
def test_shifting_both_clouds_changes_nothing(first, second, shift):
    shifted = distances_both_ways(first + shift, second + shift)
    assert all_metrics(*shifted) == all_metrics(*distances_both_ways(first, second))


@given(GRID_CLOUDS, GRID_CLOUDS)
@settings(max_examples=15, deadline=None)
def test_swapping_the_clouds_keeps_symmetric_metrics(first, second):
    a, b = distances_both_ways(first, second)
    for name in ("hausdorff", "unsquared", "squared", "fscore"):
        assert all_metrics(a, b)[name] == all_metrics(b, a)[name]


@given(GRID_CLOUDS, GRID_CLOUDS, st.sampled_from([0.25, 2.0, 1024.0]))
@settings(max_examples=15, deadline=None)
def test_scaling_scales_lengths_and_squares(first, second, factor):
    unscaled = all_metrics(*distances_both_ways(first, second))
    scaled = all_metrics(*distances_both_ways(factor * first, factor * second))
    for name, power in (("d1", 2), ("squared", 2), ("hausdorff", 1), ("unsquared", 1)):
        assert scaled[name] == pytest.approx(factor**power * unscaled[name], rel=1e-12)


@given(GRID_CLOUDS, st.randoms(use_true_random=False))
@settings(max_examples=10, deadline=None)
def test_metrics_do_not_depend_on_the_order_of_points(cloud, random):
    order = list(range(len(cloud)))
    random.shuffle(order)
    other = cloud[::-1] * 0.5
    expected = all_metrics(*distances_both_ways(cloud, other))
    assert all_metrics(*distances_both_ways(cloud[order], other)) == pytest.approx(expected, rel=1e-12)


def test_identical_clouds_have_no_error():
    cloud = np.random.default_rng(0).random((50, 3))
    a, b = distances_both_ways(cloud, cloud)
    assert all_metrics(a, b) == {"d1": 0, "hausdorff": 0, "unsquared": 0, "squared": 0, "fscore": 1}
    assert metrics.psnr(0.0, 1.0) is None


def test_percentiles_of_a_ramp():
    assert metrics.percentiles(np.arange(101.0), (5, 50, 99)) == {"p5": 5, "p50": 50, "p99": 99}


def test_plane_distances_by_rows_equal_those_of_copied_rows():
    rng = np.random.default_rng(5)
    queries, closest, normals = rng.normal(size=(3, 50, 3))
    rows = dict(zip(("query_rows", "closest_rows", "normal_rows"), rng.integers(0, 50, (3, 700)), strict=True))
    copies = [array[selection] for array, selection in zip((queries, closest, normals), rows.values(), strict=True)]
    distances = metrics.plane_distances(queries, closest, normals, **rows)
    np.testing.assert_array_equal(distances, metrics.plane_distances(*copies))
    np.testing.assert_allclose(distances, ((copies[0] - copies[1]) * copies[2]).sum(axis=1), rtol=0, atol=1e-14)
    with check_error(IndexError):
        metrics.plane_distances(queries, closest, normals, closest_rows=np.full(50, 50))


def test_area_weighting_counts_voxels_not_points():
    values = np.array([1.0] * 90 + [3.0] * 10)
    points = np.repeat([[0.5, 0.5, 0.5], [7.5, 0.5, 0.5]], [90, 10], axis=0)
    assert metrics.area_weighted_mean(values, cells(points, 1.0)) == 2.0


def test_psnr_follows_mpeg():
    assert metrics.psnr(0.03, 1.0) == pytest.approx(20.0)


@pytest.mark.parametrize(
    "compute",
    [
        lambda e: metrics.mean_square(e),
        lambda e: metrics.hausdorff(e, e),
        lambda e: metrics.chamfer_unsquared(e, e),
        lambda e: metrics.fscore(e, e, 1.0),
        lambda e: metrics.percentiles(e),
    ],
)
def test_empty_distances_are_refused(compute):
    with check_error():
        compute(np.empty(0))


@pytest.mark.parametrize("threshold", [0.0, -1.0, np.nan])
def test_thresholds_must_be_positive(threshold):
    with check_error():
        metrics.fscore(np.ones(3), np.ones(3), threshold)


ONE_WAY = ("mean_square", "one_way_hausdorff", "percentiles")
BOTH_WAYS = ("hausdorff", "chamfer_unsquared", "chamfer_squared", "fscore")


@pytest.mark.parametrize("name", ONE_WAY + BOTH_WAYS)
def test_points_instead_of_distances_are_refused_with_the_right_call(name):
    points, extra_arguments = np.zeros((7, 3)), [1.0] if name == "fscore" else []
    arguments = [points] if name in ONE_WAY else [points, points]
    with check_error() as caught:
        getattr(metrics, name)(*arguments, *extra_arguments)
    suggestion = re.search(r"for points, metrics\.(\w+)\(candidate, reference(, threshold)?\)$", str(caught.value))
    assert getattr(metrics, suggestion[1])(points, points, *extra_arguments) is not None
    if name in BOTH_WAYS:
        with check_error():
            getattr(metrics, name)(np.zeros(7), points, *extra_arguments)


def test_values_must_have_one_row_per_point():
    voxels = cells(np.random.default_rng(0).random((7, 3)), 0.5)
    with check_error():
        metrics.area_weighted_mean(np.zeros((7, 3)), voxels)
    with check_error():
        metrics.area_weighted_mean(np.zeros(6), voxels)
    with check_error():
        metrics.fscore([0.0, np.nan, 1.0], [0.0], 1.0)


def test_distances_may_be_a_list():
    assert metrics.hausdorff([1, 3, 2], [2]) == 3.0


@pytest.mark.parametrize("shift", [0.0, 5e6])
@pytest.mark.parametrize("seed", range(3))
def test_metrics_between_clouds_equal_brute_force(seed, shift):
    rng = np.random.default_rng(seed)
    first, second = rng.normal(size=(150, 3)) + shift, rng.normal(size=(230, 3)) * [1, 2, 0.5] + shift
    a, b = metrics.distances_between(first, second)
    np.testing.assert_allclose(a, oracles.nearest(first, second)[0], rtol=1e-12)
    np.testing.assert_allclose(b, oracles.nearest(second, first)[0], rtol=1e-12)
    tolerance = {"rel": 1e-12}
    assert metrics.mean_square_between(first, second) == pytest.approx(oracles.d1(first, second), **tolerance)
    assert metrics.one_way_hausdorff_between(second, first) == pytest.approx(b.max(), **tolerance)
    assert metrics.percentiles_between(first, second, (50,))["p50"] == pytest.approx(np.median(a), **tolerance)
    for name in ("hausdorff", "chamfer_unsquared", "chamfer_squared"):
        expected = getattr(oracles, name)(first, second)
        assert getattr(metrics, f"{name}_between")(first, second) == pytest.approx(expected, **tolerance), name
    assert metrics.fscore_between(first, second, 0.5)[1:] == pytest.approx(oracles.fscore(first, second, 0.5))


def test_clouds_may_be_objects_arrays_or_files(tmp_path):
    rng = np.random.default_rng(4)
    first, second = rng.random((40, 3)), rng.random((50, 3))
    expected = metrics.hausdorff_between(first, second)
    write_cloud(tmp_path / "a.ply", Cloud(first))
    assert metrics.hausdorff_between(tmp_path / "a.ply", Cloud(second)) == expected
    assert metrics.hausdorff_between(str(tmp_path / "a.ply"), second.tolist()) == expected
    with check_error():
        metrics.hausdorff_between(tmp_path / "b.ply", second)
    with check_error():
        metrics.chamfer_unsquared_between(first[:, 0], second)


@pytest.mark.parametrize("name", ["chamfer_unsquared", "hausdorff", "fscore"])
def test_signed_distances_are_refused_if_they_would_cancel(name):
    extra_arguments = [0.1] if name == "fscore" else []
    with check_error():
        getattr(metrics, name)([1.0, -1.0], [1.0], *extra_arguments)
    assert metrics.mean_square([1.0, -1.0]) == 1.0  # squares do not depend on the sign
