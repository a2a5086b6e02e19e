"""Smoothing of clouds with known errors: flat surface improves, edges and thin structures stay."""

from dataclasses import replace

import numpy as np
import pytest

from pcbench.geometry.cloud import Cloud
from reconstructors.mvs.confidence import CONFIDENCE, SCORE, point_confidences
from reconstructors.mvs.flatten import NEIGHBORS, flatten

SPACING = 0.1
NOISE = 0.01


def make_grid(rng, side=40):
    """Return points of a jittered square grid in the plane z = 0."""
    points = np.stack(np.meshgrid(np.arange(side), np.arange(side)), axis=-1).reshape(-1, 2) * SPACING
    return np.column_stack([points + rng.uniform(-0.3, 0.3, points.shape) * SPACING, np.zeros(len(points))])


def make_cloud(points, normals, rng, noise=NOISE):
    """Return a cloud with noise along its normals, and normals with errors of some degrees."""
    normals = np.broadcast_to(np.asarray(normals, float), points.shape)
    noisy_normals = normals + rng.normal(0, 0.1, points.shape)
    noisy_normals /= np.linalg.norm(noisy_normals, axis=1, keepdims=True)
    return Cloud(
        points + noise * rng.normal(size=(len(points), 1)) * normals,
        noisy_normals,
        np.zeros(points.shape, np.uint8),
        {"views": np.arange(len(points)), SCORE: np.full(len(points), 0.5, np.float32)},
    )


@pytest.mark.parametrize("origin", [0.0, 1e4])
def test_noise_and_errors_of_normals_shrink_on_flat_surface(origin):
    rng = np.random.default_rng(0)
    normal = np.array([0.6, 0.0, 0.8])
    frame = np.array([[0.8, 0.0, -0.6], [0.0, 1.0, 0.0], normal])
    cloud = make_cloud(make_grid(rng) @ frame + origin, normal, rng)
    flat = flatten(cloud)
    error, before = (((c.points - origin) @ normal).std() for c in (flat, cloud))
    assert before == pytest.approx(NOISE, rel=0.05)
    # The median of 20 independent errors has 1.25 / sqrt(20) = 0.28 times their deviation.
    assert error < 0.4 * before
    assert np.median(flat.normals @ normal) > 1 - 0.1 * (1 - np.median(cloud.normals @ normal))
    # Points move along the normal only, so the border does not shrink.
    shift = flat.points - cloud.points
    across = shift - (shift @ normal)[:, None] * normal
    assert np.linalg.norm(across, axis=1).max() < 0.3 * NOISE
    np.testing.assert_array_equal(flat.attributes["views"], cloud.attributes["views"])
    np.testing.assert_array_equal(flat.colors, cloud.colors)


def test_edges_stay():
    """A roof's ridge of 90 degrees keeps its height, and the ends of both sides theirs."""
    rng = np.random.default_rng(1)
    slope = make_grid(rng)
    left = slope @ np.array([[1.0, 0, -1], [0, np.sqrt(2), 0], [0, 0, 0]]) / np.sqrt(2)
    right = left * [-1, 1, 1]
    points = np.concatenate([left, right])
    normals = np.repeat([[1.0, 0, 1], [-1.0, 0, 1]], len(left), axis=0) / np.sqrt(2)
    cloud = make_cloud(points, normals, rng, noise=0.0)
    error = np.abs(_dot(flatten(cloud).points - points, normals))
    assert np.quantile(error, 0.99) < 0.05 * SPACING
    assert error.max() < 0.2 * SPACING


@pytest.mark.parametrize("thickness", [0.5, 1.0, 3.0])
def test_thin_walls_keep_their_thickness(thickness):
    rng = np.random.default_rng(2)
    front, back = make_grid(rng), make_grid(rng) + [0, 0, -thickness * SPACING]
    normals = np.repeat([[0.0, 0, 1], [0, 0, -1.0]], len(front), axis=0)
    cloud = make_cloud(np.concatenate([front, back]), normals, rng, noise=0.1 * NOISE)
    z = flatten(cloud).points[:, 2]
    assert z[: len(front)].mean() - z[len(front) :].mean() == pytest.approx(thickness * SPACING, rel=0.01)
    assert np.abs(z[: len(front)]).max() < 0.2 * SPACING


