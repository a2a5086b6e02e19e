"""Alignment to cameras and positions."""

import numpy as np
import pytest

from pcbench.geometry.cameras import Camera, Intrinsics, look_at
from pcbench.geometry.transform import Similarity, robust_similarity
from reconstructors.sfm.alignment import camera_errors, transform_camera

K = Intrinsics(40, 30, 35, 35, 20, 15)


def test_outlying_positions_have_little_influence():
    rng = np.random.default_rng(0)
    candidate = rng.normal(size=(20, 3))
    truth = Similarity(look_at([1, 2, 3], [0, 0, 0]).rotation, np.array([10, 20, 30.0]), 7.0)
    reference = truth.apply(candidate)
    estimate = robust_similarity(candidate, reference)
    np.testing.assert_allclose(estimate.matrix, truth.matrix, atol=1e-9)
    reference += rng.normal(scale=0.01, size=reference.shape)
    reference[:3] += [50, 0, 0]
    estimate = robust_similarity(candidate, reference)
    # 20 positions with 1 cm noise, and three outliers of 50 units, which contribute only linearly.
    assert np.abs(estimate.apply(candidate) - truth.apply(candidate)).max() < 0.1


def test_a_transformed_camera_has_the_same_projections():
    camera = Camera("a", K, look_at([3, 2, 1], [0, 0, 0]))
    transform = Similarity(look_at([1, 2, 3], [0, 0, 0]).rotation, np.array([10, 20, 30.0]), 7.0)
    points = np.random.default_rng(0).normal(size=(10, 3)) * 0.3
    pixels, depths = camera.project(points)
    new_pixels, new_depths = transform_camera(camera, transform).project(transform.apply(points))
    np.testing.assert_allclose(new_pixels, pixels, atol=1e-9)
    np.testing.assert_allclose(new_depths, 7 * depths)


def test_camera_errors_are_distances_and_angles():
    a = Camera("a", K, look_at([3, 2, 1], [0, 0, 0]))
    rotation = Similarity(
        np.array([[1, 0, 0], [0, np.cos(0.01), -np.sin(0.01)], [0, np.sin(0.01), np.cos(0.01)]]), np.zeros(3)
    )
    b = Camera("a", K, rotation @ a.cam_from_world)  # turned about its own centre
    positions, angles = camera_errors({"a": a, "b": a}, {"a": b, "c": b})
    assert positions == pytest.approx([0], abs=1e-12)
    assert angles == pytest.approx([np.degrees(0.01)])
    half_turn = Camera("a", K, Similarity(np.diag([-1.0, -1, 1]), np.zeros(3)) @ a.cam_from_world)
    assert camera_errors({"a": a}, {"a": half_turn})[1] == pytest.approx([180])
