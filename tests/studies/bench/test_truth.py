"""The truth of a bench: errors and their floors, pixel size on the ground, visible part."""

from pathlib import Path

import numpy as np
import pytest
from wording import check_error

from pcbench import Cloud
from pcbench.geometry.cameras import Camera, Intrinsics, look_at
from pcbench.geometry.mesh import Mesh
from pcbench.plugins import Reconstruction
from pcbench.studies.bench.score import EvaluationProtocol, Rules, score
from pcbench.studies.bench.truth import Truth

K = Intrinsics(200, 200, 100, 100, 100, 100)


def square_mesh(side, height=0.0):
    """Horizontal square mesh with a corner at the origin."""
    corners = np.array([[0, 0, height], [side, 0, height], [side, side, height], [0, side, height]], dtype=float)
    return Mesh(corners, np.array([[0, 1, 2], [0, 2, 3]]), unit="m")


def nadir_cameras(*heights, side=40.0):
    """Nadir cameras above the middle, at different heights and slightly different positions."""
    middle = side / 2
    poses = [look_at([middle + 0.01 * n, middle, h], [middle + 0.01 * n, middle, 0]) for n, h in enumerate(heights)]
    return {f"{n}.png": Camera(f"{n}.png", K, pose) for n, pose in enumerate(poses)}


def make_truth(mesh, points, cameras=(), visible=None):
    visible_mask = np.ones(points, bool) if visible is None else visible
    return Truth(mesh.sample(points, seed=1), dict(cameras), visible_mask, "by the test", mesh)


def score_points(truth, points, tmp_path, **rules):
    reconstruction = Reconstruction(Cloud(points), "georeferenced")
    return score(EvaluationProtocol.from_rules(truth, Rules(**rules)), reconstruction, tmp_path)


@pytest.mark.parametrize("error", [0.110, *(pytest.param(each, marks=pytest.mark.long) for each in (0.056, 0.190))])
def test_accuracy_is_independent_of_reference_density(tmp_path, error):
    mesh = square_mesh(40.0)
    truth = make_truth(mesh, 1600)  # one per square metre: mean distance to the nearest 0.5 m
    cloud = mesh.sample(20_000, seed=2)
    offsets = np.random.default_rng(3).normal(0, error * np.sqrt(np.pi / 2), len(cloud))
    points = cloud.points + offsets[:, None] * [0, 0, 1]
    scores = score_points(truth, points, tmp_path, threshold="0.1,0.2,0.5")
    assert scores.accuracy_to == "surface"
    assert scores.mean_c2r == pytest.approx(np.abs(offsets).mean(), rel=1e-9)
    assert scores.mean_c2r == pytest.approx(error, rel=0.03)
    assert scores.d1_c2r == pytest.approx(np.mean(offsets**2), rel=1e-9)
    assert (scores.mean_c2r_floor, scores.thresholds[0].precision_floor) == (0, 1)
    for threshold_score in scores.thresholds:
        assert threshold_score.precision == pytest.approx(
            np.mean(np.abs(offsets) <= threshold_score.threshold), abs=1e-12
        )
    assert scores.threshold == 0.5  # the last threshold
    assert [at.threshold for at in scores.thresholds] == [0.1, 0.2, 0.5]
    # Against points alone their spacing dominates, and the floor shows it.
    scores_without_mesh = score_points(Truth(truth.cloud, {}, None, ""), points, tmp_path, threshold="0.1,0.2,0.5")
    assert scores_without_mesh.accuracy_to == "points"
    assert scores_without_mesh.mean_c2r > 0.45
    assert scores_without_mesh.mean_c2r_floor > 0.45
    for threshold_score in scores_without_mesh.thresholds:
        assert threshold_score.precision_floor == pytest.approx(
            1 - np.exp(-np.pi * threshold_score.threshold**2), rel=0.06
        )
        assert threshold_score.recall_floor is None


def test_precision_floor_is_precision_of_error_free_clouds(tmp_path):
    """Compare the floor with scores of error-free clouds, for uneven and for jittered samples."""
    rng = np.random.default_rng(0)
    uneven_points = np.column_stack([40 * rng.random((3000, 2)) ** 1.7, np.zeros(3000)])
    grid = np.stack(np.meshgrid(np.arange(55), np.arange(55)), axis=2).reshape(-1, 2) + rng.random((55**2, 2))
    for points, tolerance in ((uneven_points, 0.03), (np.column_stack([grid * 40 / 55, np.zeros(55**2)]), 0.15)):
        candidate = square_mesh(40.0).sample(8000, seed=4).points
        scores = score_points(Truth(Cloud(points), {}, None, ""), candidate, tmp_path, threshold="0.3,0.6,1")
        for threshold_score in scores.thresholds:
            assert threshold_score.precision_floor == pytest.approx(threshold_score.precision, abs=tolerance)


