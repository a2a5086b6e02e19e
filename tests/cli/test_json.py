"""--json: the answer as one JSON document, the same as in the files, and nothing else on standard output."""

import json
from pathlib import Path

import numpy as np
import pytest
from command_line import is_one_line

from pcbench import read_cloud, write_cloud
from pcbench.geometry.cloud import Cloud


def test_register_writes_the_pose_that_it_prints(files, run):
    code, out, err = run("register", "ref.ply", "a.ply", "--json", "-", "--matrix", "T.txt")
    assert (code, err) == (0, "")
    doc = json.loads(out)
    assert doc["schema"] == "pcbench.registration/1"
    assert (doc["reference"]["path"], doc["candidate"]["path"]) == ("ref.ply", "a.ply")
    assert len(doc["candidate"]["sha256"]) == 64
    assert doc["unit"] == "m"
    registration = doc["registration"]
    np.testing.assert_array_equal(registration["T_reference_candidate"], np.loadtxt("T.txt"))
    assert registration["method"] == "icp"
    assert registration["converged"] is True
    assert registration["doubtful"] is False
    assert 0.9 < registration["overlap"] <= 1
    # The candidate was moved by (0.05, 0.02, 0); its noise of 0.02 leaves some millimetres.
    np.testing.assert_allclose(doc["motion"]["shift"], [-0.05, -0.02, 0], atol=0.02)
    np.testing.assert_allclose(doc["motion"]["at"], read_cloud("a.ply").points.mean(axis=0))
    assert doc["motion"]["scale"] == 1


def test_register_gives_the_registration_of_a_comparison(files, run):
    run("register", "ref.ply", "a.ply", "--json", "register.json", "-q")
    run("compare", "ref.ply", "a.ply", "--json", "compare.json", "-q")
    (candidate,) = json.loads(Path("compare.json").read_text())["candidates"]
    registration = json.loads(Path("register.json").read_text())["registration"]
    assert {key: registration[key] for key in candidate["registration"]} == candidate["registration"]


def test_warnings_are_in_the_document_and_on_standard_error(files, run):
    points = read_cloud("a.ply").points
    write_cloud("few.ply", Cloud(points[:5]))
    code, out, err = run("register", "ref.ply", "few.ply", "--register", "none", "--json", "-")
    doc = json.loads(out)
    assert code == 0
    assert "few-points" in doc["registration"]["warning_codes"]
    assert doc["registration"]["doubtful"] is True
    assert err.count("warning: ") == len(doc["registration"]["warnings"])


def test_deform_writes_the_same_document_to_json_and_its_folder(files, run):
    code, out, _ = run("deform", "ref.ply", "a.ply", "--out", "bend", "--json", "-", "--no-figures")
    assert code == 0
    assert out == Path("bend/deformation.json").read_text()
    assert json.loads(out)["verdict"]
    assert run("deform", "ref.ply", "a.ply", "--json", "found.json", "-q")[:2] == (0, "")
    assert Path("found.json").read_text() == out


@pytest.mark.parametrize(
    "command",
    [
        "register ref.ply a.ply --json a.ply",
        "register ref.ply a.ply --json none/x.json",
        "register ref.ply a.ply --out b.txt --json b.txt",
        "register ref.ply a.ply --register matrix:T.txt --json T.txt",
        "deform ref.ply a.ply --json ref.ply",
        "deform ref.ply a.ply --out bend --json bend/x.json",
        "bench . --reference ref.ply --method sfm --out bench --json ref.ply",
    ],
)
def test_a_document_replaces_no_input_and_no_other_result(files, run, command):
    Path("T.txt").write_text("1 0 0 0\n0 1 0 0\n0 0 1 0\n")
    before = {path: path.read_bytes() for path in files.iterdir() if path.is_file()}
    code, out, err = run(*command.split())
    assert (code, out, is_one_line(err)) == (2, "", True), err
    assert {path: path.read_bytes() for path in files.iterdir() if path.is_file()} == before
