"""ICP: recovers known motions, with or without an initial pose, and reports failures."""

from types import SimpleNamespace

import numpy as np
import pytest
import shapes
from data_folder import data_folder
from registrations import codes, error, motion
from shapes import UTM_WHOLE as UTM
from wording import check_error

from pcbench import Similarity, read_cloud
from pcbench.errors import RegistrationError
from pcbench.registration import IcpSettings, icp, icp_stages, register
from pcbench.registration.result import NO_CONVERGENCE, OFF_SURFACE


# Bounds in metres: three times what was measured; other tools reach 0.5-4.5 mm on such pairs, point to point 4.5 mm.
@pytest.mark.parametrize(("method", "bound"), [("icp", 0.003), ("similarity", 0.003), ("icp-point", 0.03)])
def test_a_known_motion_is_recovered(scene, method, bound):
    reference, candidate = scene
    true_pose = motion()
    result = register(reference, true_pose.inverse().apply(candidate), method)
    assert error(result.T_reference_candidate, true_pose, candidate) < bound
    assert result.converged
    assert result.overlap > 0.95
    assert result.weakest_sigma < 0.01
    assert not result.warnings


def test_scale_is_recovered_only_by_similarity(scene):
    reference, candidate = scene
    true_pose = motion(scale=1.02)
    moved = true_pose.inverse().apply(candidate)
    assert error(register(reference, moved, "similarity").T_reference_candidate, true_pose, candidate) < 0.003
    assert register(reference, moved, "icp").T_reference_candidate.scale == 1.0


def test_exact_copies_are_recovered_exactly(scene):
    reference, _ = scene
    true_pose = motion()
    result = register(reference, true_pose.inverse().apply(reference[::7]))
    assert error(result.T_reference_candidate, true_pose, reference[::7]) < 1e-6


def test_outliers_and_partial_overlap_do_not_change_the_pose(scene):
    reference, candidate = scene
    true_pose, rng = motion(), np.random.default_rng(5)
    outliers = rng.uniform([-75, -75, 0], [75, 75, 60], (8000, 3))
    result = register(reference, true_pose.inverse().apply(np.concatenate([candidate, outliers])))
    assert error(result.T_reference_candidate, true_pose, candidate) < 0.003
    west, east = reference[reference[:, 0] < 15], candidate[candidate[:, 0] > -15]
    result = register(west, true_pose.inverse().apply(east))
    assert error(result.T_reference_candidate, true_pose, east) < 0.012
    assert 0.2 < result.overlap < 0.6


@pytest.mark.slow
def test_large_rotations_are_found_or_doubtful(scene):
    reference, candidate = scene
    for shift in (-20,):  # metres: half a block
        true_pose = Similarity(np.eye(3), np.array([shift, 5.0, 0]), 1.0)
        result = register(reference, true_pose.inverse().apply(candidate))
        assert error(result.T_reference_candidate, true_pose, candidate) < 0.003
    for angle in (20, -30):
        true_pose = Similarity(shapes.rotation([0, 0, 1], angle), np.array([1.2, -1.6, 0]), 1.0)
        result = register(reference, true_pose.inverse().apply(candidate))
        assert error(result.T_reference_candidate, true_pose, candidate) < 0.003
        assert not result.warnings
    for angle in (60, 180):
        true_pose = Similarity(shapes.rotation([0, 0, 1], angle), np.zeros(3), 1.0)
        result = register(reference, true_pose.inverse().apply(candidate))
        assert error(result.T_reference_candidate, true_pose, candidate) > 1
        assert OFF_SURFACE in codes(result)


def test_far_coordinates_change_nothing(scene):
    reference, candidate = (np.round(c * 2**20) / 2**20 for c in scene)
    candidate = candidate + [0.5, -0.25, 0.125]
    near, far = register(reference, candidate), register(reference + UTM, candidate + UTM)
    np.testing.assert_array_equal(near.T_local.matrix, far.T_local.matrix)
    assert (near.rmse, near.overlap, near.weakest_sigma) == (far.rmse, far.overlap, far.weakest_sigma)
    moved = far.T_reference_candidate.apply(candidate + UTM) - UTM
    # 1e-8 m: a rotation of coordinates of 5e6 in float64.
    np.testing.assert_allclose(moved, near.T_reference_candidate.apply(candidate), atol=1e-8)


@pytest.mark.long
def test_a_real_lidar_pair_is_registered():
    folder = data_folder("small_gicp")
    reference, candidate = read_cloud(folder / "target.ply"), read_cloud(folder / "source.ply")
    result = register(reference, candidate)
    true_pose = Similarity.from_matrix(np.loadtxt(folder / "T_target_source.txt"))
    difference = result.T_reference_candidate.apply(candidate.points) - true_pose.apply(candidate.points)
    is_near = np.linalg.norm(candidate.points, axis=1) < 30
    # The file's transform is good to 2-8 cm itself.
    assert np.sqrt(np.mean(np.square(difference[is_near]).sum(axis=1))) < 0.1
    assert result.converged
    # Far from the scanner the gap between lines is 100 spacings, which is no misalignment. A real one is reported.
    assert OFF_SURFACE not in codes(result)
    # Different line positions do not make a pose doubtful; a scan in the opposite direction does.
    assert not result.doubtful
    assert register(candidate, reference).doubtful is False
    reversed_scan = candidate.transformed(Similarity(shapes.rotation([0, 0, 1], 180), np.zeros(3)))
    assert register(reference, reversed_scan).doubtful
    rotated = candidate.transformed(Similarity(shapes.rotation([0, 0, 1], 90), np.array([3.0, 2.0, 0.0])))
    assert OFF_SURFACE in codes(register(reference, rotated))