@pytest.mark.long
def test_completeness_is_measured_by_area(tmp_path):
    """A lattice with a spacing of 1 m covers the share pi t^2 of the plane within t."""
    mesh = square_mesh(40.0)
    visible = np.random.default_rng(0).random(500) < 0.9
    truth = make_truth(mesh, 500, nadir_cameras(30.0, 31.0, 32.0), visible)
    lattice = np.stack(np.meshgrid(np.arange(-0.5, 41), np.arange(-0.5, 41), [0.0]), axis=-1).reshape(-1, 3)
    scores = score_points(truth, lattice, tmp_path, threshold="0.05,0.1,0.4")
    for threshold_score in scores.thresholds:
        assert threshold_score.recall_visible == pytest.approx(np.pi * threshold_score.threshold**2, rel=0.02)
        assert threshold_score.recall_visible_floor == pytest.approx(
            threshold_score.recall_visible, rel=1e-9
        )  # the lattice has no error
        assert threshold_score.fscore_visible == pytest.approx(
            2 / (1 / threshold_score.precision + 1 / threshold_score.recall_visible), rel=1e-9
        )
    # Errors account for the difference between recall and its floor.
    lifted_score = score_points(truth, lattice + [0, 0, 0.3], tmp_path, threshold="0.05,0.1,0.4").thresholds[-1]
    assert lifted_score.recall_visible == pytest.approx(np.pi * (0.4**2 - 0.3**2), rel=0.02)
    assert lifted_score.recall_visible_floor == pytest.approx(scores.thresholds[-1].recall_visible, rel=1e-9)
    # Points far from the surface do not count in the floor.
    outlier_score = score_points(
        truth, lattice + [0, 0, 1] * (lattice[:, :1] > 20), tmp_path, threshold="0.4"
    ).thresholds[-1]
    assert outlier_score.recall_visible_floor == pytest.approx(scores.thresholds[-1].recall_visible / 2, rel=0.03)


def test_visible_part_is_sampled_at_threshold_spacing(monkeypatch):
    from pcbench.studies.bench import truth as module

    mesh = square_mesh(40.0)
    truth = make_truth(mesh, 500, nadir_cameras(15.0, 15.0, 15.0))  # they see the central 30 m
    protocol = EvaluationProtocol.from_rules(truth, Rules(threshold="0.2,1"))
    assert protocol.visible_spacing == pytest.approx(0.2)
    assert len(protocol.visible_points) == pytest.approx(900 / 0.2**2, rel=0.03)
    assert np.abs(protocol.visible_points[:, :2] - 20).max() <= 15.03
    cropped_protocol = EvaluationProtocol.from_rules(truth, Rules(threshold="0.2", crop="box:10,10,-1,20,20,1"))
    assert len(cropped_protocol.visible_points) == pytest.approx(100 / 0.2**2, rel=0.06)
    # The reference's own points are used if they are dense enough.
    coarse_protocol = EvaluationProtocol.from_rules(truth, Rules(threshold="5"))
    np.testing.assert_array_equal(coarse_protocol.visible_points, truth.cloud.points)
    monkeypatch.setattr(module, "_MAX_VISIBLE_SAMPLES", 10_000)
    assert EvaluationProtocol.from_rules(truth, Rules(threshold="0.01")).visible_spacing == pytest.approx(
        np.sqrt(1600 / 10_000)
    )
    assert (
        EvaluationProtocol.from_rules(Truth(truth.cloud, {}, None, ""), Rules(threshold="0.2")).visible_points is None
    )


def test_pixel_size_is_depth_over_focal_length():
    mesh = square_mesh(40.0)
    assert make_truth(mesh, 500, nadir_cameras(50.0)).pixel == pytest.approx(0.5)
    assert make_truth(mesh, 500, nadir_cameras(30.0, 40.0, 60.0)).pixel == pytest.approx(0.4)
    # A roof occludes the ground, which only the surface reveals. Without cameras there is no pixel size.
    roof = square_mesh(40.0, height=20.0)
    ground_and_roof = Mesh(np.concatenate([mesh.vertices, roof.vertices]), np.concatenate([mesh.faces, roof.faces + 4]))
    cameras = nadir_cameras(50.0, 50.0, 50.0)
    assert make_truth(ground_and_roof, 4000, cameras).pixel == pytest.approx(0.3)
    cloud = ground_and_roof.sample(4001, seed=1)
    assert Truth(cloud, cameras, None, "").pixel in (pytest.approx(0.3), pytest.approx(0.5))
    assert Truth(cloud, {}, None, "").pixel is None
    cameras_facing_away = {"a.png": Camera("a.png", K, look_at([20, 20, 50], [20, 20, 90], up=[0, 1, 0]))}
    assert make_truth(mesh, 500, cameras_facing_away).pixel is None


