"""Nearest-neighbour search compared with an independent brute force in numpy: bit-identical, ties by index."""

import pickle
import subprocess
import sys

import numpy as np
import oracles
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from optional import import_or_skip
from point_shapes import SHAPES, clustered_points, grid_points, oblique_plane, uniform_points
from wording import check_error

from pcbench.geometry.neighbors import Index, match_both_directions
from pcbench.geometry.sampling import median_spacing


def squared_distances(queries, points):
    """Squared distances (M, N) in the documented order of operations; numpy does not use fused multiply-adds."""
    x, y, z = (queries[:, None, a] - points[None, :, a] for a in range(3))
    return (x * x + y * y) + z * z


def brute_force_nearest(queries, points, k=1):
    squared = squared_distances(queries, points)
    order = np.argsort(squared, axis=1, kind="stable")[:, :k]  # a stable sort resolves ties by index
    distances = np.sqrt(np.take_along_axis(squared, order, axis=1))
    return (distances[:, 0], order[:, 0]) if k == 1 else (distances, order)


def assert_matches(matches, expected):
    np.testing.assert_array_equal(matches.distances, expected[0])
    np.testing.assert_array_equal(matches.indices, expected[1])
    assert matches.distances.dtype == np.float64 and matches.indices.dtype == np.int64


@pytest.fixture(params=SHAPES, ids=lambda shape: shape.__name__)
def shape(request):
    return request.param


def near_and_far_queries(rng, points, n):
    extent = np.ptp(points, axis=0).max() or 1.0
    samples = points[rng.integers(0, len(points), n)]
    return np.concatenate(
        [
            samples,
            samples + rng.normal(0, 0.01 * extent, samples.shape),
            samples + rng.normal(0, 30 * extent, samples.shape),
            samples[:5] + 1e9 * extent,
        ]
    )


@pytest.mark.parametrize("n", [1, 2, 7, 8, 9, 63, 64, 65, 520, 3000])
def test_nearest_equals_brute_force(shape, n):
    rng = np.random.default_rng(n)
    points = shape(rng, n)
    queries = near_and_far_queries(rng, points, 150)
    assert_matches(Index(points).query(queries), brute_force_nearest(queries, points))


@pytest.mark.parametrize("k", [2, 8, 40, 200])
def test_k_nearest_equals_brute_force(shape, k):
    """Few are found by a sorted list, more by groups of eight queries, and many by a buffer for each query."""
    rng = np.random.default_rng(k)
    points = shape(rng, 1500)
    queries = near_and_far_queries(rng, points, 60)
    assert_matches(Index(points).query(queries, k), brute_force_nearest(queries, points, k))


def test_distances_that_differ_in_their_last_bits_are_in_order():
    """Groups of queries sort by all but the last 12 bits first."""
    rng = np.random.default_rng(9)
    directions = rng.normal(size=(400, 3))
    radii = 1 + 2e-16 * rng.integers(0, 3000, 400)
    points = directions / np.linalg.norm(directions, axis=1, keepdims=True) * radii[:, None]
    queries = 1e-13 * rng.normal(size=(400, 3))
    assert_matches(Index(points).query(queries, 120), brute_force_nearest(queries, points, 120))


def test_k_may_equal_the_number_of_points(shape):
    rng = np.random.default_rng(3)
    points = shape(rng, 77)
    assert_matches(Index(points).query(points, 77), brute_force_nearest(points, points, 77))


