"""Confidence of depths, on exact maps of planes, and the points that it removes."""

import numpy as np
import pytest
from exact_maps import plane_map

from pcbench.geometry.cameras import Camera, Intrinsics, look_at
from pcbench.geometry.cloud import Cloud
from reconstructors.mvs.confidence import CONFIDENCE, depth_percents, keep_precise, point_confidences
from reconstructors.mvs.maps import DepthMap

K = Intrinsics(80, 60, 75.0, 75.0, 40.0, 30.0)
INNER = np.s_[15:45, 15:65]  # all neighbours of these pixels are in the image
SEED = 5


def camera_at(angle_deg):
    """Return a camera at a distance of 10 from the origin."""
    angle = np.radians(angle_deg)
    return Camera("", K, look_at([10 * np.sin(angle), 0, 10 * np.cos(angle)], [0, 0, 0]))


def percents(depth_map, angle_deg=20.0, gray=None):
    """Return the score of a map whose depths one source confirms, at a known angle at the image's centre."""
    shape = depth_map.depth.shape
    if gray is None:
        gray = np.random.default_rng(SEED).integers(0, 256, shape, dtype=np.uint8)
    agreement = np.broadcast_to(depth_map.known, (1, *shape))
    return depth_percents(camera_at(0), depth_map, agreement, [camera_at(angle_deg)], gray)


def plane(normal=(0, 0, 1)):
    return plane_map(camera_at(0), np.asarray(normal) / np.linalg.norm(normal), 0.0)


def with_depth(depth_map, depth):
    return DepthMap(depth.astype(np.float32), depth_map.normal, depth_map.confidence)


@pytest.mark.parametrize("normal", [(0, 0, 1), (0.5, -0.4, 1)])
def test_depths_on_a_plane_support_each_other(normal):
    confidence = percents(plane(normal))
    assert confidence[INNER].min() >= 99


def test_scattered_depths_have_the_score_of_their_cues():
    """Without any support and texture the log odds are -1.74 + (0.14 - 1.5 log(25 / 24)) log(sin 20 / sin 1)."""
    depth_map = plane()
    # In blocks of four pixels no neighbour has the depth of a pixel; a footprint is 1 / 75 of the depth.
    row, column = np.indices(depth_map.depth.shape) // 4 % 4
    scattered = with_depth(depth_map, depth_map.depth * (1 + 0.02 * ((row + 2) % 4 + 4 * ((column + 2) % 4))))
    confidence = percents(scattered, gray=np.full((60, 80), 100, np.uint8))
    # These pixels have the depth of the plane, and their angle is 20 degrees within a tenth.
    exact = confidence[24:28, 40:44]
    assert ((column[24:28, 40:44] == 2) & (row[24:28, 40:44] == 2)).all()
    np.testing.assert_allclose(exact, 18, atol=1)


def test_confidence_grows_with_support_angle_and_texture_at_the_pixel():
    depth_map = plane()
    rough = with_depth(depth_map, depth_map.depth * np.random.default_rng(SEED).normal(1, 0.02, (60, 80)))
    medians = [np.median(percents(rough, angle)[INNER]) for angle in (5, 8, 20, 60)]
    assert medians == sorted(medians) and medians[0] < medians[-1] - 10
    # The left half is plain up to a step at column 40.
    gray = np.full((60, 80), 80, np.uint8)
    gray[:, 40:] = 160
    beside, on_edge = percents(rough, gray=gray)[INNER][:, [22, 25]].mean(axis=0)
    assert beside < on_edge - 5


def test_narrow_angles_widen_the_tolerance():
    """Below five degrees, errors of the same size in the images have the same confidence."""
    depth_map = plane()
    noise = np.random.default_rng(SEED).normal(0, 1, (60, 80))
    narrow, wide = (
        percents(with_depth(depth_map, depth_map.depth * (1 + scale * noise)), angle).astype(int)
        for scale, angle in ((0.04, 1.25), (0.01, 5.0))
    )
    assert np.abs(narrow - wide)[INNER].mean() < 2


def test_pixels_without_a_depth_have_no_confidence():
    depth_map = plane()
    hole = np.zeros((60, 80), bool)
    hole[20:40, 30:50] = True
    confidence = percents(depth_map.where(~hole), 5.0, np.full((60, 80), 100, np.uint8))
    assert not confidence[hole].any() and confidence[~hole].all()
    assert confidence[30, 29] < confidence[30, 15]  # half of its neighbours are missing


def test_confidences_of_points_are_a_function_of_both_scores():
    """The log odds are 2.57 + 0.38 log(0.2 / 0.8) + 1.67 log(0.4 / 0.6)."""
    scores, around = np.array([0.2, 0.9, 0.2, 0.0, 1.0]), np.array([0.4, 0.4, 0.9, 0.0, 1.0])
    confidence = point_confidences(scores, around)
    assert confidence[0] == pytest.approx(1 / (1 + np.exp(-1.366)), abs=1e-3)
    assert confidence[3] < 0.001 < confidence[0] < confidence[1] < confidence[2] < confidence[4] <= 1


def cloud_of(confidences):
    points = np.arange(3.0 * len(confidences)).reshape(-1, 3)
    return Cloud(points, attributes={CONFIDENCE: np.array(confidences, np.float32)})


@pytest.mark.parametrize(
    ("precision", "kept"),
    [(0.0, 5), (0.6, 5), (0.73, 4), (0.85, 3), (0.95, 1), (1.0, 1)],
)
def test_the_least_confident_points_are_removed(precision, kept):
    confidences = [0.2, 1.0, 0.4, 0.8, 0.75]
    cloud = keep_precise(cloud_of(confidences), precision)
    expected = sorted(confidences, reverse=True)[:kept]
    assert sorted(cloud.attributes[CONFIDENCE].tolist(), reverse=True) == pytest.approx(expected, abs=1e-7)


def test_equally_confident_points_stay_together():
    assert len(keep_precise(cloud_of([1.0, 0.5, 0.5, 0.5]), 0.7)) == 4


def test_all_points_stay_if_none_is_confident_enough():
    assert len(keep_precise(cloud_of([0.55, 0.3]), 0.9)) == 2
