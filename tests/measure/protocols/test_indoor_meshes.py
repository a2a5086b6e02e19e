"""The evaluation of meshes of rooms equals numpy on the same samples; culling removes what no camera sees."""

import numpy as np
import pytest
from mesh_shapes import spiky_sphere
from optional import import_or_skip
from wording import check_error, check_text

from pcbench import Cloud, Mesh
from pcbench.geometry.cameras import Camera, Intrinsics, look_at
from pcbench.geometry.regions import Box
from pcbench.geometry.transform import Similarity
from pcbench.io.colmap_model import write_colmap_model
from pcbench.io.transforms_json import write_transforms
from pcbench.measure.protocols.indoor_meshes import IndoorMeshes
from pcbench.measure.protocols.protocol import EvaluationInputs
from pcbench.measure.protocols.registry import parse_protocol

NORMALS = ("normal_accuracy", "normal_completion", "normal_consistency")


def values(scores):
    return {score.name: score.value for score in scores}


def sheet(x0, x1, z=0.0, steps=10):
    """The rectangle x0 <= x <= x1, 0 <= y <= 1 at height z, whose normals point upwards."""
    x, y = np.meshgrid(np.linspace(x0, x1, steps + 1), np.linspace(0, 1, steps + 1), indexing="ij")
    rows = np.arange((steps + 1) ** 2).reshape(steps + 1, steps + 1)
    a, b, c, d = rows[:-1, :-1].ravel(), rows[1:, :-1].ravel(), rows[1:, 1:].ravel(), rows[:-1, 1:].ravel()
    vertices = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, z)])
    return Mesh(vertices, np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])]))


def joined(*meshes):
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes[:-1])])
    return Mesh(
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate([mesh.faces + start for mesh, start in zip(meshes, starts, strict=True)]),
    )


@pytest.fixture
def pair():
    vertices, faces = spiky_sphere(1)
    return Mesh(vertices, faces), Mesh(1.03 * vertices, faces)


def test_scores_equal_numpy_on_the_same_samples(pair):
    reference, candidate = pair
    result = IndoorMeshes(samples=1500).evaluate(EvaluationInputs(reference, candidate, seed=4))
    p, q = candidate.sample(1500, 4), reference.sample(1500, 5)
    distances = np.linalg.norm(p.points[:, None] - q.points, axis=2)
    nearest_q, nearest_p = distances.argmin(axis=1), distances.argmin(axis=0)
    a, b = distances.min(axis=1), distances.min(axis=0)
    scores = values(result.scores)
    precision, recall = np.mean(a < 0.05), np.mean(b < 0.05)
    forth = (p.normals * q.normals[nearest_q]).sum(axis=1)
    back = (q.normals * p.normals[nearest_p]).sum(axis=1)
    expected = {
        "accuracy": 100 * a.mean(),
        "completion": 100 * b.mean(),
        "completion_ratio@5cm": recall,
        "precision@5cm": precision,
        "recall@5cm": recall,
        "fscore@5cm": 2 * precision * recall / (precision + recall),
        "normal_accuracy": np.abs(forth).mean(),
        "normal_completion": np.abs(back).mean(),
        "normal_consistency": (np.abs(forth).mean() + np.abs(back).mean()) / 2,
        "normal_accuracy_signed": forth.mean(),
        "normal_completion_signed": back.mean(),
        "normal_consistency_signed": (forth.mean() + back.mean()) / 2,
    }
    assert 0.1 < precision < 0.9
    assert list(scores) == list(expected)
    for name, value in expected.items():
        assert scores[name] == pytest.approx(value, rel=1e-9), name
    check_text("\n".join(result.notes))


def test_the_sign_of_normals_and_the_unit(pair):
    reference, candidate = pair
    inputs = EvaluationInputs(reference, candidate)
    settings = IndoorMeshes(samples=1000)
    scores = values(settings.evaluate(inputs).scores)
    turned = Mesh(candidate.vertices, candidate.faces[:, ::-1])
    reversed_scores = values(settings.evaluate(EvaluationInputs(reference, turned)).scores)
    for name in NORMALS:  # other corners of faces come first, so that the samples differ
        assert reversed_scores[name] == pytest.approx(scores[name], abs=0.03)
        assert reversed_scores[f"{name}_signed"] == pytest.approx(-scores[f"{name}_signed"], abs=0.05)
    in_mm = [Mesh(1000 * mesh.vertices, mesh.faces) for mesh in pair]
    in_mm_scores = values(IndoorMeshes(samples=1000, unit="mm").evaluate(EvaluationInputs(*in_mm)).scores)
    for name, value in scores.items():
        assert in_mm_scores[name] == pytest.approx(value, rel=1e-9)  # 1000 is no power of two


