"""`pcbench compare` and `pcbench plot`: their output and the folder that they write."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from children_here import drawing_here
from command_line import REPORT, is_one_line, read_comparison, without_timings
from optional import import_or_skip
from wording import check_text

from pcbench import Cloud, read_cloud, write_cloud
from pcbench.geometry.transform import read_matrix


@pytest.mark.with_deformation
def test_compare_prints_the_answer_and_leaves_a_folder(files, run):
    code, out, err = run("compare", "ref.ply", "a.ply", "b.ply", "--out", "report")
    assert code == 0
    assert not err
    check_text(out.splitlines()[-1])
    fields = {f"{name}_deformation.{kind}" for name in "ab" for kind in ("csv", "ply")}
    expected = (
        REPORT | fields | {f"{name}_{kind}" for name in "ab" for kind in ("deviation.ply", "completeness.ply", "T.txt")}
    )
    assert {p.name for p in Path("report").iterdir()} - {"figures"} == expected
    values = read_comparison("report")
    assert [c["name"] for c in values["candidates"]] == ["a", "b"]
    assert values["reference"]["sha256"]
    assert "NaN" not in (files / "report/comparison.json").read_text()
    deviation = read_cloud("report/a_deviation.ply")
    assert len(deviation) == 1500
    metrics = values["candidates"][0]["metrics"]
    # The scalar is float32 in the file.
    assert deviation.attributes["distance"].max() == pytest.approx(
        metrics["hausdorff"]["candidate_to_reference"], rel=1e-6
    )
    matrix = read_matrix("report/a_T.txt").matrix
    np.testing.assert_array_equal(matrix, values["candidates"][0]["registration"]["T_reference_candidate"])
    rows = list(csv.DictReader((files / "report/metrics.csv").read_text().splitlines()))
    identity = ["candidate", "metric", "variant", "threshold", "direction"]
    assert list(rows[0]) == [*identity, "definition", "value", "unit", "ci_low", "ci_high"]
    assert len({tuple(r[key] for key in identity) for r in rows}) == len(rows)
    row = next(r for r in rows if r["metric"] == "d1_mse" and r["direction"] == "candidate_to_reference")
    assert float(row["value"]) == metrics["d1_mse"]["candidate_to_reference"]
    assert row["unit"] == "m^2"
    (row,) = [
        r for r in rows if (r["candidate"], r["metric"]) == ("b", "plane_distance_nmad") and r["direction"][0] == "r"
    ]
    spreads = values["candidates"][1]["metrics"]["spreads"]["plane_distance"]
    assert float(row["value"]) == spreads["reference_to_candidate"]["nmad"]
    assert spreads["candidate_to_reference"] == values["candidates"][1]["deviation"]["maps"]["plane_distance"]
    assert "| D1 MSE |" in (files / "report/table.md").read_text()


def test_the_answer_is_printed_before_the_report_is_written(files, run, monkeypatch):
    """Pictures take longer than a comparison of small clouds, and a full disk must not lose the answer."""

    def fail(*_):
        raise OSError(28, "No space left on device", "report/report.html")

    _, expected, _ = run("compare", "ref.ply", "a.ply")
    monkeypatch.setattr("pcbench.comparison.run.write_report", fail)
    code, out, err = run("compare", "ref.ply", "a.ply", "--out", "report")
    assert (code, is_one_line(err)) == (2, True)
    assert out == expected.rpartition("--out")[0]
    assert not Path("report").exists()


@pytest.mark.with_deformation
def test_without_the_test_for_deformation_other_numbers_stay(report, run):
    options = ("--no-deformation", "--no-figures", "--out")
    code, out, err = run("compare", "ref.ply", "a.ply", *options, "untested")
    assert (code, err) == (0, "")
    check_text("\n".join(line for line in out.splitlines() if "deform" in line))
    (tested,), (untested,) = (without_timings(read_comparison(folder))["candidates"] for folder in (report, "untested"))
    verdict = untested.pop("deformation")
    assert (verdict["verdict"], verdict["model"], verdict["amplitude"]) == ("not tested", "", None)
    assert tested.pop("deformation")["noise"] is not None
    assert tested.pop("budget").keys() == untested.pop("budget").keys()  # the verdict's noise counts as noise
    assert tested == untested
    assert "a was not tested for deformation." in Path("untested/report.html").read_text()
    assert run("compare", "--settings", "untested/settings.json", "-q", "--out", "again")[0] == 0
    assert Path("again/settings.json").read_bytes() == Path("untested/settings.json").read_bytes()
    assert read_comparison("again")["candidates"][0]["deformation"] == verdict


@pytest.mark.with_deformation
def test_settings_reproduce_the_numbers_bit_for_bit(files, run):
    options = ("--crop", "quantile:0.9", "--register", "similarity", "--thresholds", "0.1,0.3", "--preset", "open3d")
    assert run("compare", "ref.ply", "a.ply", "b.ply", *options, "--seed", 5, "--out", "one")[0] == 0
    assert run("compare", "--settings", "one/settings.json", "--out", "two")[0] == 0
    one, two = without_timings(read_comparison("one")), without_timings(read_comparison("two"))
    for values in (one, two):
        for entry in (values["reference"], *values["candidates"]):
            entry["path"] = Path(entry["path"]).name
    assert one == two
    code, _, err = run("compare", "--settings", "one/settings.json", "--crop", "none")
    assert code == 2
    check_text(err.partition(" (see ")[0])  # the rest is the command line of pytest


def test_a_file_changed_since_the_settings_gives_a_warning(finished, report, files, run):
    settings = (report / "settings.json").read_text()
    Path("settings.json").write_text(settings.replace(str(finished), str(files)))
    write_cloud("a.ply", read_cloud("b.ply"))
    code, out, _ = run("compare", "--settings", "settings.json")
    assert code == 0
    check_text(next(line for line in out.splitlines() if line.startswith("warning: ")))


def test_json_on_standard_output(files, run):
    code, out, _ = run("compare", "ref.ply", "b.ply", "--json", "-")
    assert code == 0
    assert json.loads(out)["schema"] == "pcbench.comparison/1"
    assert run("compare", "ref.ply", "b.ply", "--quiet")[1] == ""


def test_equal_file_stems_get_their_folders_as_prefix(files, run):
    (files / "sub").mkdir()
    write_cloud("sub/a.ply", read_cloud("b.ply"))
    for name in ("a.ply", "reference.ply"):
        write_cloud(name, read_cloud("b.ply"))
    code, _, _ = run("compare", "b.ply", "a.ply", "sub/a.ply", "reference.ply", "--register", "none", "--out", "report")
    assert code == 0
    assert [c["name"] for c in read_comparison("report")["candidates"]] == [f"{files.name}_a", "sub_a", "reference_2"]


def test_one_damaged_candidate_leaves_no_report(files, run):
    (files / "bad.ply").write_bytes((files / "a.ply").read_bytes()[:-5])
    code, _, err = run("compare", "ref.ply", "a.ply", "bad.ply", "--out", "new/report")
    assert code == 2
    assert is_one_line(err)
    assert "bad.ply" in err
    assert not (files / "new").exists()


@pytest.mark.with_deformation
def test_an_existing_report_survives_a_failed_run_and_is_replaced_by_a_good_one(report, files, run):
    (files / "report/notes.txt").write_text("mine")
    before = {p.name: p.read_bytes() for p in (files / "report").iterdir() if p.is_file()}
    assert run("compare", "ref.ply", "a.ply", "--crop", "sphere:900,0,0,1", "--out", "report")[0] == 2
    assert {p.name: p.read_bytes() for p in (files / "report").iterdir() if p.is_file()} == before
    assert run("compare", "ref.ply", "b.ply", "--out", "report")[0] == 0
    names = {p.name for p in (files / "report").iterdir()} - {"figures"}
    fields = {"b_deformation.csv", "b_deformation.ply"}
    assert names == REPORT | fields | {"b_deviation.ply", "b_completeness.ply", "b_T.txt", "notes.txt"}
    assert not [p for p in files.iterdir() if p.name.startswith(".")]


def test_a_folder_of_something_else_is_left_alone(files, run):
    (files / "thesis").mkdir()
    (files / "thesis/chapter.tex").write_text("years of work")
    code, _, err = run("compare", "ref.ply", "a.ply", "--out", "thesis")
    assert code == 2
    check_text(err)
    code, _, err = run("compare", "ref.ply", "b.ply", "--out", "a.ply")
    assert code == 2
    check_text(err)


def test_nan_points_are_dropped_and_counted(files, run):
    points = read_cloud("a.ply").points.copy()
    points[:7] = np.nan
    np.save("holes.npy", points)
    code, out, _ = run("compare", "ref.ply", "holes.npy", "--out", "report")
    assert code == 0
    assert "7 of 1500" in out
    assert "7 of 1500" in read_comparison("report")["candidates"][0]["warnings"][0]
    assert read_comparison("report")["candidates"][0]["points"] == 1493


def test_suspected_units_are_warned_about(files, run):
    points = read_cloud("ref.ply").points
    write_cloud("mm.ply", Cloud(1000 * (points - points.mean(axis=0)) + points.mean(axis=0)))
    code, out, _ = run("compare", "ref.ply", "mm.ply", "--register", "none")
    assert code == 0
    check_text(next(line for line in out.splitlines() if "millimetres" in line))


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("reference", 5),
        ("reference", {"sha256": "x"}),
        ("reference", {"path": 5, "sha256": "x"}),
        ("candidates", []),
        ("candidates", [{"name": "../x", "path": "a.ply", "sha256": ""}]),
        ("candidates", [{"name": "", "path": "a.ply", "sha256": ""}]),
        ("candidates", [{"name": None, "path": "a.ply", "sha256": ""}]),
        ("candidates", 2 * [{"name": "a", "path": "a.ply", "sha256": ""}]),
        ("settings", {"seed": -1}),
        ("settings", {"seed": "x"}),
        ("settings", {"register": None}),
        ("settings", {"crop": 5}),
        ("settings", {"thresholds": "123"}),
        ("settings", {"thresholds": [1e400]}),
        ("settings", {"normal_neighbors": 2500000000}),
        ("settings", {"nonsense": 1}),
        ("settings", None),
    ],
)
def test_damaged_settings_are_one_line(report, files, run, key, value):
    values = json.loads((report / "settings.json").read_text())
    values[key] = {**values[key], **value} if key == "settings" and value else value
    (files / "bad.json").write_text(json.dumps(values))
    code, _, err = run("compare", "--settings", "bad.json", "--out", "two")
    assert code == 2
    assert is_one_line(err), err
    assert not (files / "two").exists()


def test_a_report_with_malicious_names_deletes_nothing_elsewhere(files, run):
    (files / "evil/figures").mkdir(parents=True)
    (files / "p_T.txt").write_text("mine")
    name = "figures/../../p"
    (files / "evil/comparison.json").write_text(json.dumps({"candidates": [{"name": name}]}))
    run("compare", "ref.ply", "a.ply", "--out", "evil")
    assert (files / "p_T.txt").read_text() == "mine"


def test_names_are_data_not_markup(files, run):
    for name in ("[bold]x", ":smile:", "[/x]"):
        (files / f"{name.replace('/', '')}.ply").write_bytes((files / "a.ply").read_bytes())
    code, out, _ = run("compare", "ref.ply", "[bold]x.ply", ":smile:.ply", "[x].ply")
    assert code == 0
    for name in ("[bold]x", ":smile:", "[x]"):
        assert name in out


def test_files_that_settings_name_are_absolute_and_hashed(files, run, monkeypatch):
    run("register", "ref.ply", "a.ply", "--matrix", "T.txt", "-q")
    assert run("compare", "ref.ply", "a.ply", "--register", "matrix:T.txt", "--out", "one")[0] == 0
    (files / "elsewhere").mkdir()
    monkeypatch.chdir(files / "elsewhere")
    assert run("compare", "--settings", "../one/settings.json", "--out", "two")[0] == 0
    assert read_comparison("two")["candidates"][0]["metrics"] == read_comparison("../one")["candidates"][0]["metrics"]
    (files / "T.txt").write_text((files / "T.txt").read_text() + "# touched\n")
    out = run("compare", "--settings", "../one/settings.json")[1]
    assert "T.txt" in check_text(next(line for line in out.splitlines() if line.startswith("warning: ")))


def test_a_las_candidate_gives_a_las_deviation(files, run):
    import_or_skip("lazrs")
    run("convert", "a.ply", "a.laz", "-q")
    assert run("compare", "ref.ply", "a.laz", "--out", "report")[0] == 0
    cloud = read_cloud("report/a_deviation.laz")
    assert cloud.colors is not None
    hausdorff = read_comparison("report")["candidates"][0]["metrics"]["hausdorff"]["candidate_to_reference"]
    assert cloud.attributes["distance"].max() == pytest.approx(hausdorff, rel=1e-6)


@pytest.mark.long
def test_figures_come_with_the_report(files, run):
    import_or_skip("matplotlib")
    with drawing_here():
        assert run("compare", "ref.ply", "b.ply", "--out", "report", figures=True)[::2] == (0, "")
        assert (files / "report/figures/b_distance.png").is_file()
        assert run("plot", "report", "distribution")[:2] == (0, "report/figures/distribution.png\n")


def test_classes_filter_las_inputs_only(files, run):
    points = read_cloud("ref.ply").points
    classes = np.where(points[:, 2] > 1, 6, 2).astype(np.uint8)
    write_cloud("ref.las", Cloud(points, attributes={"classification": classes}))
    code, _, err = run("compare", "ref.las", "a.ply", "--classes", "2", "--out", "report")
    assert code == 0, err
    assert read_comparison("report")["reference"]["points"] == int((classes == 2).sum())
    code, _, err = run("compare", "ref.ply", "a.ply", "--classes", "2")
    assert code == 2
    check_text(err)
    code, _, err = run("compare", "ref.las", "a.ply", "--classes", "9")
    assert code == 2
    assert is_one_line(err)


@pytest.mark.usefixtures("few_samples")
def test_a_mesh_file_as_the_reference(files, run):
    (files / "square.obj").write_text("v 0 0 0\nv 20 0 0\nv 20 20 0\nv 0 20 0\nf 1 2 3 4\n")
    rng = np.random.default_rng(0)
    write_cloud("low.ply", Cloud(np.column_stack([rng.uniform(1, 19, (500, 2)), np.full(500, 0.1)])))
    code, out, err = run(
        "compare", "square.obj", "low.ply", "--register", "none", "--sample", "4000", "--seed", "7", "--out", "report"
    )
    assert code == 0, err
    assert "4,000 points sampled on 2 faces" in check_text(out.splitlines()[0])
    values = read_comparison("report")
    assert values["reference"]["faces"] == 2
    assert values["candidates"][0]["deviation"]["maps"]["mesh_distance"]["rms"] == pytest.approx(0.1)
    assert "mesh_distance" in read_cloud("report/low_deviation.ply").attributes


@pytest.mark.parametrize(
    ("name", "start"), [("latex", r"\begin{tabular}"), ("markdown", "# ref.ply"), ("csv", "candidate,metric")]
)
def test_only_a_table_is_printed(files, run, name, start):
    code, out, _ = run("compare", "ref.ply", "a.ply", "b.ply", "--table", name)
    assert code == 0
    assert out.startswith(start)
    code, out, err = run("compare", "ref.ply", "a.ply", "--table", name, "--full")
    assert code == 2 and out == ""
    check_text(err)
