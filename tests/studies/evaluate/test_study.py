"""The folder of an evaluation: all files, resumed runs, failures beside results, and the Python function."""

import json
from pathlib import Path

import numpy as np
import pytest
from html_pages import HOSTILE, Page
from optional import import_or_skip
from task_pools import tasks_in_process  # noqa: F401  # a fixture
from wording import check_error, check_text

import pcbench
from pcbench.geometry.transform import Similarity, format_matrix
from pcbench.studies.evaluate import runs
from pcbench.studies.evaluate.plan import EvaluationPlan, PlannedPair
from pcbench.studies.evaluate.results import KIND, EvaluateSettings
from pcbench.studies.evaluate.study import run_evaluation, shared_settings
from pcbench.studies.evaluate.table import shown_mean_rows

METHODS = {"good": 0.01, "bad": 0.05}


def write_scenes(folder, scenes=3, methods=METHODS):
    """Write a plane with noise for each scene and method, and return the patterns."""
    for scene in range(scenes):
        for method, noise in {"gt": 0.0, **methods}.items():
            generator = np.random.default_rng((scene, len(method)))
            points = np.c_[generator.random((200, 2)), generator.normal(0, noise, 200) if noise else np.zeros(200)]
            file = folder / method / f"s{scene}.npy"
            file.parent.mkdir(exist_ok=True)
            np.save(file, points)
    return str(folder / "gt" / "{scene}.npy"), str(folder / "{method}" / "{scene}.npy")


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """Folder with scenes and their evaluation on two workers, and its result."""
    folder = tmp_path_factory.mktemp("evaluation")
    reference, _ = write_scenes(folder)
    candidates = [str(folder / method / "{scene}.npy") for method in METHODS]
    study = pcbench.evaluate(
        reference,
        candidates,
        columns=("chamfer", "fscore@0.05"),  # the threshold becomes one of the protocol
        workers=2,
        out=folder / "out",
    )
    return folder, study


def test_the_best_method_is_the_answer(finished):
    _, study = finished
    assert study.is_complete and study.methods == ("good", "bad") and study.scenes == ("s0", "s1", "s2")
    assert [(mean.method, mean.rank) for mean in study.means_of("chamfer")] == [("good", 1), ("bad", 2)]
    for sentence in (*study.sentences, *study.warnings):
        check_text(sentence)
    for pair in study.pairs:
        folder = finished[0]
        clouds = (np.load(folder / kind / f"{pair.scene}.npy") for kind in ("gt", pair.method))
        expected = pcbench.score(*clouds).chamfer
        assert pair.scores["chamfer"] == pytest.approx(expected, rel=1e-12)  # sums of points moved near the origin


def test_the_scores_of_one_method_are_one_sentence_and_rows(tmp_path):
    reference, _ = write_scenes(tmp_path, 1)
    study = pcbench.evaluate(reference, [str(tmp_path / "good" / "{scene}.npy")])
    (sentence,) = study.sentences
    check_text(sentence)
    header, *rows = shown_mean_rows(study)
    assert [cell.text for cell in header] == ["score", "good"]
    assert len(rows) == len(study.chosen_columns) and {len(row) for row in rows} == {2}


def test_all_files_have_the_same_numbers(finished):
    folder, study = finished
    out = folder / "out"
    assert KIND.read(out) == study
    document = json.loads((out / "evaluate.json").read_text())
    assert document["schema"] == "pcbench.evaluate/1"
    assert document["pairs"][0]["scores"]["chamfer"] == study.pairs[0].scores["chamfer"]
    own = json.loads((out / "pairs" / "good_s0" / "evaluation.json").read_text())
    assert own["pair"]["scores"] == document["pairs"][0]["scores"] and own["schema"] == "pcbench.evaluation/1"
    lines = (out / "evaluate.csv").read_text().splitlines()
    assert len(lines) == 1 + 6 * len(study.columns)
    check_text((out / "evaluate.tex").read_text())
    check_text((out / "evaluate.md").read_text().split("## Provenance")[0])


def test_pages_link_to_the_pairs_and_back(finished):
    folder, study = finished
    page = Page((folder / "out" / "report.html").read_text())
    links = {value for name, value in page.attributes if name == "href"}
    assert {f"./{pair.folder}/report.html" for pair in study.pairs} <= links
    own = Page((folder / "out" / study.pairs[0].folder / "report.html").read_text())
    assert ("href", "./../../report.html") in own.attributes
    assert page.unbalanced == own.unbalanced == []


