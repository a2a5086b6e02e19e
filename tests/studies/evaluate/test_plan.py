"""The pairs of patterns and of CSV files."""

import pytest
from wording import check_error, check_text

from pcbench.studies.evaluate.plan import plan_csv, plan_patterns
from pcbench.studies.evaluate.words import matched_methods


@pytest.fixture
def files(tmp_path, monkeypatch):
    """References of three scenes, and two methods, one of which lacks a scene."""
    monkeypatch.chdir(tmp_path)
    for path in (
        *("gt/scan001.ply", "gt/scan002.ply", "gt/scan010.ply"),
        *("a/scan1/mesh.ply", "a/scan2/mesh.ply", "b/scan2/mesh.ply", "b/scan2/other.obj"),
    ):
        file = tmp_path / path
        file.parent.mkdir(parents=True, exist_ok=True)
        file.touch()
    return tmp_path


def rows(plan):
    return [(pair.scene, pair.method, pair.reference, pair.candidate, bool(pair.missing)) for pair in plan.pairs]


def test_scenes_match_by_their_number_and_missing_files_are_pairs(files):
    plan = plan_patterns("gt/scan{scene}.ply", ["{method}/scan{scene}/mesh.ply"], crop="polygon:{scene}_{method}.json")
    assert rows(plan) == [
        ("001", "a", "gt/scan001.ply", "a/scan1/mesh.ply", False),
        ("001", "b", "gt/scan001.ply", "b/scan001/mesh.ply", True),
        ("002", "a", "gt/scan002.ply", "a/scan2/mesh.ply", False),
        ("002", "b", "gt/scan002.ply", "b/scan2/mesh.ply", False),
    ]
    assert plan.pairs[0].crop == "polygon:001_a.json"
    check_text("\n".join((*plan.notes, plan.pairs[1].missing)))


def test_folders_that_hardly_fit_are_noted(files):
    (files / "old/scan10").mkdir(parents=True)
    (files / "old/scan10/mesh.ply").touch()
    plan = plan_patterns("gt/scan{scene}.ply", ["{method}/scan{scene}/mesh.ply"])
    assert plan.matched_methods == ("a", "b", "old")
    check_text("\n".join((*plan.notes, *matched_methods(plan.matched_methods))))


def test_methods_have_a_pattern_each(files):
    plan = plan_patterns("gt/scan{scene}.ply", ["ours=a/scan{scene}/mesh.ply", "./b/scan{scene}/m*.ply"])
    assert [(pair.scene, pair.method) for pair in plan.pairs if not pair.missing] == [
        *(("001", "ours"), ("002", "ours"), ("002", "b"))
    ]
    assert plan.pairs[-1].candidate == "./b/scan2/mesh.ply"


def test_a_scene_without_reference_is_a_pair(files):
    (files / "gt/scan001.ply").unlink()
    plan = plan_patterns("gt/scan{scene}.ply", ["{method}/scan{scene}/mesh.ply"])
    assert [pair for pair in plan.pairs if pair.missing][-1].scene == "1"


def test_without_placeholders_there_is_one_pair(files):
    (pair,) = plan_patterns("gt/scan001.ply", ["a/scan1/mesh.ply"]).pairs
    assert (pair.scene, pair.method) == ("scan001", "mesh")
    plan = plan_patterns("gt/scan001.ply", ["{method}/scan2/mesh.ply"])
    assert [(pair.scene, pair.method) for pair in plan.pairs] == [("scan001", "a"), ("scan001", "b")]


def test_references_are_no_candidates_of_themselves(files):
    (files / "ours").mkdir()
    (files / "ours/scan001.ply").touch()
    plan = plan_patterns("gt/scan{scene}.ply", ["{method}/scan{scene}.ply"])
    assert [(pair.scene, pair.method) for pair in plan.pairs] == [("001", "ours")]


def test_a_repeated_placeholder_has_one_value(files):
    for path in ("c/x/x.ply", "c/x/y.ply", "gt2/x.ply", "gt2/y.ply", "c/[1]/[1].ply", "gt2/[1].ply"):
        (files / path).parent.mkdir(parents=True, exist_ok=True)
        (files / path).touch()
    plan = plan_patterns("gt2/{scene}.ply", ["c/{scene}/{scene}.ply"])
    assert [pair.candidate for pair in plan.pairs] == ["c/[1]/[1].ply", "c/x/x.ply"]


