"""Registration of Tanks and Temples: known similarities, Open3D's ICP, files, and what is refused."""

import copy

import numpy as np
import pytest
import shapes
from optional import import_or_skip
from registrations import error
from trajectories import SCAN_FROM_CANDIDATE, circle, log_text, scene_folder
from wording import check_error, check_text

from pcbench import Box, Similarity
from pcbench.errors import RegistrationError
from pcbench.measure.settings import Settings
from pcbench.registration import TrajectorySettings, parse_method, register, trajectories
from pcbench.registration.trajectories import align_by_trajectory, align_trajectories, refine_pose
from pcbench.report.recorded import record, restore

VOLUME = (2.0, 2.0, -10.0, 38.0, 38.0, 10.0)
THRESHOLD = 0.1  # of terrain with 6000 points over 40 x 40


def clouds(count=6000):
    """Return a scan and a candidate of the terrain, in the scan's coordinates."""
    rng = np.random.default_rng(5)
    scan, other = shapes.terrain(count, seed=1)[0], shapes.terrain(count, seed=2)[0]
    return scan, other + rng.normal(0, 0.01, other.shape)


@pytest.fixture
def scene(tmp_path):
    """Files of a scene, and a candidate with its trajectory beside it."""
    scan, candidate = clouds()
    folder = scene_folder(tmp_path / "Hill", "Hill", scan, circle(), VOLUME)
    to_candidate = SCAN_FROM_CANDIDATE.inverse()
    centers = circle() + np.random.default_rng(0).normal(0, 0.03, (40, 3))
    (tmp_path / "mine.log").write_text(log_text(to_candidate.apply(centers), missing=[3]))
    return folder, scan, to_candidate.apply(candidate)


def test_camera_centres_with_outliers_determine_the_similarity():
    rng, centers = np.random.default_rng(3), circle(60)
    measured = centers + rng.normal(0, 0.01, centers.shape)
    measured[:20] += rng.uniform(-30, 30, (20, 3))
    candidate = SCAN_FROM_CANDIDATE.inverse().apply(measured)
    pose, inliers = align_trajectories(candidate, centers)
    assert inliers == 40
    assert error(pose, SCAN_FROM_CANDIDATE, centers) < 0.05  # that of six centres with errors of 0.01
    again, _ = align_trajectories(candidate, centers)
    np.testing.assert_array_equal(pose.matrix, again.matrix)
    other, _ = align_trajectories(candidate, centers, seed=1)
    assert not np.array_equal(pose.matrix, other.matrix)


def test_trajectories_that_do_not_agree_are_refused(monkeypatch):
    monkeypatch.setattr(trajectories, "_MAX_SAMPLES", 2000)  # a test of all samples takes seconds
    centers, rng = circle(60), np.random.default_rng(0)
    for others in (rng.permutation(centers), np.arange(180.0).reshape(60, 3)):
        with check_error(RegistrationError):
            align_trajectories(others, centers)


def test_refinement_equals_the_official_steps_in_open3d():
    o3d = import_or_skip("open3d")
    methods = o3d.pipelines.registration
    scan, candidate = clouds()
    start = Similarity(shapes.rotation([1, 2, 3], 0.5), np.array([0.1, -0.2, 0.1]), 1.004) @ SCAN_FROM_CANDIDATE
    candidate = SCAN_FROM_CANDIDATE.inverse().apply(candidate)
    x0, y0, z0, x1, y1, z1 = VOLUME
    box = o3d.geometry.AxisAlignedBoundingBox((x0, y0, z0), (x1, y1, z1))
    source, target = (o3d.geometry.PointCloud(o3d.utility.Vector3dVector(each)) for each in (candidate, scan))
    pose = start.matrix
    for voxel, distance in ((THRESHOLD, 80 * THRESHOLD), (THRESHOLD / 2, 20 * THRESHOLD), (None, 2 * THRESHOLD)):
        parts = [copy.deepcopy(source).transform(pose).crop(box), copy.deepcopy(target).crop(box)]
        parts = [part.voxel_down_sample(voxel) if voxel else part for part in parts]
        estimation, criteria = (
            methods.TransformationEstimationPointToPoint(True),
            methods.ICPConvergenceCriteria(1e-6, 20),
        )
        pose = methods.registration_icp(*parts, distance, np.eye(4), estimation, criteria).transformation @ pose
    ours = refine_pose(start, scan, candidate, THRESHOLD, Box(VOLUME[:3], VOLUME[3:]))
    # Both have the same correspondences, so that sums in another order are the only difference.
    np.testing.assert_allclose(ours.pose.matrix, pose, rtol=0, atol=1e-10)


def test_files_register_a_candidate_to_its_scan(scene, tmp_path):
    folder, scan, candidate = scene
    text = f"tnt:{tmp_path / 'mine.log'},{folder},{THRESHOLD}"
    result = register(scan, candidate, text)
    assert error(result.T_reference_candidate, SCAN_FROM_CANDIDATE, scan) < 0.05
    assert result.solved_scale
    assert result.converged is not None
    assert result.iterations > 0
    settings = parse_method(text)
    assert len(settings.candidate_centers) == 39
    assert settings.files == (tmp_path / "mine.log", folder)
    fit = align_by_trajectory(scan, candidate, settings)
    np.testing.assert_array_equal(fit.T_reference_candidate.matrix, result.T_reference_candidate.matrix)
    assert (fit.images, fit.inliers) == (39, 39)


