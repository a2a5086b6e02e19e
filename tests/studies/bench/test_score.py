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
from pcbench.geometry.cameras import Camera
from pcbench.geometry.mesh import Mesh
from pcbench.geometry.transform import Similarity
from pcbench.plugins import Reconstruction
from pcbench.studies.bench import score as scoring
from pcbench.studies.bench import truth as truths
from pcbench.studies.bench.score import EvaluationProtocol, Rules, choose_alignment
from pcbench.studies.bench.truth import read_truth, visible_mask


def score(truth, made, folder, rules=None):
    return scoring.score(EvaluationProtocol.from_rules(truth, rules or Rules()), made, folder).row()


def test_arbitrary_gauge_is_registered_by_cameras(truth, tmp_path):
    straight = score(truth, reconstruction_in(POINTS, "georeferenced"), tmp_path)
    values = score(truth, reconstruction_in(POINTS, "arbitrary", OWN), tmp_path)
    assert values["registration"] == "cameras"
    for key in ("d1_c2r", "d1_r2c", "fscore", "recall_visible", "chamfer"):
        assert values[key] == pytest.approx(straight[key], rel=1e-6)
    T = np.array([[float(w) for w in line.split()] for line in (tmp_path / "T.txt").read_text().splitlines()])
    np.testing.assert_allclose(T, OWN.inverse().matrix, atol=1e-9 * 300)
    # An outlier camera has no influence.
    wrong = reconstruction_in(POINTS, "arbitrary", OWN)
    cameras = dict(wrong.cameras)
    camera = cameras["2.png"].cam_from_world
    cameras["2.png"] = Camera("2.png", K, Similarity(camera.rotation, camera.translation + 5))
    found = choose_alignment(Reconstruction(wrong.cloud, "arbitrary", cameras), truth.cameras)
    moved = found.transform.apply(wrong.cloud.points)
    assert np.linalg.norm(moved - POINTS, axis=1).max() < 0.2  # least squares would be off by metres


def test_georeferenced_cloud_is_not_fitted(truth, tmp_path):
    made = reconstruction_in(POINTS + [0, 0, 1.5], "georeferenced")
    values = score(truth, made, tmp_path)
    assert values["registration"] == "none"
    distances = oracles.nearest(made.cloud.points, TRUTH.points)[0]
    assert values["d1_c2r"] == pytest.approx(np.mean(distances**2), rel=1e-9)
    assert values["d1_c2r"] > 0.2
    fitted = score(truth, made, tmp_path, Rules(register="icp"))
    assert fitted["registration"] == "icp"
    assert fitted["d1_c2r"] < 0.2 * values["d1_c2r"]


def test_metric_cloud_is_registered_without_scale(truth, tmp_path):
    rigid = Similarity(OWN.rotation, OWN.translation)
    exact = score(truth, reconstruction_in(POINTS, "metric", rigid), tmp_path)
    centre = POINTS.mean(axis=0)
    larger = reconstruction_in(POINTS, "metric", Similarity(np.eye(3), -0.05 * centre, 1.05))
    values = score(truth, larger, tmp_path)
    assert (exact["registration"], values["registration"]) == ("cameras", "cameras")
    assert exact["comparison"]["registration"]["scale"] == pytest.approx(1, abs=1e-9)
    assert values["comparison"]["registration"]["scale"] == 1
    assert values["d1_c2r"] > 2 * exact["d1_c2r"]


def test_cloud_without_cameras_is_registered_by_surface(truth, tmp_path, monkeypatch):
    cloud = Reconstruction(Cloud(POINTS), "arbitrary")
    assert choose_alignment(cloud, truth.cameras).method in ("global-similarity", "similarity")
    break_library(monkeypatch, tmp_path / "packages", "kiss_matcher", None)
    assert choose_alignment(Reconstruction(Cloud(POINTS), "metric"), truth.cameras).method == "icp"
    found = choose_alignment(cloud, truth.cameras)
    assert found.method == "similarity"
    assert "kiss-matcher" in found.notes[0]
    near = Similarity(shapes.rotation([0, 0, 1], 1.0), np.array([0.1, 0.2, 0.0]), 1.02)
    values = score(truth, reconstruction_in(POINTS, "arbitrary", near, cameras=()), tmp_path)
    assert values["registration"] == "similarity"
    assert values["comparison"]["registration"]["scale"] == pytest.approx(1 / 1.02, rel=2e-3)
    # Two cameras, or cameras on one line, do not fix a similarity: a note, and registration by surface.
    two = choose_alignment(reconstruction_in(POINTS, "arbitrary", OWN, cameras=RIG[:2]), truth.cameras)
    assert two.method == "similarity"
    check_text(two.notes[0])


def test_recall_of_visible_part(truth, tmp_path):
    part = POINTS[POINTS[:, 0] > 15]
    rules = Rules(threshold="0.7", crop="box:5,5,-5,35,35,50")
    values = score(truth, reconstruction_in(part, "georeferenced"), tmp_path, rules)
    near = oracles.nearest(TRUTH.points, part)[0] <= 0.7
    inside = ((TRUTH.points >= [5, 5, -5]) & (TRUTH.points <= [35, 35, 50])).all(axis=1)
    visible = TRUTH.attributes["visible"] != 0
    assert values["recall"] == pytest.approx(near[inside].mean(), abs=1e-12)
    assert values["recall_visible"] == pytest.approx(near[inside & visible].mean(), abs=1e-12)
    assert values["recall_visible"] > values["recall"] + 0.05


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
    found = visible_mask(Cloud(sample.points + 0.001 * sample.normals), mesh, cameras)
    counts = np.zeros(len(sample), dtype=int)
    for camera in RIG:
        pixels, depths = camera.project(sample.points)
        framed = (depths > 0) & (pixels >= 0).all(axis=1) & (pixels < [K.width, K.height]).all(axis=1)
        lines = camera.position - sample.points
        facing = (lines * sample.normals).sum(axis=1) > 0
        distances = oracles.first_hits(sample.points + 1e-5 * sample.normals, lines, mesh.vertices, mesh.faces)
        counts += framed & facing & ~(distances < 1)
    np.testing.assert_array_equal(found, counts >= 3)
    assert 0.1 < found.mean() < 0.9


def test_source_of_visibility(bench_folder, monkeypatch):
    monkeypatch.setattr(truths, "_MESH_SAMPLE_COUNT", 20_000)  # enough for the tolerance below
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
    of_mesh = read_truth(Path("wall.off"), None, cameras, print)
    assert of_mesh.visible.mean() == pytest.approx(by_rays.visible.mean(), abs=0.06)
    assert read_truth(Path("wall.off"), None, {}, print).visible is None
    write_cloud("dark.ply", Cloud(sample.points, attributes={"visible": np.zeros(800, np.uint8)}))
    dark = read_truth(Path("dark.ply"), None, cameras, print)
    assert dark.visible is None
    check_text(dark.visibility)
