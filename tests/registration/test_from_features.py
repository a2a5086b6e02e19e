"""Registration from any pose: it is found, and missing or ambiguous evidence is reported."""

import os
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest
import shapes
from data_folder import data_folder
from optional import break_library
from registrations import codes, error
from shapes import UTM_WHOLE as UTM
from wording import check_error

from pcbench import cli, read_cloud, write_cloud
from pcbench.errors import MissingExtra, RegistrationError
from pcbench.extras import import_problem
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.neighbors import Index
from pcbench.geometry.normals import Surface
from pcbench.geometry.transform import Similarity, read_matrix
from pcbench.registration import from_features, register
from pcbench.registration.correspondences import FeaturePairs, likely_poses
from pcbench.registration.icp_settings import IcpSettings
from pcbench.registration.result import AMBIGUOUS, UNOBSERVABLE
from pcbench.scenes.synthetic import city

needs_kiss = pytest.mark.skipif(bool(problem := import_problem("kiss_matcher")), reason=str(problem))


def sample_windows(seed, overlap, *, counts=(150_000, 60_000), other=None):
    """Sample two windows of a 400 m city along x with 2 cm noise; they overlap by the share `overlap`."""
    rng, width = np.random.default_rng(seed), 400 / (2 - overlap)
    town, second = city(seed), city(seed if other is None else other)
    reference, candidate = town.sample(counts[0], rng)[0], second.sample(counts[1], rng)[0]
    reference, candidate = reference[reference[:, 0] < width - 200], candidate[candidate[:, 0] > 200 - width]
    return (cloud + rng.normal(0, 0.02, cloud.shape) for cloud in (reference, candidate))


def random_pose(seed, scale=1.0):
    """Return a random rotation of 45 to 180 degrees with a shift of up to 100 m per axis."""
    rng = np.random.default_rng(seed)
    return Similarity(shapes.rotation(rng.normal(size=3), rng.uniform(45, 180)), rng.uniform(-100, 100, 3), scale)


# Bounds in metres: half the noise; 1 to 5 mm was measured.
@needs_kiss
@pytest.mark.parametrize(
    ("method", "seed", "overlap", "scale"),
    [
        pytest.param("global", 1, 1.0, 1.0, marks=pytest.mark.slow),
        pytest.param("global", 2, 0.3, 1.0, marks=pytest.mark.long),
        pytest.param("global-similarity", 4, 1.0, 0.1, marks=pytest.mark.long),
        pytest.param("global-similarity", 5, 0.5, 10.0, marks=pytest.mark.slow),
    ],
)
def test_global_methods_find_any_pose(method, seed, overlap, scale):
    counts = (150_000, 60_000) if overlap < 1 else (60_000, 40_000)
    reference, candidate = sample_windows(seed, overlap, counts=counts)
    true_pose = random_pose(seed, scale)
    result = register(reference, true_pose.inverse().apply(candidate), method)
    assert error(result.T_reference_candidate, true_pose, candidate) < 0.01
    assert result.method == method
    assert result.converged
    assert result.solved_scale == (method == "global-similarity")
    assert not result.doubtful
    if method == "global":
        assert result.T_reference_candidate.scale == 1.0


@needs_kiss
def test_a_small_reconstruction_is_found_on_a_city_in_metres():
    reference, candidate = (shapes.city(count, noise=0.01, seed=count)[0] for count in (6_000, 3_000))
    true_pose = random_pose(4, scale=1000.0)
    result = register(reference, true_pose.inverse().apply(candidate), "global-similarity")
    assert error(result.T_reference_candidate, true_pose, candidate) < 0.01  # the noise
    assert result.solved_scale and not result.doubtful


@pytest.mark.parametrize("larger", ["candidate", "reference"])
def test_the_overlap_is_that_of_the_cloud_that_overlaps_more(larger):
    """The other cloud has as many points elsewhere; all distances are compared in the reference's unit."""
    rng, pose = np.random.default_rng(4), random_pose(3, scale=3.0)
    clouds = {name: rng.uniform(0, 10, (200, 3)) for name in ("candidate", "reference")}
    other = "reference" if larger == "candidate" else "candidate"
    clouds[other] = np.vstack([clouds[other], clouds[other] + 1000])
    clouds["candidate"] = pose.inverse().apply(clouds["candidate"])
    sides = {
        name: SimpleNamespace(surface=Surface(Index(points)), sample=points, overlap_distance=distance)
        for (name, points), distance in zip(clouds.items(), (0.3, 0.8), strict=True)
    }
    search = from_features._PoseSearch(sides["reference"], sides["candidate"], IcpSettings(with_scale=True))
    moved = pose.apply(clouds["candidate"])
    distances = np.linalg.norm(moved[:, None] - clouds["reference"], axis=2)
    shares = [(distances.min(axis=axis) < 3.0 * 0.3).mean() for axis in (1, 0)]
    assert max(shares) > 1.5 * min(shares)
    assert search.overlap(pose) == max(shares)