def test_settings_repeat_the_registration(scene, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    settings = Settings(register=f"tnt:mine.log,Hill,{THRESHOLD}").with_files_read()
    absolute = f"tnt:{tmp_path / 'mine.log'},{tmp_path / 'Hill'},{THRESHOLD}"
    assert settings.register.text == record(settings)["register"] == absolute
    assert restore(record(settings)).register == absolute
    assert settings.files == [tmp_path / "mine.log", tmp_path / "Hill"]
    by_arrays = TrajectorySettings(circle(), circle(), 0.1, Box([0, 0, 0], [1, 1, 1]), seed=3)
    again = restore(record(Settings(register=by_arrays))).register
    np.testing.assert_array_equal(again.candidate_centers, circle())
    assert (again.threshold, again.seed, again.volume.text) == (0.1, 3, by_arrays.volume.text)


def test_images_are_paired_by_their_numbers_or_by_the_frames_of_a_video(scene, tmp_path, monkeypatch):
    monkeypatch.setattr(trajectories, "_VIDEO_LENGTH", 100)
    folder, _, _ = scene
    centers = SCAN_FROM_CANDIDATE.inverse().apply(circle())
    (tmp_path / "part.log").write_text(log_text(centers[10:30], first=10))
    by_number = parse_method(f"tnt:{tmp_path / 'part.log'},{folder},0.1")
    np.testing.assert_allclose(by_number.candidate_centers, centers[10:30])
    # 1e-9: the reference's centres pass through the coordinates of its reconstruction.
    np.testing.assert_allclose(by_number.reference_centers, circle()[10:30], atol=1e-9)
    frames = np.arange(40) * 4 + 7
    video = np.zeros((180, 3))
    video[frames - 1] = centers
    (tmp_path / "video.log").write_text(log_text(video))
    rows = "".join(f"{k} {frame}\n" for k, frame in enumerate(frames))
    (folder / "Hill_mapping_reference.txt").write_text(f"40\n180\n{rows}")
    by_frame = parse_method(f"tnt:{tmp_path / 'video.log'},{folder},0.1")
    np.testing.assert_allclose(by_frame.candidate_centers, centers)
    for content in ("", "40\n180\n1 2\n", "1\n5\n0 0\n", "1\n5\na b\n"):
        (folder / "Hill_mapping_reference.txt").write_text(content)
        with check_error():
            parse_method(f"tnt:{tmp_path / 'video.log'},{folder},0.1")


def test_methods_that_name_other_files_are_refused(scene, tmp_path):
    folder, _, _ = scene
    log = tmp_path / "mine.log"
    (tmp_path / "few.log").write_text(log_text(circle(4)))
    (tmp_path / "twice.log").write_text(log_text(circle(20)) + log_text(circle(10)))
    (tmp_path / "empty").mkdir()
    for text in (
        "tnt:", f"tnt:{log}", f"tnt:{log},{folder}", f"tnt:{log},{folder},x", f"tnt:{log},{folder},-1",
        f"tnt:{log},{tmp_path / 'empty'}", f"tnt:{tmp_path / 'few.log'},{folder},1", f"tnt:{tmp_path},{folder},1",
        f"tnt:{tmp_path / 'twice.log'},{folder},1",
    ):  # fmt: skip
        with check_error():
            parse_method(text)
    for name in ("Hill_trans.txt", "Hill_COLMAP_SfM.log"):
        (folder / name).unlink()
        with check_error():
            parse_method(f"tnt:{log},{folder},1")
    for arrays in ((circle(5), circle(5)), (circle(), circle(20)), (circle() * np.nan, circle())):
        with check_error():
            TrajectorySettings(*arrays, 0.1)


def test_candidates_far_from_the_scan_or_its_volume_are_refused(scene, tmp_path):
    folder, scan, candidate = scene
    settings = parse_method(f"tnt:{tmp_path / 'mine.log'},{folder},{THRESHOLD}")
    with check_error(RegistrationError):
        align_by_trajectory(scan, candidate + 1e3, settings)
    with check_error(RegistrationError):
        align_by_trajectory(scan + 1e3, candidate, settings)
    with check_error(RegistrationError):  # 80 thresholds reach no point
        refine_pose(SCAN_FROM_CANDIDATE, scan, candidate + 50, 1e-3, None)


def test_the_registration_is_described(scene, tmp_path):
    folder, scan, candidate = scene
    method = parse_method(f"tnt:{tmp_path / 'mine.log'},{folder},{THRESHOLD}")
    check_text(register(scan, candidate, method))


@pytest.mark.parametrize("share", [0.2, 0.5, 0.9])
def test_enough_samples_contain_one_of_inliers_only(share):
    count, miss = trajectories._samples_needed(share), 1 - share**trajectories._SAMPLE_SIZE
    assert miss**count <= 1 - trajectories._CONFIDENCE < miss ** (count - 1)
