"""The oracles, compared with results computed by hand and with the output of other tools."""

import json

import numpy as np
import oracles
import pytest
import shapes
from data_folder import data_folder


def read_floats(path):
    """Return the columns (N, k) of a binary little-endian PLY of floats; independent of pcbench's reader."""
    header, _, body = path.read_bytes().partition(b"end_header\n")
    return np.frombuffer(body, "<f4").reshape(-1, header.count(b"property float")).astype(np.float64)


@pytest.mark.long
@pytest.mark.parametrize("case", ["wave", "outliers"])
def test_mpeg_equals_the_printed_output(case):
    folder = data_folder("dmetric")
    expected = json.loads((folder / "expected.json").read_text())["cases"][case]
    a, b = read_floats(folder / f"{case}_a.ply"), read_floats(folder / f"{case}_b.ply")
    got = oracles.mpeg(a[:, :3], a[:, 3:], b[:, :3])
    assert got.keys() == expected.keys()
    for key, value in expected.items():
        # The tool prints nine digits and computes in float32 in places: its small maxima are accurate to 4e-7.
        assert got[key] == pytest.approx(value, rel=1e-8 if key.startswith("mse") and "point" in key else 1e-6), key


def test_mpeg_averages_over_ties():
    # The query in the middle has two nearest points: the squared plane distance is 0 to one and 1 to the other.
    a = np.array([[0.0, 0, 0], [10, 0, 0]])
    up, along = [0.0, 0, 1], [1.0, 0, 0]
    got = oracles.mpeg(np.array([[-1.0, 0, 0], [1, 0, 0], [1, 5, 0]]), np.array([up, along, up]), a[:1])
    assert got["mse2 (p2plane)"] == 0.5
    assert got["mse2 (p2point)"] == 1
    # That one point of B gets the mean of all three normals, not normalised: (1/3, 0, 2/3).
    assert got["mse1 (p2plane)"] == pytest.approx(1 / 9)


def test_mpeg_unmatched_points_get_the_normal_of_their_nearest():
    a, n = np.array([[0.0, 0, 0], [1, 0, 0]]), np.array([[0.0, 0, 1], [0, 1, 0]])
    b = np.array([[0.0, 0, 0.5], [0, 0, 3], [1, 0.5, 0]])
    # No point has the point at z = 3 as its nearest; its own nearest is (0, 0, 0): direction 2 measures 0.5, 3, 0.5.
    got = oracles.mpeg(a, n, b)
    assert got["mse2 (p2plane)"] == pytest.approx((0.25 + 9 + 0.25) / 3)
    assert got["h. (p2point)"] == 9


def test_neighbours_on_a_grid():
    grid = shapes.plane_grid(5)
    distances, indices = oracles.nearest(np.array([[0.1, 0.0, 0.0], [0.5, 0.0, 2.0]]), grid)
    assert indices.tolist() == [0, 0]  # the second lies between 0 and 1: the lower index
    assert distances == pytest.approx([0.1, np.sqrt(4.25)])
    distances, indices = oracles.k_nearest(grid[12:13], grid, 5)
    assert indices.tolist() == [[12, 7, 11, 13, 17]]
    assert distances.tolist() == [[0, 1, 1, 1, 1]]
    assert (oracles.leave_one_out(grid) == 1).all()
    assert oracles.leave_one_out(np.array([[0.0, 0, 0], [0, 0, 0], [3, 4, 0]])).tolist() == [0, 0, 5]


def test_chunk_size_does_not_change_results(monkeypatch):
    rng = np.random.default_rng(0)
    queries, points = rng.normal(size=(50, 3)), rng.normal(size=(40, 3))
    expected = oracles.k_nearest(queries, points, 4), oracles.nearest(queries, points), oracles.leave_one_out(points)
    monkeypatch.setattr(oracles, "_PAIRS_AT_ONCE", 130)
    chunked = oracles.k_nearest(queries, points, 4), oracles.nearest(queries, points), oracles.leave_one_out(points)
    for expected_array, array in zip(
        (*expected[0], *expected[1], expected[2]), (*chunked[0], *chunked[1], chunked[2]), strict=True
    ):
        assert (expected_array == array).all()


