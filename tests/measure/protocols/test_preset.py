"""Presets as protocols: the numbers of `score` and of `measure_preset`, poses, regions, meshes and errors."""

from dataclasses import replace

import numpy as np
import pytest
from wording import check_error, check_text

import pcbench
from pcbench.geometry.neighbors import Index
from pcbench.geometry.polygon_files import read_polygon
from pcbench.geometry.sampling import NeighborRange
from pcbench.measure import presets
from pcbench.measure.protocols.protocol import EvaluationInputs
from pcbench.measure.protocols.registry import parse_protocol

# Sums in another order, and points moved near the origin.
CLOSE = 1e-12


@pytest.fixture(scope="module")
def pair():
    generator = np.random.default_rng(0)
    surface = np.c_[generator.random((2, 400, 2)), generator.normal(0, 0.01, (2, 400, 1))]
    return pcbench.Cloud(surface[0], unit="m"), pcbench.Cloud(surface[1], unit="m")


def values(evaluation):
    return {score.name: score.value for score in evaluation.scores}


def test_the_protocol_of_pcbench_has_the_numbers_of_score(pair):
    evaluation = parse_protocol("pcbench:thresholds=0.05/0.1").evaluate(EvaluationInputs(*pair))
    metrics = ("mean_distance", "d1_rms", "d2_rms", "chamfer", "hausdorff", "fscore")
    expected = pcbench.score(*pair, metrics, (0.05, 0.1)).values()
    assert values(evaluation) == pytest.approx(expected, rel=CLOSE)
    assert evaluation.protocol == "pcbench:thresholds=0.05/0.1"
    assert {score.unit for score in evaluation.scores if score.better == "lower"} == {"m"}
    assert [score.name for score in evaluation.scores if score.better == "higher"] == [
        *("precision@0.05", "recall@0.05", "fscore@0.05", "precision@0.1", "recall@0.1", "fscore@0.1")
    ]
    assert [(count.name, count.value) for count in evaluation.counts] == [
        ("candidate_points", 400),
        ("reference_points", 400),
    ]


def test_a_pose_moves_the_candidate(pair):
    reference, candidate = pair
    pose = pcbench.Similarity.from_matrix([[0, -2, 0, 3], [2, 0, 0, 4], [0, 0, 2, 5], [0, 0, 0, 1]])
    moved = candidate.transformed(pose.inverse())
    inputs = EvaluationInputs(reference, moved, pose=pose)
    protocol = parse_protocol("pcbench")
    # Rounding of coordinates up to 5.
    assert values(protocol.evaluate(inputs)) == pytest.approx(
        values(protocol.evaluate(EvaluationInputs(*pair))), abs=1e-14
    )


def test_a_region_selects_the_queries_of_pcbench_and_crops_the_clouds_of_presets(pair):
    reference, candidate = pair
    box = pcbench.Box([0, 0, -1], [0.5, 1, 1])
    inside, inside_reference = box.contains(candidate.points), box.contains(reference.points)
    evaluation = parse_protocol("pcbench").evaluate(EvaluationInputs(*pair, crop=box))
    a = Index(reference.points).query(candidate.points[inside]).distances
    b = Index(candidate.points).query(reference.points[inside_reference]).distances
    assert values(evaluation)["chamfer"] == pytest.approx(a.mean() + b.mean(), rel=CLOSE)
    assert {count.name: count.value for count in evaluation.counts}["candidate_points_inside"] == inside.sum()
    cropped = pcbench.score(reference.select(inside_reference), candidate.select(inside))
    evaluation = parse_protocol("open3d").evaluate(EvaluationInputs(*pair, crop=box))
    assert values(evaluation)["chamfer"] == pytest.approx(cropped.chamfer, rel=CLOSE)


