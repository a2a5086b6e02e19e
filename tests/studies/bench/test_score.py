"""Registration and scores of clouds, and visibility of the reference."""

from pathlib import Path

import numpy as np
import oracles
import pytest
import shapes
from benches import OWN, POINTS, RIG, TRUTH, K, reconstruction_in
from optional import break_library
from wording import check_text

from pcbench import Cloud, write_cloud
from pcbench.geometry import mesh_samples
from pcbench.geometry.cameras import Camera
from pcbench.geometry.mesh import Mesh
from pcbench.geometry.transform import Similarity
from pcbench.plugins import Reconstruction
from pcbench.studies.bench import score as scoring
from pcbench.studies.bench.score import EvaluationProtocol, Rules, choose_alignment
from pcbench.studies.bench.truth import read_truth, visible_mask

pytestmark = pytest.mark.usefixtures("without_deformation")


def score(truth, reconstruction, folder, rules=None):
    return scoring.score(EvaluationProtocol.from_rules(truth, rules or Rules()), reconstruction, folder)


def test_arbitrary_gauge_is_registered_by_cameras(truth, tmp_path):
    expected = score(truth, reconstruction_in(POINTS, "georeferenced"), tmp_path)
    values = score(truth, reconstruction_in(POINTS, "arbitrary", OWN), tmp_path)
    assert values.registration == "cameras"
    for key in ("d1_c2r", "d1_r2c", "fscore", "recall_visible", "chamfer"):
        assert getattr(values, key) == pytest.approx(getattr(expected, key), rel=1e-6)
    T = np.array([[float(w) for w in line.split()] for line in (tmp_path / "T.txt").read_text().splitlines()])
    np.testing.assert_allclose(T, OWN.inverse().matrix, atol=1e-9 * 300)
    # An outlier camera has no influence.
    reconstruction = reconstruction_in(POINTS, "arbitrary", OWN)
    cameras = dict(reconstruction.cameras)
    camera = cameras["2.png"].cam_from_world
    cameras["2.png"] = Camera("2.png", K, Similarity(camera.rotation, camera.translation + 5))
    alignment = choose_alignment(Reconstruction(reconstruction.cloud, "arbitrary", cameras), truth.cameras)
    aligned_points = alignment.transform.apply(reconstruction.cloud.points)
    assert np.linalg.norm(aligned_points - POINTS, axis=1).max() < 0.2  # least squares would be off by metres


def test_georeferenced_cloud_is_not_fitted(truth, tmp_path):
    reconstruction = reconstruction_in(POINTS + [0, 0, 1.5], "georeferenced")
    values = score(truth, reconstruction, tmp_path)
    assert values.registration == "none"
    distances = oracles.nearest(reconstruction.cloud.points, TRUTH.points)[0]
    assert values.d1_c2r == pytest.approx(np.mean(distances**2), rel=1e-9)
    assert values.d1_c2r > 0.2
    icp_values = score(truth, reconstruction, tmp_path, Rules(register="icp"))
    assert icp_values.registration == "icp"
    assert icp_values.d1_c2r < 0.2 * values.d1_c2r


def test_metric_cloud_is_registered_without_scale(truth, tmp_path):
    rigid_transform = Similarity(OWN.rotation, OWN.translation)
    exact_values = score(truth, reconstruction_in(POINTS, "metric", rigid_transform), tmp_path)
    centre = POINTS.mean(axis=0)
    enlarged = reconstruction_in(POINTS, "metric", Similarity(np.eye(3), -0.05 * centre, 1.05))
    values = score(truth, enlarged, tmp_path)
    assert (exact_values.registration, values.registration) == ("cameras", "cameras")
    assert exact_values.comparison["registration"]["scale"] == pytest.approx(1, abs=1e-9)
    assert values.comparison["registration"]["scale"] == 1
    assert values.d1_c2r > 2 * exact_values.d1_c2r


def test_cloud_without_cameras_is_registered_by_surface(truth, tmp_path, monkeypatch):
    reconstruction = Reconstruction(Cloud(POINTS), "arbitrary")
    assert choose_alignment(reconstruction, truth.cameras).method in ("global-similarity", "similarity")
    break_library(monkeypatch, tmp_path / "packages", "kiss_matcher", None)
    assert choose_alignment(Reconstruction(Cloud(POINTS), "metric"), truth.cameras).method == "icp"
    alignment = choose_alignment(reconstruction, truth.cameras)
    assert alignment.method == "similarity"
    assert "kiss-matcher" in alignment.notes[0]
    transform = Similarity(shapes.rotation([0, 0, 1], 1.0), np.array([0.1, 0.2, 0.0]), 1.02)
    values = score(truth, reconstruction_in(POINTS, "arbitrary", transform, cameras=()), tmp_path)
    assert values.registration == "similarity"
    assert values.comparison["registration"]["scale"] == pytest.approx(1 / 1.02, rel=2e-3)
    # Two cameras, or cameras on one line, do not fix a similarity: a note, and registration by surface.
    alignment_by_two_cameras = choose_alignment(
        reconstruction_in(POINTS, "arbitrary", OWN, cameras=RIG[:2]), truth.cameras
    )
    assert alignment_by_two_cameras.method == "similarity"
    check_text(alignment_by_two_cameras.notes[0])