def test_a_pose_and_a_crop():
    reference, candidate = sheet(0, 2), sheet(0, 2, 0.02)
    pose = Similarity(np.eye(3), np.array([0.0, 0, -0.02]))
    half = Box((0, 0, -1), (1, 1, 1))
    result = IndoorMeshes(samples=20_000).evaluate(EvaluationInputs(reference, candidate, pose=pose, crop=half))
    counts = values(result.counts)
    assert counts["candidate_points"] == pytest.approx(10_000, rel=0.03)  # four standard deviations
    assert values(result.scores)["accuracy"] < 1  # half of the spacing of 1 cm: the pose lays them upon each other
    check_text("\n".join(result.notes))


def test_vertices_of_scannet_equal_downsampling_by_open3d(pair):
    o3d = import_or_skip("open3d")
    reference, candidate = (Mesh(*spiky_sphere(3)), Mesh(1.02 * spiky_sphere(3)[0], spiky_sphere(3)[1]))
    result = IndoorMeshes("scannet", voxel_cm=20).evaluate(EvaluationInputs(reference, candidate))

    def downsample(mesh):
        return np.asarray(
            o3d.geometry.PointCloud(o3d.utility.Vector3dVector(mesh.vertices)).voxel_down_sample(0.2).points
        )

    p, q = downsample(candidate), downsample(reference)
    distances = np.linalg.norm(p[:, None] - q, axis=2)
    scores = values(result.scores)
    assert (len(p), len(q)) == tuple(values(result.counts).values())
    assert scores["accuracy"] == pytest.approx(100 * distances.min(axis=1).mean(), rel=1e-9)
    assert scores["recall@5cm"] == np.mean(distances.min(axis=0) < 0.05)
    assert not set(NORMALS) & set(scores)
    check_text("\n".join(result.notes))


def test_clouds_are_used_as_they_are(pair):
    reference = pair[0].sample(500, 1)
    result = IndoorMeshes(samples=400).evaluate(EvaluationInputs(Cloud(reference.points), pair[1]))
    assert values(result.counts) == {"candidate_points": 400, "reference_points": 500}
    assert values(result.scores)["normal_consistency"] is None
    check_text("\n".join(result.notes))


@pytest.fixture
def camera():
    """A camera 2 above the sheet 0 <= x <= 1, of whose edges it sees 0.5 more."""
    return Camera("a.png", Intrinsics(100, 100, 100, 100, 50, 50), look_at((0.5, 0.5, 2), (0.5, 0.5, 0), (0, 1, 0)))


@pytest.mark.parametrize("kind", ["colmap", "transforms"])
def test_culling_to_frames(tmp_path, camera, kind):
    path = tmp_path / "office0" / "cameras.json"
    if kind == "colmap":
        path = tmp_path / "office0"
        write_colmap_model(path, [camera])
    else:
        path.parent.mkdir()
        write_transforms(path, [camera])
    room = joined(sheet(0, 1), sheet(10, 11))  # half of it is far outside the frame
    settings = IndoorMeshes(samples=1000, cameras=str(path.relative_to(tmp_path)).replace("office0", "{scene}"))
    result = settings.evaluate(EvaluationInputs(room, sheet(0, 1), "office0", tmp_path))
    assert values(result.scores)["completion"] < 5  # a few times the spacing of 3 cm: the far half is not expected
    check_text("\n".join(result.notes))
    whole = IndoorMeshes(samples=1000).evaluate(EvaluationInputs(room, sheet(0, 1)))
    assert values(whole.scores)["completion"] > 400


def test_culling_of_hidden_faces(tmp_path, camera):
    write_colmap_model(tmp_path, [camera])
    layers = joined(sheet(0, 1), sheet(0, 1, -0.02), sheet(0, 1, -0.5))  # within and beyond the tolerance of 3 cm
    inputs = EvaluationInputs(layers, layers)
    for occlusion, layers_left in ((False, 3), (True, 2)):
        result = IndoorMeshes(samples=3000, cameras=str(tmp_path), occlusion=occlusion).evaluate(inputs)
        check_text("\n".join(result.notes))
        points = {note for note in result.notes if "culled" in note}
        share = 1 - layers_left / 3
        assert f"{share:.1%}" in points.pop()


def test_unusable_inputs(tmp_path, camera, pair):
    def refuse(settings, reference=pair[0], candidate=pair[1]):
        with check_error():
            parse_protocol(settings).evaluate(EvaluationInputs(reference, candidate, data=tmp_path))

    for settings in ("variant=7scenes", "samples=0", "unit=px", "threshold_cm=-1", "cameras=nowhere.json"):
        refuse(f"mesh:{settings}")
    refuse(f"mesh:cameras={tmp_path}")  # no model
    write_colmap_model(tmp_path / "model", [camera])
    refuse("mesh:cameras=model", candidate=pair[1].sample(10))
    refuse("mesh:cameras=model", candidate=sheet(10, 11))
    refuse("mesh", candidate=Mesh(pair[1].vertices, pair[1].faces, unit="ft"))