def test_thresholds_are_lengths_or_pixels():
    truth = make_truth(square_mesh(40.0), 500, nadir_cameras(50.0))
    assert [(t.length, t.pixels) for t in EvaluationProtocol.from_rules(truth, Rules()).thresholds] == [
        (0.5, 1),
        (1.0, 2),
        (2.5, 5),
    ]
    thresholds = EvaluationProtocol.from_rules(truth, Rules(threshold="0.3, 3px")).thresholds
    assert [(t.length, t.pixels) for t in thresholds] == [(0.3, None), (pytest.approx(1.5), 3)]
    truth_without_cameras = Truth(truth.cloud, {}, None, "")
    assert [
        t.length / truth_without_cameras.spacing
        for t in EvaluationProtocol.from_rules(truth_without_cameras, Rules()).thresholds
    ] == pytest.approx([1, 2, 5])
    for text in ("0", "-1px", "a", "1,,2", "nan", "inf", ""):
        with check_error():
            EvaluationProtocol.from_rules(truth, Rules(threshold=text))
    with check_error():
        EvaluationProtocol.from_rules(truth_without_cameras, Rules(threshold="2px"))
    with check_error():
        EvaluationProtocol.from_rules(Truth(Cloud(np.zeros((5, 3))), {}, None, ""), Rules())


def test_scores_are_invariant_to_large_coordinates(tmp_path):
    offset = np.array([4_500_000.0, 5_200_000.0, 0.0])
    mesh = square_mesh(40.0)
    noise = np.random.default_rng(3).normal(0, 0.05, 3000)
    points = mesh.sample(3000, seed=2).points + noise[:, None] * [0, 0, 1]
    expected = score_points(make_truth(mesh, 2000), points, tmp_path, threshold="0.1")
    moved_mesh = Mesh(mesh.vertices + offset, mesh.faces, unit="m")
    scores = score_points(make_truth(moved_mesh, 2000), points + offset, tmp_path, threshold="0.1")
    assert scores.mean_c2r == pytest.approx(expected.mean_c2r, rel=1e-6)
    assert scores.thresholds[0].precision == expected.thresholds[0].precision


@pytest.mark.usefixtures("few_samples")
def test_mesh_of_the_scene_is_used(bench_folder, in_process):
    from benches import RIG, run_bench

    from pcbench import write_cloud
    from pcbench.io.ply import write_ply_mesh
    from pcbench.studies.bench.runs import BenchJob

    mesh = square_mesh(40.0)
    Path("photos/truth").mkdir()
    write_ply_mesh(Path("photos/truth/mesh.ply"), mesh)
    write_cloud("photos/truth/cloud.ply", mesh.sample(3000))
    write_cloud("made.ply", Cloud(mesh.sample(1000, seed=3).points))
    doc = run_bench(BenchJob(Path("photos"), Path("photos/truth/cloud.ply"), ["methods.py:Good"]))
    (row,) = doc["rows"]
    assert (row["accuracy_to"], row["mean_c2r_floor"]) == ("surface", 0)
    assert row["mean_c2r"] == pytest.approx(0.05 * np.sqrt(2 / np.pi), rel=0.1)
    assert doc["reference"]["mesh"]["path"] == "photos/truth/mesh.ply"
    assert [threshold_score["pixels"] for threshold_score in row["thresholds"]] == [1, 2, 5]
    assert 25 / 35 < doc["reference"]["pixel"] < 60 / 35  # cameras at a height of 25 m
    assert row["threshold"] == pytest.approx(5 * doc["reference"]["pixel"])
    assert len(RIG) == 5
    text = Path("out/bench.md").read_text()
    assert "against the true surface" in text
    assert "F of seen" in text
    # A reference from elsewhere is not of that truth.
    other_doc = run_bench(BenchJob(Path("photos"), Path("truth.ply"), ["methods.py:Good"]), Path("out2"))
    assert other_doc["rows"][0]["accuracy_to"] == "points"