def test_recall_of_visible_part(truth, tmp_path):
    partial_points = POINTS[POINTS[:, 0] > 15]
    rules = Rules(threshold="0.7", crop="box:5,5,-5,35,35,50")
    values = score(truth, reconstruction_in(partial_points, "georeferenced"), tmp_path, rules)
    within_threshold = oracles.nearest(TRUTH.points, partial_points)[0] <= 0.7
    in_box = ((TRUTH.points >= [5, 5, -5]) & (TRUTH.points <= [35, 35, 50])).all(axis=1)
    is_visible = TRUTH.attributes["visible"] != 0
    assert values.recall == pytest.approx(within_threshold[in_box].mean(), abs=1e-12)
    assert values.recall_visible == pytest.approx(within_threshold[in_box & is_visible].mean(), abs=1e-12)
    assert values.recall_visible > values.recall + 0.05


def wall_and_ground():
    """Mesh of a ground of 40 m with a wall that hides a part of it from each side."""
    vertices = np.array(
        [[0, 0, 0], [40, 0, 0], [40, 40, 0], [0, 40, 0], [20, 5, 0], [20, 35, 0], [20, 35, 9], [20, 5, 9]], float
    )
    return Mesh(vertices, np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]]))


def test_visibility_by_ray_casting_matches_brute_force():
    mesh = wall_and_ground()
    sample = mesh.sample(500, seed=3)
    cameras = {camera.name: camera for camera in RIG}
    computed = visible_mask(Cloud(sample.points + 0.001 * sample.normals), mesh, cameras)
    counts = np.zeros(len(sample), dtype=int)
    for camera in RIG:
        pixels, depths = camera.project(sample.points)
        in_image = (depths > 0) & (pixels >= 0).all(axis=1) & (pixels < [K.width, K.height]).all(axis=1)
        lines = camera.position - sample.points
        faces_camera = (lines * sample.normals).sum(axis=1) > 0
        distances = oracles.first_hits(sample.points + 1e-5 * sample.normals, lines, mesh.vertices, mesh.faces)
        counts += in_image & faces_camera & ~(distances < 1)
    np.testing.assert_array_equal(computed, counts >= 3)
    assert 0.1 < computed.mean() < 0.9


def test_source_of_visibility(bench_folder, monkeypatch):
    monkeypatch.setattr(mesh_samples, "REFERENCE_SAMPLES", 20_000)  # enough for the tolerance below
    cameras = {camera.name: camera for camera in RIG}
    by_attribute = read_truth(Path("truth.ply"), None, cameras, print)
    np.testing.assert_array_equal(by_attribute.visible, TRUTH.attributes["visible"] != 0)
    mesh = wall_and_ground()
    sample = mesh.sample(800)
    write_cloud("bare.ply", Cloud(sample.points))
    assert read_truth(Path("bare.ply"), None, cameras, print).visible is None
    lines = [" ".join(map(str, v)) for v in mesh.vertices] + [f"3 {a} {b} {c}" for a, b, c in mesh.faces]
    Path("wall.off").write_text(f"OFF\n{len(mesh.vertices)} {len(mesh)} 0\n" + "\n".join(lines) + "\n")
    by_rays = read_truth(Path("bare.ply"), Path("wall.off"), cameras, print)
    np.testing.assert_array_equal(by_rays.visible, visible_mask(Cloud(sample.points), mesh, cameras))
    assert "wall.off" in check_text(by_rays.visibility)
    from_mesh = read_truth(Path("wall.off"), None, cameras, print)
    assert from_mesh.visible.mean() == pytest.approx(by_rays.visible.mean(), abs=0.06)
    assert read_truth(Path("wall.off"), None, {}, print).visible is None
    write_cloud("dark.ply", Cloud(sample.points, attributes={"visible": np.zeros(800, np.uint8)}))
    without_visible_points = read_truth(Path("dark.ply"), None, cameras, print)
    assert without_visible_points.visible is None
    check_text(without_visible_points.visibility)