def test_metrics_of_two_shifted_grids():
    first, second = shapes.plane_grid(6), shapes.plane_grid(6, height=0.25)
    up = np.tile([0.0, 0.0, 1.0], (36, 1))
    assert oracles.d1(first, second) == oracles.d2(first, second, up) == 0.0625
    assert oracles.d2(first + np.array([0.1, 0, 0]), second, up) == 0.0625  # sliding along the plane does not count
    assert oracles.hausdorff(first, second) == 0.25
    assert oracles.hausdorff(first, second[:-1]) == pytest.approx(np.hypot(0.25, 1))
    assert oracles.chamfer_unsquared(first, second) == 0.5
    assert oracles.chamfer_squared(first, second) == 0.125
    assert oracles.chamfer_sum_of_squares(first, second) == 4.5
    assert oracles.fscore(first, second, 0.25) == (1, 1, 1)
    assert oracles.fscore(first, second, 0.24) == (0, 0, 0)
    assert oracles.fscore(first, np.vstack([second, second + 50]), 0.3) == (1, 0.5, pytest.approx(2 / 3))


def test_floors_of_a_grid():
    grid = shapes.plane_grid(7, spacing=0.5)
    candidate = grid[::2] + np.array([0.01, 0.02, 0.1])
    assert (oracles.floor_distances(candidate, grid) == 0.5).all()
    # The candidate has every second point of the grid: nearest ones are a diagonal apart.
    np.testing.assert_allclose(oracles.floor_distances(grid, candidate), np.sqrt(0.5))


def test_voxel_mean_weights_voxels_not_points():
    points = np.array([[0.1, 0, 0], [0.2, 0, 0], [0.3, 0, 0], [1.5, 0, 0], [-0.5, 0, 0]])
    assert oracles.voxel_mean([1.0, 2, 3, 10, 0], points, 1.0, np.zeros(3)) == pytest.approx((2 + 10 + 0) / 3)


def test_normals_of_a_sphere():
    points, outward = shapes.fibonacci_sphere(400)
    cosines = np.abs((oracles.normals(points, 10) * outward).sum(axis=1))
    # Ten neighbours reach up to 0.3 rad and are not symmetric: the error of the plane is a fraction of that.
    assert cosines.min() > np.cos(0.3 / 3)
    flat = oracles.normals(shapes.plane_samples(50), 6)
    np.testing.assert_array_equal(np.abs(flat), np.tile([0.0, 0.0, 1.0], (50, 1)))


# The synthetic shapes have the properties that they state


def test_terrain_normals_are_the_gradient():
    points, up = shapes.terrain(50, seed=3)
    step = 1e-6
    for axis, direction in enumerate(np.eye(2)):
        ahead, behind = points[:, :2] + step * direction, points[:, :2] - step * direction
        slope = (shapes.terrain_height(*ahead.T) - shapes.terrain_height(*behind.T)) / (2 * step)
        np.testing.assert_allclose(-up[:, axis] / up[:, 2], slope, atol=1e-8)


def test_city_points_lie_on_their_faces():
    points, up, face_rows = shapes.city(2000, seed=1)
    corners = np.array([face[0] for face in shapes.city_faces()])
    assert np.abs(((points - corners[face_rows]) * up).sum(axis=1)).max() < 1e-12
    for corner, first, second, normal in shapes.city_faces():
        assert normal @ first == normal @ second == 0
        assert (corner >= 0).all()
    noisy, _, _ = shapes.city(2000, noise=0.1, seed=1)
    assert ((noisy - corners[face_rows]) * up).sum(axis=1).std() == pytest.approx(0.1, rel=0.1)  # 1 sigma: 1.6 %


def test_spheres_have_their_radius():
    points, outward = shapes.sphere(100, radius=3, centre=(1, 2, 3), seed=4)
    np.testing.assert_allclose(points, [1, 2, 3] + 3 * outward, atol=1e-12)
    for _, directions in (shapes.sphere(50), shapes.fibonacci_sphere(50)):
        np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1, atol=1e-12)
    assert (shapes.plane_samples(10)[:, 2] == 0).all()
    np.testing.assert_allclose(shapes.rotation([0, 0, 2], 90) @ [1, 0, 0], [0, 1, 0], atol=1e-15)
