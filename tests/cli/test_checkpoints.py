"""`pcbench checkpoints`, and `--checkpoints` of compare and reconstruct."""

import csv
import json

import numpy as np
import pytest
from command_line import is_one_line, read_comparison
from optional import import_or_skip
from wording import check_text

from pcbench import Cloud, write_cloud
from pcbench.studies.checkpoints.charts import PICTURES

ORIGIN = np.array([400_000.0, 5_600_000.0, 0.0])


def height(xy):
    return 50 + 0.02 * xy[:, 0] + np.sin(xy[:, 1] / 20)


@pytest.fixture
def survey(tmp_path, monkeypatch):
    """Write scan.ply, 0.1 m too high, and points.csv with 36 points, one of them outside, in the current folder."""
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(0)
    xy = rng.uniform(0, 100, (3000, 2))
    write_cloud("scan.ply", Cloud(np.column_stack([xy, height(xy) + 0.1]) + ORIGIN, unit="m"))
    places = np.vstack([rng.uniform(5, 95, (35, 2)), [[-20.0, 20.0]]])
    with (tmp_path / "points.csv").open("w") as file:
        file.write("id;E;N;H;class\n")
        for k, (x, y, z) in enumerate(np.column_stack([places, height(places)]) + ORIGIN, 1):
            file.write(f"P{k};{x:.4f};{y:.4f};{z:.4f};{'grass' if k % 6 == 0 else 'open'}\n".replace(".", ","))
    return tmp_path


def test_the_answer_and_the_folder(survey, run):
    code, out, _ = run("checkpoints", "scan.ply", "points.csv", "--out", "out", "--no-figures")
    assert code == 0 and out.startswith("Heights of scan.ply are accurate to RMSE 0.")
    check_text(out)
    names = {path.name for path in (survey / "out").iterdir()}
    assert {"report.html", "checkpoints.csv", "checkpoints.json", "checkpoints.md", "plan.npy"} <= names
    rows = list(csv.DictReader((survey / "out" / "checkpoints.csv").read_text().splitlines()))
    assert len(rows) == 36 and rows[35]["dz"] == "" and "away" in rows[35]["not_covered"]
    # TIN of a sine of curvature 1/400 with sides up to 5: below 5² / 8 / 400; coordinates are rounded to 0.1 mm.
    assert [float(row["dz"]) for row in rows[:35]] == pytest.approx([0.1] * 35, abs=0.008)
    document = json.loads((survey / "out" / "checkpoints.json").read_text())
    assert document["schema"] == "pcbench.checkpoints/1"
    assert document["accuracy"]["nva"]["errors"]["count"] == 30 and document["accuracy"]["vva"]["errors"]["count"] == 5
    page = (survey / "out" / "report.html").read_text()
    assert "tested to meet ASPRS Positional Accuracy Standards" in page and "P36" in page
    assert run("checkpoints", "scan.ply", "points.csv", "--out", "out", "--no-figures")[0] == 0  # replaces its own


def test_json_on_standard_output(survey, run):
    code, out, _ = run("checkpoints", "scan.ply", "points.csv", "--json", "-", "--surface", "plane", "-q")
    assert code == 0 and json.loads(out)["accuracy"]["surface"] == "plane"


def test_pictures_are_drawn(survey, run):
    import_or_skip("matplotlib")
    code, _, err = run("checkpoints", "scan.ply", "points.csv", "--out", "out", "--quiet")
    assert code == 0 and err == ""
    names = {path.name for path in (survey / "out" / "figures").iterdir()}
    assert names == {"errors.png", "map.png"}
    assert PICTURES.fits(survey / "out")  # so that `pcbench plot out` draws them again