def test_patterns_that_fit_nothing_or_two_files_are_refused(files):
    (files / "a/scan01").mkdir()
    (files / "a/scan01/mesh.ply").touch()
    for reference, *candidates in (
        ("gt/{scene}.pcd", "{method}/scan{scene}/mesh.ply"),
        ("gt/scan{scene}.ply", "c/scan{scene}/mesh.ply"),
        ("gt/scan{scene}.ply", "{method}/mesh.ply"),
        ("gt/scan001.ply", "{method}/scan{scene}/mesh.ply"),
        ("gt/scan{scene}.ply", "{method}/scan{scene}/mesh.ply"),
        ("gt/{method}.ply", "{method}/scan1/mesh.ply"),
        ("gt/{Scene}.ply", "a/scan1/mesh.ply"),
        ("gt/scan{scene}.ply", "a/{method}{scene}.ply"),
        ("gt/scan{scene}.ply", "a/scan{scene}/mesh.ply", "a/scan{scene}/other.ply"),
        ("gt/scan{scene}.ply", "x={method}/scan{scene}/mesh.ply"),
        ("nothing.ply", "a/scan1/mesh.ply"),
    ):
        with check_error():
            plan_patterns(reference, candidates)


def test_a_csv_file_has_paths_relative_to_its_folder(files):
    (files / "list").mkdir()
    table = files / "list" / "pairs.csv"
    table.write_text(
        "candidate, reference, scene, method, pose, crop, seconds\n"
        "../a/scan1/mesh.ply,../gt/scan001.ply,one,a,pose.txt,polygon:area.json,12.5\n"
        "../b/scan1/mesh.ply,../gt/scan001.ply,one,b,,,\n"
    )
    first, second = plan_csv(table, register="icp", crop="box:0,0,0,1,1,1").pairs
    folder = files / "list"
    assert (first.register, first.crop, first.seconds) == (
        f"matrix:{folder / 'pose.txt'}",
        f"polygon:{folder / 'area.json'}",
        12.5,
    )
    assert first.candidate == str(folder / "../a/scan1/mesh.ply") and not first.missing
    assert (second.register, second.crop, second.seconds) == ("icp", "box:0,0,0,1,1,1", None)
    assert second.missing == f"no file {folder / '../b/scan1/mesh.ply'}"


def test_names_of_a_csv_file_are_those_of_the_files_by_default(files):
    table = files / "pairs.csv"
    table.write_text("\ufeffreference,candidate\ngt/scan001.ply,a/scan1/mesh.ply\n", encoding="utf-8")
    (pair,) = plan_csv(table).pairs
    assert (pair.scene, pair.method) == ("scan001", "mesh")


def test_semicolons_and_decimal_commas_of_spreadsheets_are_read(files):
    table = files / "pairs.csv"
    table.write_text("reference;candidate;seconds\ngt/scan001.ply;a/scan1/mesh.ply;1,5\n")
    (pair,) = plan_csv(table).pairs
    assert (pair.candidate, pair.seconds) == (str(files / "a/scan1/mesh.ply"), 1.5)


def test_wrong_csv_files_are_refused(files):
    table = files / "pairs.csv"
    for text in (
        "",
        "reference,method\n",
        "reference,candidate,time\n",
        "reference,reference,candidate\na.ply,b.ply,c.ply\n",
        "reference,candidate\n",
        "reference,candidate\na.ply\n",
        "reference,candidate\na.ply,\n",
        "reference,candidate\na.ply,b.ply\na.ply,c/b.ply\n",
        "reference,candidate,seconds\na.ply,b.ply,-1\n",
        "reference,candidate,seconds\na.ply,b.ply,fast\n",
        'reference,candidate,seconds\na.ply,b.ply,"1,500"\n',
    ):
        table.write_text(text)
        with check_error():
            plan_csv(table)
    table.write_bytes(b"\xff\xfe")
    with check_error():
        plan_csv(table)
