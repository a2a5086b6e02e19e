"""Contrast separates right from wrong poses, whatever the scene, the noise and the density."""

import numpy as np
import pytest
import shapes
from registrations import codes, error
from repository import ROOT
from wording import check_text

from pcbench import Similarity
from pcbench.registration import contrast, register
from pcbench.registration.result import DOUBTFUL_POSE, LOW_OVERLAP, UNOBSERVABLE, WEAKLY_OBSERVABLE
from pcbench.scenes.synthetic import city


def sample_forest(count, seed):
    """Sample a forest of 60 m: rolling ground, and returns anywhere in 90 crowns. Different seeds share no point."""
    rng, layout_rng = np.random.default_rng(seed), np.random.default_rng(99)
    trees, heights = layout_rng.uniform(0, 60, (90, 2)), layout_rng.uniform(4, 14, 90)
    crown_rows, offsets = rng.integers(0, 90, count // 2), rng.normal(size=(count // 2, 3))
    offsets *= (rng.random(len(offsets)) ** (1 / 3) / np.linalg.norm(offsets, axis=1))[:, None] * [1.8, 1.8, 3.0]
    crowns = np.column_stack([trees, heights])[crown_rows] + offsets
    xy = rng.uniform(0, 60, (count - len(crowns), 2))
    ground = np.column_stack([xy, np.sin(xy[:, 0] / 7) + np.cos(xy[:, 1] / 9)]) + rng.normal(0, 0.05, (len(xy), 3))
    points = np.concatenate([crowns, ground])
    return points[(points[:, :2] > 0).all(axis=1) & (points[:, :2] < 60).all(axis=1)]


def sample_bumpy_ball(count, seed):
    """Sample a wavy ball without any symmetry."""
    rng, shape_rng = np.random.default_rng(seed), np.random.default_rng(1)
    directions = rng.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    waves = np.sin(directions @ shape_rng.normal(0, 2.5, (3, 10)) + shape_rng.uniform(0, 6, 10)).sum(axis=1)
    return directions * (1 + 0.05 * waves)[:, None]


def sample_city(count, seed):
    points = city(5).sample(4 * count, np.random.default_rng(seed))[0]
    return points[np.abs(points[:, :2]).max(axis=1) < 90]


@pytest.mark.parametrize(
    ("scene", "ratio", "noise"),
    [
        ("forest", 1, 0.0),
        ("forest", 0.25, 0.2),
        ("ball", 4, 0.2),
        ("ball", 1, 1.0),
        ("city", 1, 1.0),
        ("city", 4, 0.2),
    ],
)
def test_contrast_is_about_one_at_the_true_pose(scene, ratio, noise):
    """Candidates of equal, lower and higher density, one with noise as large as the spacing."""
    sample = {"forest": sample_forest, "ball": sample_bumpy_ball, "city": sample_city}[scene]
    reference, candidate = sample(8_000, 0), sample(int(8_000 / ratio), 1)
    spacing = np.median(np.sort(np.linalg.norm(reference[:300, None] - reference[None], axis=2), axis=1)[:, 1])
    candidate = candidate + np.random.default_rng(7).normal(0, noise * spacing, candidate.shape)
    registration = register(reference, candidate, "none")
    assert 0.8 < registration.contrast < 1.6
    assert not registration.doubtful


@pytest.mark.parametrize("shift", [(7.0, 0, 0), (0, -5.0, 0), (4.0, 4.0, 0.3)])
def test_a_shift_in_a_forest_is_doubtful(shift):
    """Points fill the crowns: most of the candidate still lies on the reference."""
    reference, candidate = sample_forest(8_000, 0), sample_forest(8_000, 1) + np.array(shift)
    registration = register(reference, candidate, "none")
    assert registration.overlap > 0.55
    assert DOUBTFUL_POSE in codes(registration)
    assert registration.contrast < 0.6
    (text,) = (notice.text for notice in registration.warnings if notice.code == DOUBTFUL_POSE)
    check_text(text)


@pytest.mark.long
def test_a_mirror_image_is_doubtful():
    reference, candidate = sample_bumpy_ball(20_000, 0), sample_bumpy_ball(20_000, 1) * [-1, 1, 1]
    for method in ("icp", "similarity"):
        assert register(reference, candidate, method).doubtful


def test_a_wrong_rotation_is_doubtful():
    reference, candidate = sample_bumpy_ball(10_000, 0), sample_bumpy_ball(10_000, 1)
    rotated = Similarity(shapes.rotation([1, 2, 3], 25), np.zeros(3)).apply(candidate)
    registration = register(reference, rotated)
    true_pose = Similarity(shapes.rotation([1, 2, 3], -25), np.zeros(3))
    assert error(registration.T_reference_candidate, true_pose, candidate) < 0.01
    assert not registration.warnings
    far_registration = register(reference, Similarity(shapes.rotation([1, 2, 3], 100), np.zeros(3)).apply(candidate))
    assert far_registration.doubtful


def sample_jug(count, seed):
    """Sample a body of revolution with a handle, which alone fixes its rotation."""
    rng = np.random.default_rng(seed)
    height, angle = rng.uniform(0, 2, count), rng.uniform(0, 2 * np.pi, count)
    radius = 1 + 0.25 * np.sin(2.5 * height)
    body = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), height])
    along, around = rng.uniform(-1.2, 1.2, count // 8), rng.uniform(0, 2 * np.pi, count // 8)
    reach = 0.9 + 0.9 * np.cos(along) + 0.12 * np.cos(around)
    handle = np.column_stack([reach, 0.12 * np.sin(around), 1 + 0.8 * np.sin(along) * reach / 1.8])
    points = np.concatenate([body, handle])
    return points + rng.normal(0, 0.004, points.shape)


def test_a_round_body_rotated_about_its_axis_has_a_warning():
    reference, candidate = sample_jug(10_000, 0), sample_jug(10_000, 1)
    assert not register(reference, candidate, "none").warnings
    rotated = Similarity(shapes.rotation([0, 0, 1], 90), np.zeros(3)).apply(candidate)
    assert register(reference, rotated, "none").warnings


def test_a_small_overlap_with_high_contrast_is_not_doubtful():
    reference, candidate = sample_bumpy_ball(40_000, 0), sample_bumpy_ball(40_000, 1)
    reference, candidate = reference[reference[:, 0] < 0.1], candidate[candidate[:, 0] > -0.1]
    registration = register(reference, candidate, "none")
    assert registration.overlap < 0.3
    assert codes(registration) == {LOW_OVERLAP}
    assert not registration.doubtful


def test_exact_copies_have_no_warnings():
    points = sample_bumpy_ball(8_000, 0)
    for scale in (1.0, 0.9):
        true_pose = Similarity(shapes.rotation([1, 0, 2], 3), np.array([0.02, 0, 0.01]), scale)
        registration = register(points, true_pose.inverse().apply(points[::3]), "similarity")
        assert registration.rmse < 1e-12
        assert not registration.warnings


def test_displacements_have_one_size_at_the_radius():
    radius, center = 20.0, np.array([5.0, -3.0, 1.0])
    points = center + radius * np.concatenate([np.eye(3), -np.eye(3)])  # four are off each axis
    displaced = contrast._displaced_points(points, center, 0.1, radius, 7).reshape(15, 6, 3)
    lengths = np.sqrt(np.square(displaced - displaced[0]).sum(axis=2).max(axis=1))
    assert lengths[0] == 0
    np.testing.assert_allclose(lengths[1:], 0.1, rtol=0.01)  # chords and logarithms differ by half the ratio, 1/200
    np.testing.assert_allclose((displaced[1::2] + displaced[2::2]) / 2, np.broadcast_to(points, (7, 6, 3)), atol=1e-3)


def test_added_noise_is_the_difference_of_the_variances():
    rng, grid = np.random.default_rng(0), shapes.plane_grid(40)
    candidate, reference = (grid + rng.normal(0, sigma, len(grid))[:, None] * [0, 0, 1] for sigma in (0.05, 0.03))
    # Roughness includes the noise of the planes, a factor of both; each is known to 3 % from 1600 points.
    factor = contrast.roughness(reference) / 0.03
    assert contrast._added_noise(candidate, reference) == pytest.approx(0.04 * factor, rel=0.15)
    assert contrast._added_noise(reference, candidate) == 0


def test_few_points_have_no_contrast():
    points = np.random.default_rng(0).normal(size=(40, 3))
    assert register(points, points, "none").contrast is None


def test_a_scan_of_uneven_density_is_observable():
    """A scanner's density falls with the square of the distance; walls and ground fix the pose."""
    rng = np.random.default_rng(3)
    clouds = []
    for seed in (1, 2):
        points = city(4).sample(120_000, np.random.default_rng(seed))[0]
        distance = np.linalg.norm(points - [5.0, 3, 2], axis=1)
        clouds.append(points[rng.random(len(points)) < np.minimum(1, (12 / distance) ** 2)])
    registration = register(*clouds)
    assert not codes(registration) & {UNOBSERVABLE, WEAKLY_OBSERVABLE}


def scan_street(eye, lines, steps, noise, seed):
    """Simulate a spinning scanner at `eye` (3,) in a street of houses, cars and poles."""
    layout_rng, rng = np.random.default_rng(5), np.random.default_rng(seed)
    boxes = []
    for side in (-1, 1):
        for x in np.arange(-60, 60, 12):
            front = 8 + layout_rng.uniform(0, 2.5)
            low, high = sorted((side * front, side * 20))
            boxes.append([x, low, -0.5, x + layout_rng.uniform(8, 12), high, layout_rng.uniform(5, 15)])
        for x in layout_rng.uniform(-40, 40, 7):
            boxes.append([x, side * 5.5 - 0.9, 0, x + 4.2, side * 5.5 + 0.9, 1.5])
        for x in layout_rng.uniform(-40, 40, 7):
            boxes.append([x, side * 7 - 0.15, 0, x + 0.3, side * 7 + 0.15, 6])
    elevation, azimuth = np.meshgrid(
        np.radians(np.linspace(-25, 12, lines)), np.linspace(0, 2 * np.pi, steps) + rng.random()
    )
    rays = np.stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], axis=-1
    ).reshape(-1, 3)
    depth = np.where(rays[:, 2] < 0, -eye[2] / rays[:, 2], np.inf)
    for box in np.array(boxes):
        distances = np.sort([(box[:3] - eye) / rays, (box[3:] - eye) / rays], axis=0)
        enter, leave = distances[0].max(axis=1), distances[1].min(axis=1)
        depth = np.where((enter < leave) & (enter > 0), np.minimum(depth, enter), depth)
    in_range = depth < 60
    return eye + (rays * (depth + rng.normal(0, noise, len(depth)))[:, None])[in_range]