@pytest.mark.parametrize("name", ["gao2025", "mpeg", "open3d", "pdal"])
def test_presets_have_their_own_numbers(pair, name):
    reference, candidate = pair
    normals = np.tile((0.0, 0.0, 1.0), (400, 1))
    reference = replace(reference, normals=normals)
    index = Index(reference.points)
    cropped = presets.match(index, Index(candidate.points), NeighborRange.within(index), normals, normals)
    result = presets.measure_preset(name, cropped, ())
    scores = values(parse_protocol(name).evaluate(EvaluationInputs(reference, candidate)))
    single = {key: value for key, value in vars(result).items() if isinstance(value, float)}
    assert {key: scores[key] for key in single} == pytest.approx(single, rel=1e-7)  # float32 differences of mpeg
    if name == "mpeg":
        assert scores["d1_mse.symmetric"] == pytest.approx(result.d1_mse.symmetric, rel=1e-7)


def test_units_and_directions_of_presets(pair):
    scores = {score.name: score for score in parse_protocol("mpeg").evaluate(EvaluationInputs(*pair)).scores}
    assert scores["d1_psnr"][2:] == ("dB", "higher") and scores["hausdorff_squared_d1"][2:] == ("m²", "lower")
    assert scores["peak"][2:] == ("m", None)
    scores = {score.name: score for score in parse_protocol("pdal").evaluate(EvaluationInputs(*pair)).scores}
    assert (scores["chamfer"].unit, scores["hausdorff"].unit) == ("m²", "m")


def test_meshes_are_sampled_and_said_to_be(pair, tmp_path):
    square = pcbench.Mesh([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], [[0, 1, 2], [0, 2, 3]])
    evaluation = parse_protocol("pcbench:samples=5000").evaluate(EvaluationInputs(pair[0], square))
    assert evaluation.counts[0].value == 5000
    check_text("\n".join(evaluation.notes))
    assert parse_protocol("pcbench").evaluate(EvaluationInputs(pair[0], square)).counts[0].value == 100_000


def test_files_are_read_again_after_they_change(pair, tmp_path):
    reference, candidate = pair
    path, other = tmp_path / "ref.npy", tmp_path / "a.npy"
    protocol = parse_protocol("pcbench")
    np.save(other, candidate.points)
    for offset in (0.0, 0.5):
        np.save(path, reference.points + offset)
        expected = pcbench.score(reference.points + offset, candidate)
        assert values(protocol.evaluate(EvaluationInputs(path, other)))["chamfer"] == pytest.approx(
            expected.chamfer, rel=CLOSE
        )


def test_two_points_have_no_planes():
    evaluation = parse_protocol("pcbench").evaluate(
        EvaluationInputs(pcbench.Cloud([[0, 0, 0], [1, 0, 0]]), pcbench.Cloud([[0, 0, 1]]))
    )
    assert values(evaluation)["d2_rms.c2r"] is None and values(evaluation)["hausdorff"] == pytest.approx(2**0.5)
    check_text("\n".join(evaluation.notes))


def test_settings_and_regions_are_checked(pair):
    for text in ("pcbench:thresholds=0", "open3d:thresholds=1/1", "pdal:samples=-1", "pdal:thresholds=1", "nothing"):
        with check_error():
            parse_protocol(text)
    with check_error():
        parse_protocol("pcbench").evaluate(EvaluationInputs(*pair, crop=pcbench.Box([9, 9, 9], [10, 10, 10])))


def test_polygons_in_degrees_are_refused(pair, tmp_path):
    (tmp_path / "p.wkt").write_text("POLYGON((15 46.9,15.1 46.9,15.1 47))")
    site = [replace(cloud, points=cloud.points + [500_000, 5_200_000, 0]) for cloud in pair]
    with check_error():
        parse_protocol("pcbench").evaluate(EvaluationInputs(*site, crop=read_polygon(tmp_path / "p.wkt")))


def test_different_units_are_refused_without_a_pose():
    clouds = (pcbench.Cloud(np.eye(3) * scale, unit=unit) for scale, unit in ((1.0, "m"), (1000.0, "mm")))
    inputs = EvaluationInputs(*clouds)
    for protocol in ("pcbench", "pytorch3d"):
        with check_error():
            parse_protocol(protocol).evaluate(inputs)
    scaled = replace(inputs, pose=pcbench.Similarity(np.eye(3), np.zeros(3), 0.001))
    scores = {score.name: score.value for score in parse_protocol("pytorch3d").evaluate(scaled).scores}
    assert scores["chamfer"] < 1e-20  # rounding