@pytest.mark.parametrize("height", [1.5, 2.0, 4.0])
def test_narrow_ledges_keep_their_height(height):
    """A bar of two rows of points above the ground, whose normals equal those of the ground."""
    rng = np.random.default_rng(3)
    points = make_grid(rng)
    on_bar = np.abs(points[:, 0] - 20 * SPACING) < SPACING
    points[on_bar, 2] = height * SPACING
    flat = flatten(make_cloud(points, [0, 0, 1], rng))
    error = np.abs(flat.points[:, 2] - points[:, 2])
    assert np.median(error[on_bar]) < 1.2 * NOISE
    assert np.median(error[~on_bar]) < 0.5 * NOISE


def test_points_of_small_clouds_stay():
    rng = np.random.default_rng(4)
    cloud = make_cloud(make_grid(rng, side=4), [0, 0, 1], rng)
    flat = flatten(cloud)
    np.testing.assert_array_equal(flat.points, cloud.points)
    np.testing.assert_array_equal(flat.normals, cloud.normals)
    np.testing.assert_array_equal(flat.attributes[CONFIDENCE], point_confidences(np.array([0.5]), np.array([0.5]))[0])


def test_confidences_follow_from_the_scores_of_the_nearest_points():
    """Two grids that are far apart: the points of one are likely right, but for one of them, the others are not."""
    rng = np.random.default_rng(6)
    grid = make_grid(rng, side=10)
    cloud = make_cloud(np.concatenate([grid, grid + [100.0, 0, 0]]), [0, 0, 1], rng)
    scores = np.repeat([0.9, 0.2], len(grid)).astype(np.float32)
    scores[44] = 0.1
    scored = replace(cloud, attributes={SCORE: scores})
    confidence = flatten(scored).attributes[CONFIDENCE]
    near = (0.1 + (NEIGHBORS - 1) * 0.9) / NEIGHBORS
    assert confidence[44] == point_confidences(np.array([0.1]), np.array([near]))[0]
    assert confidence[0] == point_confidences(np.array([0.9]), np.array([0.9]))[0]
    assert confidence[44] < confidence[0]
    assert (confidence[len(grid) :] == confidence[-1]).all() and confidence[-1] < confidence[44]
    # Points of other clouds have no scores, so that only the points of the cloud itself count.
    left, right = np.split(np.arange(len(scores)), 2)
    part = flatten(scored.select(left), [scored.select(right)])
    np.testing.assert_array_equal(part.attributes[CONFIDENCE], confidence[left])
    two = flatten(scored.select(np.array([44, 0])), [scored.select(np.delete(left, [0, 44]))])  # far from each other
    expected = np.array([0.1, 0.9])
    np.testing.assert_array_equal(two.attributes[CONFIDENCE], point_confidences(expected, expected))


def _dot(a, b):
    return np.einsum("ni,ni->n", a, b)


def test_parts_with_their_surroundings_are_smoothed_as_the_whole():
    rng = np.random.default_rng(5)
    cloud = make_cloud(make_grid(rng), [0, 0, 1], rng)
    whole, left = flatten(cloud), cloud.points[:, 0] < 2
    around = [cloud.select(~left & (cloud.points[:, 1] < 2)), cloud.select(~left & (cloud.points[:, 1] >= 2))]
    part = flatten(cloud.select(left), around)
    np.testing.assert_allclose(part.points, whole.points[left], rtol=0, atol=1e-15)
    np.testing.assert_allclose(part.normals, whole.normals[left], rtol=0, atol=1e-15)
    assert not np.array_equal(flatten(cloud.select(left)).points, part.points)
    # A part with fewer points than a plane needs is smoothed too, if its surroundings have enough.
    few = cloud.select(np.arange(5))
    assert (flatten(few).points == few.points).all()
    assert not (flatten(few, [cloud.select(np.arange(5, len(cloud)))]).points == few.points).all()
