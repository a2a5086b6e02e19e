"""The protocol of ETH3D: the official program's digits, brute force, known answers, and files that it refuses."""

import json
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import oracles
import pytest
import shapes
from data_folder import data_folder
from wording import check_error, check_text

from pcbench import Box, Cloud, Mesh, Similarity, write_cloud
from pcbench.measure.protocols.eth3d import Eth3d
from pcbench.measure.protocols.free_space import _MAX_PAIRS, Beam, FreeSpace, _blocks
from pcbench.measure.protocols.protocol import EvaluationInputs
from pcbench.measure.protocols.registry import parse_protocol
from pcbench.measure.protocols.voxel_grids import VoxelGrids

EYE = np.array([1.0, 2.0, 1.5])  # of the scanner in `room`
TURN = shapes.rotation([0, 0, 1], 30.0)


def project(folder, *scans):
    """Write scans (points, matrix) and their project; return its path."""
    meshes = ""
    for number, (points, matrix) in enumerate(scans):
        write_cloud(folder / f"scan{number}.ply", points)
        rows = "\n".join(" ".join(map(repr, row)) for row in np.asarray(matrix, float).tolist())
        meshes += f'<MLMesh label="x" filename="scan{number}.ply"><MLMatrix44>\n{rows}\n</MLMatrix44></MLMesh>'
    path = folder / "scan_alignment.mlp"
    path.write_text(f"<!DOCTYPE MeshLabDocument>\n<MeshLabProject><MeshGroup>{meshes}</MeshGroup></MeshLabProject>")
    return path


def room(folder, seed=0, count=4000):
    """Write a project with one scan of the walls of a room of 4 x 5 x 3 m; return its path and the scan's points."""
    directions = _directions(count, seed)
    size = np.array([4.0, 5.0, 3.0])
    with np.errstate(divide="ignore"):
        depth = np.where(directions > 0, (size - EYE) / directions, -EYE / directions).min(axis=1)
    points = EYE + depth[:, None] * directions
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = TURN, EYE
    return project(folder, ((points - EYE) @ TURN, pose)), points


