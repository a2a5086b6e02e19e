"""The evaluation of DTU equals the official program, and its steps equal loops over points and faces."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from data_folder import data_folder
from mesh_shapes import cube
from scipy.io import savemat
from wording import check_error, check_text

from pcbench import Cloud, Mesh, write_cloud
from pcbench.geometry.regions import Box
from pcbench.geometry.transform import Similarity
from pcbench.io.ply import write_ply_mesh
from pcbench.measure.protocols.dtu import Dtu
from pcbench.measure.protocols.dtu_data import scan_number
from pcbench.measure.protocols.mesh_grid import grid_points
from pcbench.measure.protocols.protocol import EvaluationInputs
from pcbench.measure.protocols.registry import parse_protocol

BOX = np.array([[0.0, 0, 0], [100, 80, 40]])  # mm: with blocks of 60 mm up to 120, 120, 60
SIDE = 2.0


def values(scores):
    return {score.name: score.value for score in scores}


@pytest.mark.parametrize("name", ["points007.ply", "mesh007.ply"])
def test_scores_equal_those_of_the_official_program(name):
    folder = data_folder("protocols") / "dtu"
    expected = json.loads((folder.parent / "expected.json").read_text())["dtu"][name]
    result = Dtu(orders=3).evaluate(EvaluationInputs(folder, folder / name, "scan7"))
    scores, counts = values(result.scores), values(result.counts)
    for metric in ("accuracy", "completeness"):
        # The means over six and three random orders have a difference with a standard deviation of 0.7 `sd`, where
        # `sd` is itself known to a third.
        assert scores[metric] == pytest.approx(expected[metric], abs=3 * expected[f"{metric}_sd"])
        assert counts[f"{metric}_sd"] < 4 * expected[f"{metric}_sd"]
    assert scores["overall"] == pytest.approx((scores["accuracy"] + scores["completeness"]) / 2, rel=1e-12)
    assert counts.get("candidate_points") == expected.get("points_sampled")  # the grid is not random
    assert counts["points_thinned"] == pytest.approx(expected["points_thinned"], rel=2e-3)
    assert counts["points_in_mask"] == pytest.approx(expected["points_in_mask"], rel=2e-3)
    assert counts["reference_above_plane"] == 56389
    assert [score.unit for score in result.scores] == ["mm"] * 3


@pytest.fixture
def data(tmp_path):
    """A scan whose mask lacks one half of the box, and whose ground plane is z = 5."""
    rng = np.random.default_rng(5)
    mask = rng.random((51, 41, 21)) < 0.5
    mask[:25] = False
    folder = tmp_path / "data"
    (folder / "ObsMask").mkdir(parents=True)
    (folder / "Points" / "stl").mkdir(parents=True)
    savemat(folder / "ObsMask" / "ObsMask3_10.mat", {"ObsMask": mask.astype(np.uint8), "BB": BOX, "Res": SIDE})
    savemat(folder / "ObsMask" / "Plane3.mat", {"P": np.array([[0.0], [0], [1], [-5]])})
    points = rng.random((2000, 3)) * [200, 120, 80] - 40
    write_cloud(folder / "Points" / "stl" / "stl003_total.ply", Cloud(points))
    return folder


@pytest.fixture
def candidate():
    """Points farther apart than the thinning, inside the box and far around it."""
    points = np.random.default_rng(6).random((4000, 3)) * [500, 400, 300] - 150
    return points[np.unique((points // 3).astype(int), axis=0, return_index=True)[1]]


@pytest.mark.parametrize("variant", ["python", "matlab"])
def test_mask_plane_and_box_equal_a_loop_over_points(data, candidate, variant):
    from scipy.io import loadmat

    mask = loadmat(data / "ObsMask" / "ObsMask3_10.mat")["ObsMask"]
    candidate = candidate.astype(np.float32).astype(float)  # no coordinate on a border is rounded
    reference = np.asarray(Cloud(np.array(read_points(data))).points)
    result = Dtu(variant, thinning=1e-3).evaluate(EvaluationInputs(data, Cloud(candidate), "3"))

    def observed(point):
        cell = np.round(point / SIDE).astype(int)
        return (cell >= 0).all() and (cell < mask.shape).all() and bool(mask[tuple(cell)])

    def in_blocks(point):
        return (point >= 0).all() and (point < [120, 120, 60]).all()

    def mean_distance(queries, targets):
        distances = np.array([np.linalg.norm(targets - point, axis=1).min() for point in queries])
        return distances[distances < 20].mean(), np.count_nonzero(distances >= 20)

    near = (candidate >= BOX[0] - 60) & (candidate < BOX[1] + 120)
    targets = candidate[near.all(axis=1)] if variant == "python" else candidate
    inside = [p for p in candidate if observed(p) and (variant == "python" or in_blocks(p))]
    above = [p for p in reference if p[2] > 5 and (variant == "python" or in_blocks(p))]
    accuracy, accuracy_excluded = mean_distance(inside, reference)
    completeness, completeness_excluded = mean_distance(above, targets)
    scores, counts = values(result.scores), values(result.counts)
    assert scores["accuracy"] == pytest.approx(accuracy, rel=1e-12)
    assert scores["completeness"] == pytest.approx(completeness, rel=1e-12)
    assert (counts["points_in_mask"], counts["reference_above_plane"]) == (len(inside), len(above))
    assert (counts["accuracy_excluded"], counts["completeness_excluded"]) == (accuracy_excluded, completeness_excluded)
    assert completeness_excluded > 0  # so that the case tests the cap
    check_text("\n".join(result.notes))


def read_points(data):
    from pcbench import read_cloud

    return read_cloud(data / "Points" / "stl" / "stl003_total.ply").points


def test_a_grid_on_faces_equals_a_loop_over_faces():
    rng = np.random.default_rng(8)
    vertices = rng.random((30, 3)) * 4
    faces = np.array([rng.choice(30, 3, replace=False) for _ in range(40)] + [[0, 1, 1]])  # the last without area
    spacing, expected = 0.3, [vertices]
    for a, b, c in vertices[faces[:-1]]:
        first, second = b - a, c - a
        lengths = np.linalg.norm(first), np.linalg.norm(second)
        step = spacing * np.sqrt(lengths[0] * lengths[1] / np.linalg.norm(np.cross(first, second)))
        rows, columns = (int(length // step) for length in lengths)
        for i in range(rows):
            for j in range(columns):
                s, t = (i + 0.5) / rows, (j + 0.5) / columns
                if s + t < 1:
                    expected.append([first * s + second * t + a])
    expected = np.concatenate(expected)
    points = grid_points(Mesh(vertices, faces), spacing)
    assert np.allclose(points, expected, rtol=0, atol=1e-14)  # sums of three products, in another order at most


def test_large_faces_are_sampled_in_blocks(monkeypatch):
    mesh = Mesh(*cube())
    expected = grid_points(mesh, 0.05)
    monkeypatch.setattr("pcbench.measure.protocols.mesh_grid._BLOCK_CELLS", 7)
    assert np.array_equal(grid_points(mesh, 0.05), expected)
    with check_error():
        grid_points(mesh, 1e-6)


def test_a_mesh_and_a_pose(data, tmp_path):
    mesh = Mesh(*cube(20, (60, 40, 20)))
    pose = Similarity(np.eye(3), np.array([10.0, -5, 3]))
    expected = Dtu(thinning=1.0).evaluate(EvaluationInputs(data, mesh, "scan3"))
    moved = replace(mesh, vertices=mesh.vertices - pose.translation)
    result = Dtu(thinning=1.0).evaluate(EvaluationInputs(data, moved, "scan3", pose=pose))
    for score, other in zip(result.scores, expected.scores, strict=True):
        assert score.value == pytest.approx(other.value, rel=1e-3)  # rounding may change which points are kept
    write_ply_mesh(tmp_path / "scan3.ply", mesh)  # as a file, which has the scan in its name
    assert Dtu(thinning=1.0).evaluate(EvaluationInputs(data, tmp_path / "scan3.ply")).scores == expected.scores
    check_text("\n".join(expected.notes))


def test_a_file_without_faces_is_a_cloud(data, tmp_path):
    vertices = cube(20, (60, 40, 20))[0]
    header = f"ply\nformat ascii 1.0\nelement vertex {len(vertices)}\n" + "".join(
        f"property float {axis}\n" for axis in "xyz"
    )
    rows = "\n".join(" ".join(map(str, row)) for row in vertices)
    path = tmp_path / "scan3.ply"
    path.write_text(f"{header}element face 0\nproperty list uchar int vertex_indices\nend_header\n{rows}\n")
    assert values(Dtu().evaluate(EvaluationInputs(data, path)).counts)["points_thinned"] == 8


def test_places_of_the_files(data, candidate):
    stl = data / "Points" / "stl" / "stl003_total.ply"
    expected = Dtu().evaluate(EvaluationInputs(data, Cloud(candidate), "scan3"))
    assert Dtu().evaluate(EvaluationInputs(stl, Cloud(candidate))) == expected  # from the place of the reference
    assert Dtu().evaluate(EvaluationInputs(stl, Cloud(candidate), "scan3", data)) == expected
    in_memory = Cloud(read_points(data))
    assert Dtu().evaluate(EvaluationInputs(in_memory, Cloud(candidate), "scan3", data)) == expected
    for file in data.rglob("*.*"):
        file.rename(data / file.name)  # a folder with the files alone
    assert Dtu().evaluate(EvaluationInputs(data, Cloud(candidate), "scan3")) == expected


def test_a_candidate_elsewhere_has_no_accuracy(data, candidate):
    result = Dtu().evaluate(EvaluationInputs(data, Cloud(candidate / 1000), "3"))
    assert values(result.scores)["accuracy"] is None and values(result.scores)["overall"] is None
    check_text("\n".join(result.notes))


@pytest.mark.parametrize(
    "names, number",
    [
        (("scan24",), 24),
        (("007",), 7),
        (("24",), 24),
        (("DTU/Scan_114_v2",), 114),
        (("", "stl024_total"), 24),
        (("bear", "mvsnet009_l3"), 9),
    ],
)
def test_the_number_of_a_scan(names, number):
    assert scan_number(*names) == number


def test_unusable_names_and_settings():
    for names in (("bear",), ("1 or 2",), ("scan999",), ("", "")):
        with check_error():
            scan_number(*names)
    for text in ("dtu:variant=octave", "dtu:thinning=0", "dtu:orders=0", "dtu:variant=matlab,max_distance=100"):
        with check_error():
            parse_protocol(text)
    assert parse_protocol("dtu:max_distance=10") == Dtu(max_distance=10.0)


def test_unusable_files(data, candidate, tmp_path):
    def refuse(**changes):
        inputs = EvaluationInputs(data, Cloud(candidate), "scan3")
        with check_error():
            Dtu().evaluate(replace(inputs, **changes))

    refuse(scene="scan4")
    refuse(crop=Box((0, 0, 0), (1, 1, 1)))
    refuse(reference=Cloud(candidate))  # without a folder
    mask, plane = data / "ObsMask" / "ObsMask3_10.mat", data / "ObsMask" / "Plane3.mat"
    savemat(plane, {"P": np.ones(3)})
    refuse()
    for other in ({"Q": np.ones(4)}, {"P": "text"}, {"P": {"a": 1}}):
        savemat(plane, other)
        refuse()
    content = mask.read_bytes()
    for damaged in (content[:150], b"nothing of the kind" * 20):
        mask.write_bytes(damaged)
        refuse()
    mask.write_bytes(b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM" + b"\x89HDF\r\n\x1a\n" + bytes(500))
    refuse()
    savemat(mask, {"ObsMask": np.ones((2, 2)), "BB": BOX, "Res": SIDE})
    refuse()
    savemat(mask, {"ObsMask": np.ones((2, 2, 2)), "BB": BOX[::-1], "Res": SIDE})
    refuse()


def test_a_candidate_in_another_unit_is_refused(data, candidate):
    with check_error():
        Dtu().evaluate(EvaluationInputs(data, Cloud(candidate / 1000, unit="m"), "3"))


def test_a_reference_beside_no_mask(tmp_path):
    write_cloud(tmp_path / "stl003_total.ply", Cloud(np.zeros((1, 3))))
    with check_error():
        Dtu().evaluate(EvaluationInputs(Path(tmp_path / "stl003_total.ply"), Cloud(np.zeros((1, 3)))))