def test_tables_are_tidy(finished):
    import_or_skip("pandas")
    _, study = finished
    table = study.table()
    assert len(table) == 6 * len(study.columns) and set(table["status"]) == {"ok"}
    pivot = table[table["score"] == "chamfer"].pivot(index="scene", columns="method", values="value")
    means = study.means_table()
    chamfer = means[means["score"] == "chamfer"].set_index("method")["mean"]
    assert pivot.mean().to_dict() == pytest.approx(chamfer.to_dict())


@pytest.mark.usefixtures("tasks_in_process")
def test_finished_pairs_are_not_evaluated_again(finished, tmp_path):
    reference, _ = write_scenes(tmp_path, 2, {"good": 0.01})
    arguments = {"protocol": "open3d", "workers": 1, "out": tmp_path / "out"}
    pattern = str(tmp_path / "good" / "{scene}.npy")
    first = pcbench.evaluate(reference, pattern, **arguments)
    np.save(tmp_path / "good" / "s1.npy", np.load(tmp_path / "good" / "s0.npy"))
    second = pcbench.evaluate(reference, pattern, **arguments)
    times = [
        (a.evaluation_s == b.evaluation_s, a.scores == b.scores) for a, b in zip(first.pairs, second.pairs, strict=True)
    ]
    assert times == [(True, True), (False, False)]  # the second file has changed
    third = pcbench.evaluate(reference, pattern, **{**arguments, "protocol": "pdal"})
    assert third.pairs[0].scores != first.pairs[0].scores


@pytest.mark.usefixtures("tasks_in_process")
def test_files_beside_the_inputs_are_inputs_of_a_resumed_run(tmp_path):
    barn = tmp_path / "Barn"
    barn.mkdir()
    points = np.random.default_rng(0).random((500, 3))
    for file in (barn / "Barn.npy", tmp_path / "candidate.npy"):
        np.save(file, points)
    (barn / "Barn_trans.txt").write_text(format_matrix(Similarity.identity()))

    def points_inside(height):
        volume = {"class_name": "SelectionPolygonVolume", "orthogonal_axis": "Z", "axis_min": -1, "axis_max": height}
        volume["bounding_polygon"] = [[-1, -1, 0], [2, -1, 0], [2, 2, 0], [-1, 2, 0]]
        (barn / "Barn.json").write_text(json.dumps(volume))
        pair = PlannedPair("Barn", "ours", str(barn / "Barn.npy"), str(tmp_path / "candidate.npy"))
        missing = PlannedPair("Truck", "ours", "", "", missing="no file")
        settings = EvaluateSettings("tnt:refine=false,threshold=0.1", None, (), 0, 1, None)
        study = run_evaluation(EvaluationPlan((pair, missing)), settings, out=tmp_path / "out", figures=False).study
        return study.pairs[0].counts["candidate_points"]

    assert points_inside(2.0) > 1.5 * points_inside(0.5)


@pytest.mark.usefixtures("tasks_in_process")
def test_a_pair_that_fails_is_a_row(tmp_path):
    reference, _ = write_scenes(tmp_path, 2)
    (tmp_path / "bad" / "s0.npy").write_bytes(b"no array")
    (tmp_path / "bad" / "s1.npy").unlink()
    candidates = [str(tmp_path / method / "{scene}.npy") for method in METHODS]
    study = pcbench.evaluate(reference, candidates, workers=1, out=tmp_path / "out")
    assert [(pair.method, pair.status) for pair in study.pairs] == [
        *(("good", "ok"), ("bad", "failed"), ("good", "ok"), ("bad", "missing"))
    ]
    assert not study.is_complete and {mean.scenes for mean in study.means_of("chamfer")} == {0, 2}
    for sentence in (*study.sentences, *study.warnings):
        check_text(sentence)
    write_scenes(tmp_path, 2)
    assert pcbench.evaluate(reference, candidates, workers=1, out=tmp_path / "out").is_complete


