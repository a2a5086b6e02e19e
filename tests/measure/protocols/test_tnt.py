"""The protocol of Tanks and Temples: the official program's digits, files of scenes, poses, and what is refused."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import shapes
from data_folder import data_folder
from trajectories import SCAN_FROM_CANDIDATE, SCAN_FROM_SFM, circle, log_text, scene_folder
from wording import check_error, check_text

from pcbench import Box, Cloud, Mesh, write_cloud
from pcbench.geometry.polygon_files import read_polygon
from pcbench.geometry.transform import read_matrix
from pcbench.io.tanks_and_temples import SCENE_THRESHOLDS
from pcbench.measure.presets import tnt_fscore
from pcbench.measure.protocols.protocol import EvaluationInputs
from pcbench.measure.protocols.registry import parse_protocol
from pcbench.measure.protocols.tnt import TanksAndTemples

VOLUME = (2.0, 2.0, -10.0, 38.0, 38.0, 10.0)


def values(evaluation):
    return {score.name: score.value for score in (*evaluation.scores, *evaluation.counts)}


@pytest.mark.parametrize("threshold", ["0.01", "0.02", "0.05"])
def test_the_official_program_prints_the_same_digits(threshold):
    folder = data_folder("protocols")
    expected = json.loads((folder / "expected.json").read_text())["tnt"][threshold]
    pose, crop = read_matrix(folder / "tnt/alignment.txt"), read_polygon(folder / "tnt/crop.json")
    inputs = EvaluationInputs(folder / "tnt/gt.ply", folder / "tnt/reconstruction.ply", pose=pose, crop=crop)
    found = values(parse_protocol(f"tnt:threshold={threshold}").evaluate(inputs))
    # Another order of sums may move the mean of a voxel, and with it one of 30,000 distances across the threshold.
    assert {name: found[f"{name}@{threshold}"] for name in expected} == pytest.approx(expected, abs=1e-4)


def test_distances_equal_to_the_threshold_do_not_count():
    a = np.array([[0.0, 0, 0], [10, 0, 0]])
    b = a + [0.5, 0, 0]
    assert tnt_fscore(a, b, 0.5)[0] == (0.5, 0, 0, 0)
    assert tnt_fscore(a, b, 0.5001)[0] == (0.5001, 1, 1, 1)


@pytest.fixture
def scene(tmp_path):
    """Inputs whose files are those of the scene `Hill`; the candidate is in the coordinates of its reconstruction."""
    scan, candidate = shapes.terrain(6000, seed=1)[0], shapes.terrain(6000, seed=2)[0]
    folder = scene_folder(tmp_path / "data/Hill", "Hill", scan, circle(), VOLUME)
    write_cloud(tmp_path / "mine.ply", SCAN_FROM_SFM.inverse().apply(candidate))
    return EvaluationInputs(folder / "Hill.ply", tmp_path / "mine.ply")


def test_without_a_trajectory_the_scene_places_the_candidate_and_icp_refines_it(scene):
    protocol = TanksAndTemples(0.4)
    found = protocol.evaluate(scene)
    assert values(found)["fscore@0.4"] > 0.7
    # Point-to-point ICP shrinks a candidate that is sampled elsewhere than the scan, by 0.2 %.
    assert values(found)["scale"] == pytest.approx(SCAN_FROM_SFM.scale, rel=5e-3)
    exact = replace(protocol, refine=False).evaluate(scene)
    assert values(exact)["scale"] == pytest.approx(SCAN_FROM_SFM.scale, rel=1e-12)
    given = protocol.evaluate(replace(scene, pose=SCAN_FROM_SFM))
    assert given.scores == exact.scores
    for evaluation in (found, exact, given):
        check_text(evaluation.notes[0])


def test_a_trajectory_beside_the_candidate_registers_it(scene, tmp_path):
    to_candidate = SCAN_FROM_CANDIDATE.inverse()
    write_cloud(tmp_path / "mine.ply", to_candidate.apply(shapes.terrain(6000, seed=2)[0]))
    (tmp_path / "mine.log").write_text(log_text(to_candidate.apply(circle())))
    found = TanksAndTemples(0.4).evaluate(scene)
    assert values(found)["scale"] == pytest.approx(SCAN_FROM_CANDIDATE.scale, rel=5e-3)  # as above
    assert (values(found)["cameras"], values(found)["cameras_aligned"]) == (40, 40)
    assert values(found)["fscore@0.4"] > 0.7
    (tmp_path / "mine.log").rename(tmp_path / "Hill.log")
    named = TanksAndTemples(0.4, trajectory=str(tmp_path / "{scene}.log"))
    assert named.evaluate(scene).scores == found.scores
    check_text(found.notes[0])
    unrefined = replace(named, refine=False).evaluate(scene)
    assert "icp_iterations" not in values(unrefined)
    check_text(unrefined.notes[0])


def test_scenes_have_their_official_thresholds_and_files_in_the_data_folder(scene, tmp_path):
    assert SCENE_THRESHOLDS["Ignatius"] == 0.003
    for name in ("ply", "json", "log", "txt"):
        for file in (tmp_path / "data/Hill").glob(f"*.{name}"):
            file.rename(file.with_name(file.name.replace("Hill", "Church")))
    (tmp_path / "data/Hill").rename(tmp_path / "data/Church")
    by_data = replace(scene, reference=tmp_path / "data/Church/Church.ply", data=tmp_path / "data", scene="Church")
    found = TanksAndTemples(refine=False).evaluate(by_data)
    assert found.protocol == "tnt:refine=false"
    assert [score.name for score in found.scores] == ["precision@0.025", "recall@0.025", "fscore@0.025"]
    by_folder = replace(by_data, reference=tmp_path / "data/Church", data=None)
    assert TanksAndTemples(refine=False).evaluate(by_folder).scores == found.scores


def test_a_crop_replaces_the_volume_and_a_mesh_is_sampled(scene):
    low, high = np.array([0.0, 0.0, -20]), np.array([40.0, 20.0, 20])
    protocol = TanksAndTemples(0.4, refine=False)
    found = values(protocol.evaluate(replace(scene, crop=Box(low, high))))
    assert 0.4 < found["reference_points"] / values(protocol.evaluate(scene))["reference_points"] < 0.7
    floor = Mesh(np.array([[0.0, 0, 0], [40, 0, 0], [40, 40, 0]]), np.array([[0, 1, 2]]))
    sampled = protocol.evaluate(replace(scene, candidate=floor))
    assert len(sampled.notes) == 2
    check_text(sampled.notes[1])


@pytest.mark.parametrize(("points", "count"), [("vertices", 3), ("centers", 4)])
def test_a_mesh_may_be_its_vertices_and_centroids(scene, points, count):
    corners = SCAN_FROM_SFM.inverse().apply(np.array([[5.0, 5, 0], [35, 5, 0], [20, 35, 0]]))
    protocol = TanksAndTemples(0.4, refine=False, mesh=points)
    found = protocol.evaluate(replace(scene, candidate=Mesh(corners, np.array([[0, 1, 2]]))))
    assert values(found)["candidate_points"] == count
    check_text(found.notes[1])


def test_a_candidate_outside_the_volume_has_zero_scores(scene):
    outside = replace(scene, candidate=Cloud(np.ones((5, 3)) * 1e6), pose=SCAN_FROM_SFM)
    for inputs in (outside, replace(outside, crop=Box([0, 0, -10], [9, 9, 10]))):
        found = TanksAndTemples(0.4).evaluate(inputs)
        assert [score.value for score in found.scores] == [0, 0, 0]
        check_text(found.notes[1])


def test_missing_files_and_names_are_refused(scene, tmp_path):
    protocol = TanksAndTemples(0.4)
    with check_error():
        TanksAndTemples(-1.0)
    with check_error():
        TanksAndTemples(mesh="faces")
    with check_error():  # Hill is no scene of the benchmark
        TanksAndTemples().evaluate(scene)
    with check_error():
        protocol.evaluate(EvaluationInputs(Cloud(np.ones((3, 3))), scene.candidate))
    with check_error():
        protocol.evaluate(replace(scene, reference=Path(scene.candidate), data=tmp_path / "none"))
    with check_error():
        protocol.evaluate(replace(scene, reference=Path(scene.candidate), pose=SCAN_FROM_SFM))
    with check_error():
        replace(protocol, trajectory="missing.log").evaluate(scene)
    for name in ("Hill_trans.txt", "Hill.json"):
        (tmp_path / "data/Hill" / name).unlink()
        with check_error():
            protocol.evaluate(scene)