@settings(max_examples=50, deadline=None)
@given(
    points=hnp.arrays(np.float64, st.tuples(st.integers(1, 150), st.just(3)), elements=st.floats(-1e100, 1e100)),
    queries=hnp.arrays(np.float64, st.tuples(st.integers(1, 20), st.just(3)), elements=st.floats(-1e100, 1e100)),
)
def test_matches_of_any_finite_coordinates_equal_brute_force(points, queries):
    index = Index(points)
    assert_matches(index.query(queries), brute_force_nearest(queries, points))
    if len(points) > 1:
        for k in (2, len(points) // 2 + 1):
            assert_matches(index.query(queries, k), brute_force_nearest(queries, points, k))


def test_a_stored_tree_answers_like_the_index_that_was_built():
    rng = np.random.default_rng(4)
    for count in (1, 8, 65, 5_000):
        points, queries = rng.random((count, 3)), rng.random((50, 3))
        built = Index(points)
        memory = np.empty(built.nbytes // 8 + 4)
        start = -memory.ctypes.data // 8 % 4  # a multiple of 32 bytes
        memory[start : start + built.nbytes // 8] = built.tree
        stored = Index.stored(points, memory[start : start + built.nbytes // 8])
        for k in (1, min(20, count)):
            for ours, theirs in zip(stored.query(queries, k), built.query(queries, k), strict=True):
                np.testing.assert_array_equal(ours, theirs)
        with check_error(ValueError):
            Index.stored(points, memory[start : start + built.nbytes // 8 - 1])


def test_many_points_agree_with_scipy():
    scipy_spatial = import_or_skip("scipy.spatial")
    rng = np.random.default_rng(11)
    points, queries = clustered_points(rng, 60_000), clustered_points(rng, 8_000)
    matches = Index(points).query(queries)
    _, expected = scipy_spatial.cKDTree(points, balanced_tree=False, compact_nodes=False).query(queries, workers=-1)
    x, y, z = (queries - points[expected]).T
    np.testing.assert_array_equal(matches.distances, np.sqrt((x * x + y * y) + z * z))
    np.testing.assert_array_equal(matches.indices, expected)


def test_a_hint_does_not_change_the_result(shape):
    rng = np.random.default_rng(4)
    points = shape(rng, 700)
    queries = near_and_far_queries(rng, points, 100)
    index, source, expected = Index(points), Index(queries), brute_force_nearest(queries, points)
    for hint in (expected[1], rng.integers(0, 700, len(queries))):
        assert_matches(index.nearest_of_moved(source, np.eye(4), hint)[1], expected)
        assert_matches(index.query(queries, hint=hint), expected)


def test_few_queries_of_many_points_equal_brute_force(shape):
    """Fewer queries than a fiftieth of the points, a twentieth for k > 1, are searched for one by one."""
    rng = np.random.default_rng(8)
    points = shape(rng, 4000)
    index = Index(points)
    for n in (1, 5, 15):
        queries = near_and_far_queries(rng, points, n)
        expected = brute_force_nearest(queries, points)
        assert_matches(index.query(queries), expected)
        assert_matches(index.query(queries, 30), brute_force_nearest(queries, points, 30))
        for hint in (expected[1], rng.integers(0, len(points), len(queries))):
            assert_matches(index.query(queries, hint=hint), expected)
            assert_matches(index.nearest_of_moved(Index(queries), np.eye(4), hint)[1], expected)
        assert_matches(index.query_index(Index(queries)), expected)


@pytest.mark.parametrize("n", [2, 8, 9, 65, 900])
def test_nearest_other_excludes_the_point_itself(shape, n):
    points = shape(np.random.default_rng(n), n)
    squared = squared_distances(points, points)
    np.fill_diagonal(squared, np.inf)
    indices = squared.argmin(axis=1)
    assert_matches(Index(points).nearest_other(), (np.sqrt(squared[np.arange(n), indices]), indices))


def test_matching_in_both_directions_equals_two_queries(shape):
    rng = np.random.default_rng(5)
    reference, candidate = shape(rng, 1100), shape(rng, 333)
    to_reference, to_candidate = match_both_directions(Index(reference), Index(candidate))
    assert_matches(to_reference, brute_force_nearest(candidate, reference))
    assert_matches(to_candidate, brute_force_nearest(reference, candidate))


def test_an_index_matched_with_itself_finds_every_point():
    index = Index(uniform_points(np.random.default_rng(6), 50))
    for matches in match_both_directions(index, index):
        assert_matches(matches, (np.zeros(50), np.arange(50)))


@pytest.mark.parametrize("fraction", [0.0, 1e-30, 1e-8, 1e-3, 0.1, 10.0])
def test_ties_equal_brute_force(shape, fraction):
    rng = np.random.default_rng(15)
    points = shape(rng, 700)
    queries = near_and_far_queries(rng, points, 150)
    squared = squared_distances(queries, points)
    nearest, rows = squared.argmin(axis=1), np.arange(len(queries))
    slack = fraction * (np.ptp(points, axis=0).max() or 1.0) ** 2
    has_tie = squared - squared[rows, nearest, None] < slack
    has_tie[rows, nearest] = False
    index, source = Index(points), Index(queries)
    matches, tied = index.query_index_with_ties(source, slack)
    np.testing.assert_array_equal(tied, has_tie.any(axis=1))
    for got, expected in zip(matches, index.query_index(source), strict=True):
        np.testing.assert_array_equal(got, expected)


def test_tie_slack_is_exact(shape):
    rng = np.random.default_rng(16)
    points = shape(rng, 500)
    queries = near_and_far_queries(rng, points, 60)
    squared = np.sort(squared_distances(queries, points), axis=1)
    index = Index(points)
    for row in range(0, len(queries), 3):
        slack, source = squared[row, 1] - squared[row, 0], Index(queries[row : row + 1])
        assert not index.query_index_with_ties(source, slack)[1].any()
        assert index.query_index_with_ties(source, np.nextafter(slack, np.inf))[1].all()


def test_ties_of_many_duplicates_cost_no_more_than_matches():
    """Points at one position, or all within the slack: the search stops after one tie."""
    for points in (np.zeros((40_000, 3)), 3e-5 * np.random.default_rng(18).random((40_000, 3))):
        matches, tied = Index(points).query_index_with_ties(Index(points.copy()), 1e-8)
        assert tied.all()
        assert not matches.distances.any()


def test_planes_of_many_equal_points_are_fast():
    """In quadratic time, this would take many seconds."""
    points = np.full((20_000, 3), 7.0)
    planes = Index(points).local_planes(20)
    np.testing.assert_array_equal(planes.nearest_other.distances, 0)
    np.testing.assert_array_equal(planes.nearest_other.indices, np.where(np.arange(len(points)) == 0, 1, 0))


def test_every_point_but_the_match_counts_as_a_tie():
    points = grid_points(np.random.default_rng(17), 300)
    index = Index(points)
    duplicated = index.nearest_other().distances == 0
    assert 0 < duplicated.sum() < 300
    np.testing.assert_array_equal(index.query_index_with_ties(Index(points), 1e-8)[1], duplicated)
    assert not Index(np.zeros((1, 3))).query_index_with_ties(Index(np.ones((2, 3))), 1.0)[1].any()


@pytest.mark.parametrize("fraction", [0.0, 0.03, 0.3, 10.0])
def test_radius_search_equals_brute_force(shape, fraction):
    rng = np.random.default_rng(7)
    points = shape(rng, 400)
    queries = near_and_far_queries(rng, points, 40)
    radius = fraction * (np.ptp(points, axis=0).max() or 1.0)
    inside = squared_distances(queries, points) <= radius * radius
    neighborhoods = Index(points).query_radius(queries, radius)
    np.testing.assert_array_equal(neighborhoods.counts, inside.sum(axis=1))
    np.testing.assert_array_equal(neighborhoods.indices, np.nonzero(inside)[1])
    np.testing.assert_array_equal(neighborhoods.indices[slice(*neighborhoods.offsets[3:5])], np.nonzero(inside[3])[0])


def test_counts_within_distances_equal_brute_force(shape):
    rng = np.random.default_rng(9)
    points = shape(rng, 400)
    queries = near_and_far_queries(rng, points, 300)
    distances = np.sqrt(squared_distances(queries, points))
    limits = np.sort(distances, axis=1)[:, [0, 7, 40]]  # exactly at a point
    limits[::5] *= rng.uniform(0, 2, limits[::5].shape)
    expected = (distances[:, None] <= limits[:, :, None]).sum(axis=2)
    np.testing.assert_array_equal(Index(points).count_near(Index(queries), limits), expected)


@pytest.mark.parametrize("radius, half_length", [(0.0, 0.2), (0.02, 0.5), (0.2, 0.01), (0.3, 0.0), (2.0, 2.0)])
def test_cylinder_search_equals_brute_force(shape, radius, half_length):
    rng = np.random.default_rng(8)
    points = shape(rng, 600)
    extent = np.ptp(points, axis=0).max() or 1.0
    radius, half_length = radius * extent, half_length * extent
    origins = near_and_far_queries(rng, points, 40)
    axes = rng.normal(size=origins.shape)
    axes[::7] = [0, 0, 1]
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    dx, dy, dz = (points[None, :, a] - origins[:, None, a] for a in range(3))
    ax, ay, az = (axes[:, None, a] for a in range(3))
    along = (dx * ax + dy * ay) + dz * az
    ex, ey, ez = dx - along * ax, dy - along * ay, dz - along * az
    inside = (np.abs(along) <= half_length) & ((ex * ex + ey * ey) + ez * ez <= radius * radius)
    neighborhoods = Index(points).query_cylinder(origins, axes, radius, half_length)
    np.testing.assert_array_equal(neighborhoods.counts, inside.sum(axis=1))
    np.testing.assert_array_equal(neighborhoods.indices, np.nonzero(inside)[1])


def neighborhood_eigenvectors(points, k):
    """Ascending eigenvalues (N, 3) and eigenvectors of the covariance of each point's k nearest points, from LAPACK."""
    offsets = points[brute_force_nearest(points, points, k)[1]] - points[:, None]
    offsets -= offsets.mean(axis=1, keepdims=True)
    return np.linalg.eigh(np.einsum("nki,nkj->nij", offsets, offsets))


@pytest.mark.parametrize("k", [3, 8, 20, 150])
def test_local_planes_equal_lapack(shape, k):
    points = shape(np.random.default_rng(k), 600)
    fits = Index(points).local_planes(k)
    values, vectors = neighborhood_eigenvectors(points, k)
    total = values.sum(axis=1)
    variation = np.where(total > 0, np.maximum(values[:, 0], 0) / np.where(total > 0, total, 1), 0)
    # Sums of up to 150 products, each rounded at 1e-16 of the spread of the points.
    np.testing.assert_allclose(fits.variation, variation, rtol=0, atol=3e-14)
    np.testing.assert_allclose(np.linalg.norm(fits.normals, axis=1), 1, atol=1e-15)
    separated = values[:, 1] - values[:, 0] > 1e-3 * values[:, 2]
    sine = np.linalg.norm(np.cross(fits.normals, vectors[:, :, 0]), axis=1)
    assert sine[separated].max(initial=0) < 1e-9
    for got, expected in zip(fits.nearest_other, Index(points).nearest_other(), strict=True):
        np.testing.assert_array_equal(got, expected)
    np.testing.assert_array_equal(fits.reach, brute_force_nearest(points, points, k)[0][:, -1])


@pytest.mark.parametrize("noise", [0.0, 1e-12, 1e-9, 1e-6])
def test_normals_of_nearly_flat_neighborhoods_are_accurate(noise):
    rng = np.random.default_rng(13)
    points = oblique_plane(rng, 2000) + rng.normal(0, noise, (2000, 3)) + np.array([5e5, 4.8e6, 100.0]) * (noise > 1e-9)
    values, vectors = neighborhood_eigenvectors(points, 12)
    sine = np.linalg.norm(np.cross(Index(points).local_planes(12).normals, vectors[:, :, 0]), axis=1)
    assert sine[values[:, 1] > 1e-3 * values[:, 2]].max() < 1e-9


@pytest.mark.parametrize("k, count", [(3, 1), (9, 250), (9, 900), (40, 60), (300, 17)])
def test_local_planes_of_selected_rows_are_bit_identical(shape, k, count):
    rng = np.random.default_rng(14)
    index = Index(shape(rng, 900))
    all_planes = index.local_planes(k)
    for rows in (rng.integers(0, 900, count), rng.permutation(900)[:count], np.arange(900)[::-1][:count]):
        planes = index.local_planes(k, rows)
        for got, expected in zip((*planes[:2], *planes[2]), (*all_planes[:2], *all_planes[2]), strict=True):
            np.testing.assert_array_equal(got, expected[rows])
    assert index.local_planes(k, np.empty(0, np.int64)).normals.shape == (0, 3)


def test_empty_queries_give_empty_results():
    index, no_points = Index(np.zeros((3, 3))), np.empty((0, 3))
    assert index.query(no_points).distances.shape == (0,)
    assert index.query(no_points, 2).indices.shape == (0, 2)
    assert index.query_radius(no_points, 1.0).counts.shape == (0,)
    assert index.query_cylinder(no_points, no_points, 1.0, 1.0).offsets.tolist() == [0]


def test_points_are_not_copied_and_read_only():
    points = uniform_points(np.random.default_rng(9), 10)
    index = Index(points)
    assert np.shares_memory(index.points, points) and not index.points.flags.writeable and points.flags.writeable
    assert Index(points.astype(np.float32)).points.dtype == np.float64
    assert len(Index(points[::2])) == 5


def test_memory_is_at_most_40_bytes_per_point():
    assert Index(uniform_points(np.random.default_rng(10), 500_000)).nbytes <= 40 * 500_000


def query_with_hint(hint):
    return Index(np.zeros((3, 3))).nearest_of_moved(Index(np.zeros((1, 3))), np.eye(4), hint)


@pytest.mark.parametrize(
    "make",
    [
        lambda: Index(np.empty((0, 3))),
        lambda: Index(np.zeros((4, 2))),
        lambda: Index([["a", "b", "c"]]),
        lambda: Index([[0, 0, 0], [0, np.nan, 0]]),
        lambda: Index([[0, 0, -1e101]]),
        lambda: Index(np.zeros((3, 3))).query([[np.inf, 0, 0]]),
        lambda: Index(np.zeros((3, 3))).query([0, 0, 0]),
        lambda: Index(np.zeros((3, 3))).query(np.zeros((1, 3)), 4),
        lambda: Index(np.zeros((3, 3))).query(np.zeros((1, 3)), 0),
        lambda: query_with_hint([3]),
        lambda: query_with_hint([0, 1]),
        lambda: Index(np.zeros((3, 3))).query(np.zeros((1, 3)), hint=[3]),
        lambda: Index(np.zeros((3, 3))).query(np.zeros((1, 3)), hint=[0, 1]),
        lambda: Index(np.zeros((3, 3))).query_radius(np.zeros((1, 3)), -1.0),
        lambda: Index(np.zeros((3, 3))).query_radius(np.zeros((1, 3)), np.nan),
        lambda: Index(np.eye(3)).count_near(Index(np.eye(3)), np.ones((2, 1))),
        lambda: Index(np.eye(3)).count_near(Index(np.eye(3)), np.ones((3, 9))),
        lambda: Index(np.eye(3)).count_near(Index(np.eye(3)), np.full((3, 1), np.nan)),
        lambda: Index(np.eye(3)).count_near(Index(np.eye(3)), np.full((3, 1), -1.0)),
        lambda: Index(np.zeros((3, 3))).query_cylinder([[0, 0, 0]], [[0, 0, 2]], 1, 1),
        lambda: Index(np.zeros((3, 3))).query_cylinder([[0, 0, 0]], np.eye(3), 1, 1),
        lambda: Index(np.eye(3)).query_index_with_ties(Index(np.eye(3)), -1.0),
        lambda: Index(np.zeros((3, 3))).local_planes(4),
        lambda: Index(np.zeros((3, 3))).local_planes(3, [-1]),
        lambda: Index(np.zeros((3, 3))).local_planes(3, [0.5]),
        lambda: Index(np.zeros((1, 3))).nearest_other(),
    ],
)
def test_invalid_arguments_are_refused(make):
    with check_error():
        make()


def test_nearest_of_moved_equals_a_query_with_moved_points(shape):
    rng = np.random.default_rng(31)
    index, queries = Index(shape(rng, 700)), shape(rng, 333)
    rotation, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    motion = np.hstack([1.3 * rotation, rng.normal(size=(3, 1)) * np.ptp(queries)])
    source = Index(queries)
    for hint in (None, rng.integers(0, 700, 333)):
        moved, matches = index.nearest_of_moved(source, motion, hint)
        scale = np.abs(queries).max() + np.abs(motion).max()
        np.testing.assert_allclose(moved, queries @ motion[:, :3].T + motion[:, 3], rtol=0, atol=1e-14 * scale)
        for column, expected in zip(matches, index.query(moved), strict=True):
            np.testing.assert_array_equal(column, expected)
    with check_error():
        index.nearest_of_moved(source, np.hstack([rotation, np.full((3, 1), 1e200)]))


def test_followed_queries_have_the_nearest_points_after_any_steps(shape):
    rng = np.random.default_rng(33)
    index, source = Index(shape(rng, 700)), Index(shape(rng, 333))
    followed, motion = index.follow(source), np.eye(4)
    for size in (0, 1e-1, 1e-2, 1e-3, 1e-4, 0, 1e-1, 1e-12):
        motion[:3, 3] += size * rng.normal(size=3) * np.ptp(source.points, axis=0).max()
        moved, matches = followed.nearest(motion)
        expected, expected_matches = index.nearest_of_moved(source, motion)
        np.testing.assert_array_equal(moved, expected)
        assert_matches(matches, expected_matches)
    alone = Index(np.zeros((1, 3))).follow(source)
    for _ in range(3):
        assert not alone.nearest(motion)[1].indices.any()
    with check_error():
        followed.nearest(np.full((3, 4), 1e200))


@pytest.mark.parametrize(("k", "share"), [(1, 0.5), (21, 0.3), (21, 0.05), (21, 0.999), (600, 0.4)])
def test_neighbors_in_a_share_are_those_of_a_thinned_index(shape, k, share):
    points = shape(np.random.default_rng(34), 700)
    thinned = Index(points).thinned(share, 3)
    expected = thinned.query(points[:50], min(k, len(thinned))).indices.reshape(50, -1)
    found = Index(points).neighbors_in_share(points[:50], k, share, 3)
    np.testing.assert_array_equal(found, thinned.points[expected])


def test_import_does_not_load_scipy():
    script = "import sys, pcbench.geometry.neighbors; print('scipy' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", script], capture_output=True, text=True).stdout == "False\n"


def test_spacing_ignores_duplicates():
    rng = np.random.default_rng(4)
    points = rng.random((3000, 3))
    index = Index(points)
    nearest = oracles.leave_one_out(points)
    assert median_spacing(index) == median_spacing(index, index.nearest_other()) == np.median(nearest)
    # Every third point is duplicated, or all points occur seven times: positions and distances are the same.
    partly_doubled = Index(np.concatenate([points, points[::3]]))
    expected = np.median(np.concatenate([nearest, nearest[::3]]))
    assert median_spacing(partly_doubled) == median_spacing(partly_doubled, partly_doubled.nearest_other()) == expected
    copies = Index(np.repeat(points, 7, axis=0))
    assert median_spacing(copies) == median_spacing(copies, copies.nearest_other()) == np.median(nearest)
    for coincident in (points[:1], np.zeros((5, 3))):
        coincident_index = Index(coincident)
        assert median_spacing(coincident_index) == 0
    assert median_spacing(coincident_index, coincident_index.nearest_other()) == 0


def test_sampled_spacing_agrees_with_that_of_all_points():
    index = Index(np.random.default_rng(5).random((100_000, 3)))
    # Median of 20,000 distances with a relative spread of 0.4: three standard errors of 0.4 * 1.25 / sqrt(20,000).
    assert median_spacing(index) == pytest.approx(median_spacing(index, index.nearest_other()), rel=0.012)


def test_a_pickled_index_finds_the_same_points():
    points = np.random.default_rng(0).random((500, 3))
    index = Index(points[:400])
    copy = pickle.loads(pickle.dumps(index))
    found, again = (each.query(points) for each in (index, copy))
    np.testing.assert_array_equal(found.indices, again.indices)
    np.testing.assert_array_equal(found.distances, again.distances)