@pytest.mark.parametrize(
    ("lines", "steps", "noise"), [(16, 900, 0.015), pytest.param(64, 450, 0.03, marks=pytest.mark.long)]
)
def test_scans_from_two_positions_are_not_doubtful(lines, steps, noise):
    """Scan lines are up to a metre from those of the other scan; the spacing along them is 3 cm."""
    reference = scan_street(np.array([-6.0, 1.0, 2.0]), lines, steps, noise, 1)
    candidate = scan_street(np.array([-2.5, 1.5, 2.0]), lines, steps, noise, 2)
    assert not register(reference, candidate, "none").doubtful
    for shift in ([2.0, 0, 0], [0, 3.0, 0]):
        assert DOUBTFUL_POSE in codes(register(reference, candidate + shift, "none"))


@pytest.mark.long
def test_no_trial_fails_silently(monkeypatch, capsys):
    """The benchmark's quick form: generated scenes only, including mirror images."""
    trials, scenes = _import_bench(monkeypatch)
    selected_scenes = {name: (scenes.TUNED | scenes.HELD_OUT)[name] for name in ("bumps", "rough ground")}
    rows = trials.run_trials(selected_scenes, ["icp", "similarity"], range(2))
    kinds = [row["kind"] for row in rows]
    assert "silent" not in kinds
    assert kinds.count("right") >= 4
    assert "right, warned" in capsys.readouterr().out


@pytest.mark.slow
def test_no_trial_of_any_scene_fails_silently(monkeypatch):
    trials, scenes = _import_bench(monkeypatch)
    rows = trials.run_trials(
        scenes.available_scenes(scenes.TUNED | scenes.HELD_OUT), trials.METHODS[:2], range(400, 410)
    )
    kinds = [row["kind"] for row in rows]
    assert kinds.count("silent") <= 0.01 * len(kinds)
    assert kinds.count("right, warned") <= 0.06 * kinds.count("right")


def _import_bench(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    import registration_scenes
    import registration_trials

    return registration_trials, registration_scenes
