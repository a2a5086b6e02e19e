"""A pose turned by half in a nearly symmetric scene is doubtful, because the pose turned back fits better."""

import numpy as np
import pytest
from wording import check_text

from pcbench.geometry.cloud import Cloud
from pcbench.geometry.transform import Similarity
from pcbench.registration import Target, register
from pcbench.registration.result import DOUBTFUL_POSE
from pcbench.registration.turns import closest_turned_pose, symmetry_turns
from pcbench.studies.stress.cells import RunPlan, build_pair

HALF_TURN = np.diag([-1.0, -1.0, 1.0])


def room(ladder, level):
    return build_pair(RunPlan("registration", "room", ladder, level, None, "icp", 0, 24_000))


def box_with_peg(count, seed):
    """Return points on a box of 4 m by 3 m by 2 m, a tenth of them on a peg beside one end of its roof."""
    rng = np.random.default_rng(seed)
    size = np.array([4.0, 3.0, 2.0])
    points = rng.uniform(0, 1, (count, 3))
    side = rng.integers(0, 6, count)
    points[np.arange(count), side // 2] = side % 2
    points *= size
    peg = rng.random(count) < 0.1
    points[peg] = [3.4, 2.4, 2.0] + [0.3, 0.3, 1.0] * points[peg] / size
    return points


@pytest.mark.parametrize("method", ["icp", "icp-point", "similarity"])
def test_a_pose_turned_by_half_is_doubtful_although_its_contrast_is_high(method):
    pair = room("start-rotation", 180)
    found = register(pair.reference, pair.candidate, method)
    assert (found.T_reference_candidate @ pair.T_true.inverse()).motion_at(np.zeros(3)).angle_deg > 170
    assert found.contrast > 0.93
    assert found.doubtful
    (text,) = (notice.text for notice in found.warnings if notice.code == DOUBTFUL_POSE)
    assert "rotated by 180 degrees" in text
    check_text(text)


@pytest.mark.parametrize(("ladder", "level"), [("background", 40), ("overlap", 50), ("cutouts", 50)])
def test_a_right_pose_with_other_points_is_not_doubtful(ladder, level):
    pair = room(ladder, level)
    found = register(pair.reference, pair.candidate)
    offsets = found.T_reference_candidate.apply(pair.candidate) - pair.points
    assert np.sqrt(np.square(offsets).sum(axis=1).mean()) < pair.tolerance
    assert not found.doubtful


def test_the_pose_that_fits_better_is_found():
    target = Target.of(Cloud(box_with_peg(20_000, 0)), np.zeros(3))
    center = np.array([2.0, 1.5, 0.0])
    turned = Similarity(HALF_TURN, center - HALF_TURN @ center)
    found = closest_turned_pose(target, turned.apply(box_with_peg(10_000, 1)), Similarity.identity(), with_scale=False)
    assert found.angle_deg == pytest.approx(180, abs=1)
    assert found.distance_ratio < 0.9
    assert closest_turned_pose(target, box_with_peg(10_000, 1), Similarity.identity(), with_scale=False) is None


def test_turns_are_about_the_principal_axes():
    points = np.random.default_rng(0).normal(size=(1_000, 3)) * [5, 2, 1] + 10
    turns = symmetry_turns(points)
    center = points.mean(axis=0)
    assert len(turns) == 9
    assert all(np.allclose(turn.apply(center[None]), center) for turn in turns)
    assert sorted(round(turn.motion_at(np.zeros(3)).angle_deg) for turn in turns) == [90] * 6 + [180] * 3