def test_bugs_and_lost_memory_are_rows_too(tmp_path, monkeypatch):
    write_scenes(tmp_path, 1)
    pair = PlannedPair("s0", "good", str(tmp_path / "gt/s0.npy"), str(tmp_path / "good/s0.npy"))
    shared = shared_settings(None, "pcbench", None, 0)
    for error in (ValueError("wrong"), MemoryError(), OSError(28, "no space", "x.ply")):

        def fail(*_, error=error):
            raise error

        monkeypatch.setattr(runs, "_evaluate", fail)
        record = runs.evaluate_task(shared, runs.PairTask(pair, ""), lambda _: None)
        assert record.pair.status == "failed"
        check_text(record.pair.message)


def test_a_pose_a_region_and_a_registration_apply_to_each_pair(tmp_path):
    write_scenes(tmp_path, 1)
    candidate, reference = np.load(tmp_path / "good/s0.npy"), np.load(tmp_path / "gt/s0.npy")
    shift = np.array([0.0, 0.0, 7.0])
    np.save(tmp_path / "moved.npy", candidate - shift)
    np.savetxt(tmp_path / "pose.txt", [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 7], [0, 0, 0, 1]])
    (tmp_path / "pairs.csv").write_text(
        'reference,candidate,scene,method,pose,crop\ngt/s0.npy,moved.npy,s0,moved,pose.txt,"box:0,0,-1,0.5,1,1"\n'
    )
    (pair,) = pcbench.evaluate(pairs=tmp_path / "pairs.csv").pairs
    box = pcbench.Box([0, 0, -1], [0.5, 1, 1])
    a = pcbench.Index(reference).query(candidate[box.contains(candidate)]).distances
    b = pcbench.Index(candidate).query(reference[box.contains(reference)]).distances
    assert pair.scores["chamfer"] == pytest.approx(a.mean() + b.mean(), rel=1e-9)  # coordinates moved by 7
    unmoved = pcbench.evaluate(tmp_path / "gt/s0.npy", tmp_path / "moved.npy").pairs[0]
    registered = pcbench.evaluate(
        tmp_path / "gt/s0.npy", tmp_path / "good/s0.npy", register="icp", crop="quantile:0.9"
    ).pairs[0]
    assert unmoved.scores["hausdorff"] > 6 and registered.scores["d2_rms.c2r"] < 0.012


def test_inputs_are_never_in_the_output_folder(tmp_path):
    reference, candidates = write_scenes(tmp_path, 1)
    with check_error():
        pcbench.evaluate(reference, candidates, out=tmp_path)
    (tmp_path / "notes").mkdir()
    (tmp_path / "notes" / "text.txt").touch()
    with check_error():
        pcbench.evaluate(reference, candidates, out=tmp_path / "notes")
    with check_error():
        pcbench.evaluate(reference, candidates, protocol_data=tmp_path, out=tmp_path / "out")
    with check_error():
        pcbench.evaluate(reference, candidates, crop=f"polygon:{tmp_path / 'out' / 'a.json'}", out=tmp_path / "out")


def test_wrong_arguments_are_refused_before_any_work(tmp_path):
    reference, candidates = write_scenes(tmp_path, 1)
    for arguments in (
        {"protocol": "nothing"},
        {"register": "magic"},
        {"crop": "pyramid:1"},
        {"protocol_data": tmp_path / "nowhere"},
        {"pairs": tmp_path / "pairs.csv"},
    ):
        with check_error():
            pcbench.evaluate(reference, candidates, **arguments)
    with check_error():
        pcbench.evaluate(reference)
    with check_error():
        pcbench.evaluate(tmp_path / "gt/s0.npy", tmp_path / "gt/nothing.npy")


def test_names_become_folders_and_no_markup(tmp_path):
    write_scenes(tmp_path, 1)
    files = str(tmp_path / "gt/s0.npy"), str(tmp_path / "good/s0.npy")
    names = [("a/b", HOSTILE), ("a/b", "A b"), ("a/b", "a_b"), ("..", "..")]
    plan = EvaluationPlan(tuple(PlannedPair(scene, method, *files) for scene, method in names))
    study = run_evaluation(plan, EvaluateSettings("open3d", workers=1), out=tmp_path / "out", figures=False).study
    folders = [Path(pair.folder) for pair in study.pairs]
    assert len({str(folder).lower() for folder in folders}) == 4
    assert all(folder.parent == Path("pairs") and (tmp_path / "out" / folder).is_dir() for folder in folders)
    page = Page((tmp_path / "out" / "report.html").read_text())
    assert "img" not in page.tags and page.unbalanced == []