def test_copies_and_doubled_points_are_registered_exactly():
    rng = np.random.default_rng(8)
    x, y = (part.ravel() for part in np.meshgrid(np.arange(60.0), np.arange(60.0)))
    points = np.column_stack([x, y, 3 * np.sin(x / 5) + 3 * np.cos(y / 7)]) + rng.normal(0, 1e-3, (3600, 3))
    for reference in (points, np.concatenate([points, points])):
        result = register(reference, points + 0.05)
        assert result.rmse < 1e-9
        assert result.overlap == 1.0
        assert result.warnings == ()
    assert register(1e-160 * points, 1e-160 * points, "none").warnings
    with check_error(RegistrationError):
        register(1e-160 * points, 1e-160 * points)


def test_icp_starts_from_the_initial_pose(scene):
    """ICP fails from 60 degrees away, as tested above, but recovers the pose from 5 degrees away."""
    reference, candidate = scene
    true_pose = Similarity(shapes.rotation([0, 0, 1], 60), np.array([100.0, -50.0, 5.0]))
    initial = motion(5.0, (1.5, -1.0, 0.5)) @ true_pose
    for pose in (initial, initial.matrix, initial.matrix.tolist()):
        result = register(reference, true_pose.inverse().apply(candidate), initial=pose)
        assert error(result.T_reference_candidate, true_pose, candidate) < 0.003
        assert result.converged
        assert not result.warnings
        assert result.T_reference_candidate.scale == 1.0


def test_an_initial_pose_may_come_from_far_coordinates(scene):
    reference, candidate = scene
    true_pose = motion(60.0) @ translation(-UTM)
    result = register(reference, true_pose.inverse().apply(candidate), initial=motion(4.0, (1.0, 0, 0)) @ true_pose)
    assert error(result.T_reference_candidate, true_pose, candidate) < 0.003


def translation(shift):
    return Similarity(np.eye(3), np.asarray(shift, dtype=float))


def test_the_scale_of_an_initial_pose_stays_or_is_refined(scene):
    reference, candidate = scene
    true_pose = motion(scale=40.0)  # as in an arbitrary gauge: ICP fails without an initial scale
    moved = true_pose.inverse().apply(candidate)
    initial = motion(4.0, (1.0, 0.5, 0.0), scale=40.4)
    refined = register(reference, moved, "similarity", initial=initial)
    assert error(refined.T_reference_candidate, true_pose, candidate) < 0.003
    assert refined.solved_scale
    rigid = register(reference, moved, initial=initial)
    assert rigid.T_reference_candidate.scale == pytest.approx(40.4, rel=1e-12)
    assert not rigid.solved_scale


def test_settings_affect_icp(scene):
    reference, candidate = scene
    true_pose = motion()
    moved = true_pose.inverse().apply(candidate)
    stopped = register(reference, moved, IcpSettings(max_iterations=2))
    assert (stopped.iterations, stopped.converged) == (4, False)
    assert NO_CONVERGENCE in codes(stopped)
    coarse = register(reference, moved, IcpSettings(max_sample=1000))
    # A thirtieth of the points: five times the noise of the mean, and some.
    assert error(coarse.T_reference_candidate, true_pose, candidate) < 0.02
    assert coarse.T_local.matrix.tolist() != register(reference, moved).T_local.matrix.tolist()
    distant = register(reference, candidate + [0, 0, 30.0], IcpSettings(max_correspondence_distance=40.0))
    assert error(distant.T_reference_candidate, translation([0, 0, -30.0]), candidate) < 0.003
    with check_error(RegistrationError):
        register(reference, candidate + [0, 0, 100.0], IcpSettings(max_correspondence_distance=0.5))


@pytest.mark.parametrize(
    "settings",
    [
        {"residuals": "line"},
        {"with_scale": "yes"},
        {"residuals": "point", "with_scale": True},
        {"max_correspondence_distance": 0},
        {"max_correspondence_distance": float("nan")},
        {"max_correspondence_distance": "1"},
        {"max_iterations": 0},
        {"max_iterations": 2.5},
        {"max_sample": True},
    ],
)
def test_invalid_settings_are_refused(settings):
    with check_error():
        IcpSettings(**settings)


@pytest.mark.parametrize("rank", range(1, 8))
def test_the_pseudo_inverse_is_that_of_numpy_to_the_last_bit(rank):
    rng = np.random.default_rng(rank)
    for _ in range(20):
        rows = rng.normal(size=(rank, 7))
        matrix = rows.T @ rows
        expected = np.linalg.pinv(matrix, rcond=1e-10, hermitian=True)
        np.testing.assert_array_equal(icp_stages._pseudo_inverse(matrix), expected)


@pytest.mark.parametrize(
    ("qualities", "best"),
    [
        ([(0.9, 0.4), (0.7, 0.3), (0.5, 0.4)], 0),
        ([(0.4, 0.3), (0.9, 0.3), (0.8, 0.4)], 1),
        ([(0.9, 0.5), (0.8, 0.0), (1.0, 0.0)], 1),  # no point off the surface: the third start is not needed
        ([None, (0.5, 0.4), None], 1),  # no overlap from the other starts
    ],
)
def test_the_start_with_the_largest_overlap_less_points_off_the_surface_is_kept(monkeypatch, qualities, best):
    def fit(_, start, free):
        if qualities[start] is None:
            raise RegistrationError("the candidate does not overlap the reference")
        overlap, off_surface = qualities[start]
        return SimpleNamespace(quality=SimpleNamespace(overlap=overlap, off_surface=off_surface))

    monkeypatch.setattr(icp, "_fit_and_assess", fit)
    problem = SimpleNamespace(settings=SimpleNamespace(with_scale=False))
    assert icp._best_start(problem, (0, 1, 2))[0] == best