def test_errors_are_one_line(survey, run):
    (survey / "swapped.csv").write_text(
        "\n".join(f"{ORIGIN[1] + k},{ORIGIN[0] + k},50" for k in (20, 40, 60)), encoding="utf-8"
    )
    (survey / "far.csv").write_text("a,1,2,3\n", encoding="utf-8")
    (survey / "other").mkdir()
    (survey / "other" / "file").touch()
    for arguments in (
        ("scan.ply", "swapped.csv"),
        ("scan.ply", "far.csv"),
        ("scan.ply", "missing.csv"),
        ("missing.ply", "points.csv"),
        ("scan.ply", "points.csv", "--out", "other"),
        ("scan.ply", "points.csv", "--out", "."),
        ("scan.ply", "points.csv", "--surface", "nearest"),
        ("scan.ply", "points.csv", "--classes", "2"),
        ("scan.ply", "points.csv", "--unit", "ft"),
        ("scan.ply", "points.csv", "--json", "points.csv"),
    ):
        code, out, err = run("checkpoints", *arguments)
        assert code == 2 and out == "" and is_one_line(err), (arguments, err)
        check_text(err)


def test_compare_tests_each_cloud_as_given_and_aligned(survey, run):
    rng = np.random.default_rng(3)
    xy = rng.uniform(0, 100, (800, 2))
    write_cloud("low.ply", Cloud(np.column_stack([xy, height(xy) - 0.2]) + ORIGIN, unit="m"))
    matrix = np.eye(4)
    matrix[2, 3] = 0.3
    np.savetxt("pose.txt", matrix)
    code, out, err = run(
        *("compare", "scan.ply", "low.ply", "--register", "matrix:pose.txt", "--checkpoints", "points.csv"),
        *("--out", "out", "--no-figures"),
    )
    assert code == 0, err
    check_text(next(line for line in out.splitlines() if line.startswith("Heights at check points")))
    comparison = read_comparison("out")
    candidate = comparison["candidates"][0]["check_points"]
    means = [
        values["every"]["errors"]["mean"]
        for values in (comparison["reference"]["check_points"], candidate["as_given"], candidate["aligned"])
    ]
    assert means == pytest.approx([0.1, -0.2, 0.1], abs=0.02)  # sides up to 8 in the candidate
    assert "Check points" in (survey / "out" / "report.html").read_text()
    assert json.loads((survey / "out" / "settings.json").read_text())["settings"]["checkpoints"].endswith("points.csv")


def test_compare_refuses_damaged_check_points_before_it_begins(survey, run):
    (survey / "bad.csv").write_text("id,x,y,z\na,1,2,\n")
    code, out, err = run("compare", "scan.ply", "scan.ply", "--checkpoints", "bad.csv")
    assert code == 2 and out == "" and is_one_line(err)
    check_text(err)


PLUGIN = """
from dataclasses import dataclass
from pcbench import read_cloud
from pcbench.plugins import Reconstruction

@dataclass(frozen=True)
class Mine:
    "Returns scan.ply."
    gauge: str = "georeferenced"
    file: str = ""

    def reconstruct(self, scene, workspace):
        return Reconstruction(read_cloud(self.file), self.gauge)
"""


def test_reconstruct_tests_its_cloud(survey, run):
    import_or_skip("PIL")
    from PIL import Image

    (survey / "photos").mkdir()
    Image.new("RGB", (8, 8)).save(survey / "photos" / "a.png")
    (survey / "mine.py").write_text(PLUGIN)
    given = ("reconstruct", "mine.py:Mine", "photos", "--set", f"file={survey / 'scan.ply'}", "-o", "cloud.ply")
    code, out, err = run(*given, "--checkpoints", "points.csv")
    assert code == 0, err
    assert "Heights of cloud.ply are accurate to RMSE 0." in out and "tested to meet" in out
    code, out, err = run(*given, "--checkpoints", "points.csv", "--set", "gauge=metric")
    assert code == 0 and "tested to meet" not in out
    check_text(err)


def test_points_for_registration_name_the_command(survey, run):
    (survey / "three.txt").write_text("name,x,y,z\na,1,2,3\n")
    code, _, err = run("register", "scan.ply", "scan.ply", "--register", "points:three.txt")
    assert code == 2 and is_one_line(err)
    assert "pcbench checkpoints CLOUD FILE" in check_text(err)