def _directions(count, seed):
    vectors = np.random.default_rng(seed).normal(size=(count, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def values(evaluation):
    return {score.name: score.value for score in (*evaluation.scores, *evaluation.counts)}


@pytest.mark.parametrize("case", [0, 1])
def test_the_official_program_prints_the_same_digits(case):
    folder = data_folder("protocols")
    expected = json.loads((folder / "expected.json").read_text())["eth3d"]
    printed = expected["cases"][case]
    protocol = Eth3d(
        tuple(expected["tolerances"]),
        printed["voxel_size"],
        printed["beam_start_radius_m"],
        printed["beam_divergence_halfangle_deg"],
    )
    inputs = EvaluationInputs(folder / "eth3d", folder / "eth3d/reconstruction.ply")
    found = protocol.evaluate(inputs)
    for name in ("completeness", "accuracy", "f1"):
        ours = [f"{score.value:.6g}" for score in found.scores if score.name.startswith(f"{name}@")]
        assert ours == [f"{value:.6g}" for value in printed[name]]
    if case == 0:
        exact = values(replace(protocol, precision="float64").evaluate(inputs))
        # Rounding to float32 moves a few of 4e5 points to the voxel beside.
        assert all(abs(exact[score.name] - score.value) < 1e-5 for score in found.scores)


@pytest.mark.parametrize(("start_radius", "angle_deg"), [(0.05, 1.0), (0.3, 5.0), (0.0, 0.0), (3.0, 0.5)])
def test_free_space_equals_brute_force(start_radius, angle_deg):
    rng = np.random.default_rng(1)
    scan = rng.normal(size=(300, 3)) * [2, 2, 1]
    points = np.concatenate([rng.normal(size=(200, 3)), 0.99 * scan[:20], 0.5 * scan[20:40], np.zeros((1, 3))])
    seen = FreeSpace(scan, Beam(start_radius, np.radians(angle_deg))).observe(points)
    nearest, is_free = oracles.free_space(scan, points, start_radius, np.radians(angle_deg))
    # Points on a ray are in its beam only up to rounding where the beam has no width.
    rows = slice(None) if start_radius else slice(200)
    np.testing.assert_allclose(np.sqrt(seen.squared_distances[rows]), nearest[rows], rtol=0, atol=1e-12)
    np.testing.assert_array_equal(seen.in_free_space[rows], is_free[rows])


def test_single_precision_finds_the_same_pairs_far_from_the_scanner():
    scan = _directions(2000, 2) * 80.0
    points = (scan[:500] * np.random.default_rng(3).uniform(0.2, 1.1, (500, 1))).astype(np.float32)
    exact = FreeSpace(scan, Beam(0.001, 2e-4)).observe(points.astype(float))
    single = FreeSpace(scan.astype(np.float32), Beam(0.001, 2e-4)).observe(points)
    assert single.squared_distances.dtype == np.float32
    np.testing.assert_array_equal(single.in_free_space, exact.in_free_space)
    assert exact.in_free_space.sum() > 300


def test_pairs_are_evaluated_in_blocks_of_bounded_size():
    offsets = np.cumsum([0, 5, 0, _MAX_PAIRS, 1, _MAX_PAIRS * 3, 2, 2])
    blocks = list(_blocks(offsets))
    assert blocks[0][0] == 0
    assert blocks[-1][1] == 7
    assert all(first == last for (_, last), (first, _) in pairwise(blocks))
    assert all(offsets[b] - offsets[a] <= _MAX_PAIRS or b == a + 1 for a, b in blocks)


def test_voxels_weigh_equally_in_both_grids():
    points = np.array([[0.1, 0.1, 0.1]] * 3 + [[0.6, 0.1, 0.1], [2.5, 0.0, 0.0]])
    good = np.array([True, False, False, True, False])
    grids = VoxelGrids(points, 1.0)
    # First grid: {3 + 1 points: 2/4 good}, {0}. Second, shifted by half a voxel: {3: 1/3}, {1: 1}, {1: 0}.
    assert grids.count == 5
    assert grids.mean_share(good, np.ones(5, bool)) == pytest.approx((2 / 4 + 0 + 1 / 3 + 1 + 0) / 5)
    assert grids.mean_share(good, points[:, 0] < 2) == pytest.approx((2 / 4 + 1 / 3 + 1) / 3)
    assert grids.mean_share(good, np.zeros(5, bool)) == 0
    assert VoxelGrids(-points.astype(np.float32), 1.0).count == 5


def test_known_answers_of_a_room(tmp_path):
    path, walls = room(tmp_path)
    on_walls, free, behind = walls[:1000], EYE + 0.5 * (walls[1000:1400] - EYE), EYE + 1.5 * (walls[1400:1500] - EYE)
    found = values(
        Eth3d((0.001, 10.0)).evaluate(EvaluationInputs(path, Cloud(np.concatenate([on_walls, free, behind]))))
    )
    assert (found["scan_points"], found["candidate_points"]) == (4000, 1500)
    # Places behind the walls are not observed; hardly two points share a voxel of 1 cm.
    assert found["accuracy@0.001"] == pytest.approx(1000 / 1400, abs=0.003)
    assert found["completeness@0.001"] == pytest.approx(1000 / 4000, abs=0.003)
    a, c = np.float32(found["accuracy@0.001"]), np.float32(found["completeness@0.001"])
    assert found["f1@0.001"] == float(2 * (a * c) / (a + c))  # rounded at each step, as the official program rounds it
    assert (found["completeness@10"], found["f1@10"], found["unobserved_points"]) == (1, 1, 0)


def test_the_pose_of_the_candidate_and_a_crop_are_applied(tmp_path):
    path, walls = room(tmp_path)
    pose = Similarity(shapes.rotation([1, 2, 3], 40.0), np.array([5.0, -3.0, 2.0]), 2.0)
    protocol = Eth3d((0.02, 0.1), precision="float64")
    plain = protocol.evaluate(EvaluationInputs(path, Cloud(walls[:500])))
    moved = protocol.evaluate(EvaluationInputs(path, Cloud(pose.inverse().apply(walls[:500])), pose=pose))
    assert [s.value for s in moved.scores] == pytest.approx([s.value for s in plain.scores], abs=0.01)
    crop = Box([-1, -1, -1], [1.5, 9, 9])
    cropped = values(protocol.evaluate(EvaluationInputs(path, Cloud(walls[:500]), crop=crop)))
    assert cropped["scan_points"] == crop.contains(walls).sum()
    assert cropped["candidate_points"] == crop.contains(walls[:500]).sum()


def test_meshes_are_sampled_by_area(tmp_path, monkeypatch):
    monkeypatch.setattr("pcbench.measure.protocols.eth3d.REFERENCE_SAMPLES", 5000)
    path, _ = room(tmp_path)
    floor = Mesh(np.array([[0.0, 0, 0], [4, 0, 0], [4, 5, 0], [0, 5, 0]]), np.array([[0, 1, 2], [0, 2, 3]]))
    found = Eth3d((0.1,)).evaluate(EvaluationInputs(path, floor))
    assert values(found)["candidate_points"] == 5000
    assert values(found)["accuracy@0.1"] == 1
    for note in found.notes:
        check_text(note)


def test_a_candidate_in_other_coordinates_is_named(tmp_path):
    path, walls = room(tmp_path)
    found = Eth3d().evaluate(EvaluationInputs(path, Cloud(walls + 1e4)))
    assert all(score.value == 0 for score in found.scores)
    check_text(found.notes[0])


def test_a_point_at_the_scanner_is_in_the_beams_of_all_points_in_front_of_it(tmp_path):
    path, _ = room(tmp_path)
    found = values(Eth3d((0.01,)).evaluate(EvaluationInputs(path, Cloud(EYE[None] + 0.0005))))
    assert (found["unobserved_points"], found["accuracy@0.01"]) == (0, 0)


def test_settings_are_parsed_sorted_and_checked():
    assert parse_protocol("eth3d:tolerances=0.1/0.01/0.1").tolerances == (0.01, 0.1)
    for text in (
        "tolerances=-1", "tolerances=nan", "tolerances=1e300", "tolerances=x", "voxel_size=0", "beam_start_radius=-1",
        "beam_divergence_halfangle_deg=90", "precision=half",
    ):  # fmt: skip
        with check_error():
            parse_protocol(f"eth3d:{text}")


def test_unusable_references_and_candidates_are_refused(tmp_path):
    path, walls = room(tmp_path)
    candidate, rigid = Cloud(walls[:10]), np.eye(4)
    with check_error():  # the scan alone does not tell where its scanner was
        Eth3d().evaluate(EvaluationInputs(tmp_path / "scan0.ply", candidate))
    with check_error():
        Eth3d().evaluate(EvaluationInputs(Cloud(walls), candidate, data=tmp_path / "none", scene="pipes"))
    with check_error():
        Eth3d().evaluate(EvaluationInputs(path, Cloud(walls + 1e20)))
    with check_error():
        Eth3d().evaluate(EvaluationInputs(path, Cloud(walls, unit="mm")))
    for number, matrix in enumerate((np.diag([2.0, 2, 2, 1]), np.diag([-1.0, 1, 1, 1]), rigid + 1, 1e20 * rigid)):
        folder = tmp_path / str(number)
        folder.mkdir()
        with check_error():
            Eth3d().evaluate(EvaluationInputs(project(folder, (walls, matrix)), candidate))
    (tmp_path / "zero").mkdir()
    with check_error():
        Eth3d().evaluate(EvaluationInputs(project(tmp_path / "zero", (np.zeros((1, 3)), rigid)), candidate))
    (tmp_path / "scan0.ply").unlink()
    with check_error():
        Eth3d().evaluate(EvaluationInputs(path, candidate))


def test_projects_are_found_in_the_folder_of_the_scene(tmp_path):
    folder = tmp_path / "data/pipes/dslr_scan_eval"
    folder.mkdir(parents=True)
    path, walls = room(folder)
    inputs = EvaluationInputs(path, Cloud(walls[:50]))
    expected = Eth3d().evaluate(inputs)
    assert Eth3d().evaluate(replace(inputs, reference=tmp_path / "data/pipes")) == expected
    named = replace(inputs, reference=Path("pipes"), scene="pipes", data=tmp_path / "data")
    assert Eth3d().evaluate(named) == expected
