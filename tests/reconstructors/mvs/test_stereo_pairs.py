"""The bundled matcher on two photographs: pairs with disparities from structured light, and the scores on them."""

import numpy as np
import pytest
from data_folder import data_folder
from stereo_cases import PAIRS, Pair, match_pair, point_errors, read_pair, score_pair
from textured_planes import plane_scene

MIN_WITHIN_TWO_PX = {"Art": 0.58, "Books": 0.72, "Laundry": 0.62}  # benchmarks/stereo_pairs.py: 0.597, 0.741, 0.644
MAX_WRONG = 0.13


@pytest.mark.slow
@pytest.mark.parametrize("name", PAIRS)
def test_disparities_of_real_photographs(name):
    pair = read_pair(data_folder("stereo") / name)
    score = score_pair(pair, match_pair(pair))
    assert score.two > MIN_WITHIN_TWO_PX[name]
    assert score.wrong < MAX_WRONG


def test_scores_count_unknown_and_wrong_disparities():
    views = plane_scene().views
    truth = np.full((1, 5), 20.0)
    truth[0, 4] = 0  # unknown: not evaluated
    pair = Pair(views[0], views[1], truth, offset=0.0)
    score = score_pair(pair, np.array([[20.5, 21.5, 30.0, np.nan, 20.0]]))
    assert score == pytest.approx((0.75, 0.25, 0.5, 1 / 3))


def test_depths_become_disparities():
    views = plane_scene().views
    pair = Pair(views[0], views[1], np.zeros((1, 2)), offset=10.0)
    near, far = pair.depth_range
    np.testing.assert_allclose(pair.disparities(np.array([[near, far, 0.0]])), [[85.0, 5.0, np.nan]])


def test_errors_of_points_are_those_of_their_disparities():
    left, right = plane_scene().views[:2]
    height, width = left.gray.shape
    truth = np.full((height, width), 20.0)
    truth[:, width // 2 :] = 0  # unknown: not evaluated
    pair = Pair(left, right, truth, offset=10.0)
    k, depth = left.camera.intrinsics, np.array([pair.depth_range[0], pair.depth_range[1]])
    pixels = np.array([[10.5, 20.5], [width - 10.5, 20.5]])
    points = left.camera.cam_from_world.inverse().apply(k.directions(pixels) * depth[:, None])
    np.testing.assert_allclose(point_errors(pair, points), [85.0 - 20.0])