@needs_kiss
@pytest.mark.slow
def test_outliers_do_not_hide_the_pose():
    reference, candidate = sample_windows(2, 1.0)
    rng, true_pose = np.random.default_rng(6), random_pose(6)
    outliers = rng.uniform(candidate.min(axis=0), candidate.max(axis=0), (len(candidate) // 2, 3))
    result = register(reference, true_pose.inverse().apply(np.concatenate([candidate, outliers])), "global")
    assert error(result.T_reference_candidate, true_pose, candidate) < 0.01


@pytest.mark.long
@needs_kiss
@pytest.mark.parametrize("method", ["global", pytest.param("global-similarity", marks=pytest.mark.slow)])
def test_unrelated_clouds_are_refused(method):
    """Another city with the same terrain and street grid, of which three quarters fit the first."""
    reference, candidate = sample_windows(1, 1.0, other=9)
    with check_error(RegistrationError):
        register(reference, random_pose(1).inverse().apply(candidate), method)


@pytest.mark.long
@needs_kiss
def test_noise_is_refused():
    rng = np.random.default_rng(7)
    with check_error(RegistrationError):
        register(rng.normal(size=(5000, 3)), rng.normal(size=(5000, 3)), "global")


def sample_symmetric_hall(n, seed, noise=0.01):
    """Sample a gabled hall of 30 m x 12 m on a square, symmetric under a half turn about the vertical."""
    rng = np.random.default_rng(seed)
    ground, rise = 40.0, 4.0
    faces = [((-ground, -ground, 0), (2 * ground, 0, 0), (0, 2 * ground, 0))]
    faces += [((-15, y, 0), (30, 0, 0), (0, 0, 8)) for y in (-6, 6)]
    faces += [((x, -6, 0), (0, 12, 0), (0, 0, 8)) for x in (-15, 15)]
    faces += [((-15, y, 8), (30, 0, 0), (0, -y, rise)) for y in (-6, 6)]
    corner, u, v = (np.array(part, dtype=float) for part in zip(*faces, strict=True))
    areas = np.linalg.norm(np.cross(u, v), axis=1)
    face_rows = rng.choice(len(faces), size=n, p=areas / areas.sum())
    s, t = rng.random((2, n, 1))
    return corner[face_rows] + s * u[face_rows] + t * v[face_rows] + rng.normal(0, noise, (n, 3))


@needs_kiss
def test_a_symmetric_scene_is_ambiguous():
    true_pose = random_pose(8)
    candidate = sample_symmetric_hall(4_000, 2)
    result = register(sample_symmetric_hall(8_000, 1), true_pose.inverse().apply(candidate), "global")
    assert AMBIGUOUS in codes(result)
    half_turned_pose = Similarity(np.diag([-1.0, -1.0, 1.0]), np.zeros(3)) @ true_pose
    errors = [error(result.T_reference_candidate, expected, candidate) for expected in (true_pose, half_turned_pose)]
    # One of the two is right, and they are 60 m apart; quarter turns of the square ground are not among them.
    assert min(errors) < 0.5


@pytest.mark.long
@needs_kiss
def test_a_plane_is_refused_or_has_a_warning():
    rng = np.random.default_rng(9)
    reference, candidate = (shapes.plane_samples(n, 40, seed=n) + rng.normal(0, 0.01, (n, 3)) for n in (8_000, 4_000))
    try:
        result = register(reference, random_pose(9).inverse().apply(candidate), "global")
    except RegistrationError:
        return
    assert codes(result) & {UNOBSERVABLE, AMBIGUOUS}


@needs_kiss
@pytest.mark.slow
def test_far_coordinates_and_other_processes_change_nothing(tmp_path):
    reference, candidate = (np.round(c * 2**20) / 2**20 for c in sample_windows(2, 1.0, counts=(40_000, 20_000)))
    candidate = np.round(random_pose(2).inverse().apply(candidate) * 2**20) / 2**20
    near, far = register(reference, candidate, "global"), register(reference + UTM, candidate - UTM, "global")
    # 1e-7: the pose of coordinates of 1e7 in float64.
    moved = far.T_reference_candidate.apply(candidate - UTM) - UTM
    np.testing.assert_allclose(moved, near.T_reference_candidate.apply(candidate), atol=1e-7)
    np.savez(tmp_path / "clouds.npz", reference, candidate)
    script = (
        "import sys, numpy as np; from pcbench import register; clouds = np.load(sys.argv[1]);"
        "print(register(*clouds.values(), 'global').T_reference_candidate.matrix.tobytes().hex())"
    )
    command, environment = (
        [sys.executable, "-c", script, str(tmp_path / "clouds.npz")],
        {**os.environ, "OMP_NUM_THREADS": "1"},
    )
    process = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    assert process.stdout.strip() == near.T_reference_candidate.matrix.tobytes().hex()


@needs_kiss
@pytest.mark.slow
def test_real_lidar_pair_from_any_pose():
    folder = data_folder("small_gicp")
    reference, candidate = read_cloud(folder / "target.ply"), read_cloud(folder / "source.ply")
    true_pose = Similarity.from_matrix(np.loadtxt(folder / "T_target_source.txt"))
    initial_pose = random_pose(11)
    result = register(reference, candidate.transformed(initial_pose), "global")
    nearby_points = candidate.points[np.linalg.norm(candidate.points, axis=1) < 30]
    estimated_pose = result.T_reference_candidate @ initial_pose
    difference = estimated_pose.apply(nearby_points) - true_pose.apply(nearby_points)
    # The file's transform is good to 2-8 cm itself.
    assert np.sqrt(np.square(difference).sum(axis=1).mean()) < 0.1


@needs_kiss
@pytest.mark.slow
def test_real_aerial_cloud_from_any_pose():
    """Aerial cloud of streets, roofs and trees in feet: two disjoint halves, one of them rotated."""
    points = read_cloud(data_folder("autzen") / "autzen_trim.las").points
    points = points - np.floor(points.mean(axis=0))
    true_pose = random_pose(12)
    result = register(points[::2], true_pose.inverse().apply(points[1::2]), "global")
    assert error(result.T_reference_candidate, true_pose, points) < 1  # feet; half the points' spacing


def test_a_missing_library_is_reported(monkeypatch, tmp_path):
    break_library(monkeypatch, tmp_path, "kiss_matcher", None)
    reference, candidate = sample_windows(1, 1.0, counts=(5000, 5000))
    with check_error(MissingExtra):
        register(reference, candidate, "global")


def test_too_few_points_and_unknown_methods_are_refused():
    with check_error(RegistrationError):
        register(np.random.default_rng(0).normal(size=(500, 3)), np.eye(3).repeat(7, axis=0)[:20], "global")
    with check_error():
        register(np.eye(3), np.eye(3), "global:x")


def test_likely_poses_of_mostly_wrong_pairs():
    rng, true_pose = np.random.default_rng(13), random_pose(13, scale=1.1)
    candidate = rng.uniform(-50, 50, (1000, 3))
    reference = true_pose.apply(candidate)
    reference[60:] = rng.uniform(-50, 50, (940, 3))  # 6 % are right
    poses = likely_poses(FeaturePairs(candidate, reference), 3, with_scale=True)
    np.testing.assert_allclose(poses[0].matrix, true_pose.matrix, atol=0.5)
    assert likely_poses(FeaturePairs(candidate[:2], reference[:2]), 3, with_scale=True) == []
    line = np.linspace(0, 100, 50)[:, None] * [1.0, 0, 0]
    assert len(likely_poses(FeaturePairs(line, line), 3, with_scale=False)) <= 3


@needs_kiss
@pytest.mark.slow
def test_the_command_line_writes_the_pose(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    true_pose = random_pose(14)
    write_cloud("ref.ply", Cloud(shapes.city(40_000, noise=0.01, seed=1)[0]))
    points = shapes.city(20_000, noise=0.01, seed=2)[0]
    write_cloud("cand.ply", Cloud(true_pose.inverse().apply(points)))
    cli.app(["register", "ref.ply", "cand.ply", "--register", "global", "--matrix", "T.txt"], standalone_mode=False)
    assert error(read_matrix("T.txt"), true_pose, points) < 0.01
    assert "# rotation: 161.1 degrees" in capsys.readouterr().out  # the angle of the true pose
