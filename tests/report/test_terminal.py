"""What `compare` prints: at most a dozen rows, in the width that there is, and where the rest lies."""

from pathlib import Path

import numpy as np
import pytest
import shapes

from pcbench import Cloud, read_cloud, write_cloud

LONG = "reconstruction_of_the_whole_site_with_default_settings_2024-05-"


@pytest.fixture(scope="module")
def clouds(tmp_path_factory):
    """A reference in metres and seven candidates, two of them with names that differ at their ends."""
    folder = tmp_path_factory.mktemp("clouds")
    write_cloud(folder / "ref.ply", Cloud(shapes.city(4000, noise=0.01, seed=1)[0], unit="m"))
    names = ["a", "b", "c", "d", f"{LONG}17", f"{LONG}18"]
    for number, name in enumerate(names):
        points = shapes.city(1500, noise=0.02 * (1 + number), seed=10 + number)[0]
        write_cloud(folder / f"{name}.ply", Cloud(points))
    a = shapes.city(3000, noise=0.02, seed=9)[0]
    beyond = a + [np.ptp(a[:, 0]) + 5, 0, 0]
    write_cloud(folder / "beyond.ply", Cloud(np.vstack([a, beyond])))
    return folder, names


@pytest.fixture
def printed(clouds, run, monkeypatch, tmp_path):
    """Run compare on some candidates: the lines of the answer, and those of the table."""
    folder, _ = clouds
    monkeypatch.chdir(tmp_path)

    def call(*names, options=(), columns=80):
        monkeypatch.setenv("COLUMNS", str(columns))
        files = [folder / f"{name}.ply" for name in ("ref", *names)]
        code, out, err = run("compare", *files, "--register", "none", *options)
        assert (code, err) == (0, "")
        above, table, *below = out.split("\n\n")
        return above.splitlines(), table.splitlines(), "\n\n".join(below), out

    return call


@pytest.mark.parametrize("columns", [80, 132])
@pytest.mark.parametrize("count", [1, 2])
def test_one_and_two_stand_side_by_side(clouds, printed, count, columns):
    above, table, below, out = printed(*clouds[1][-count:], columns=columns)
    assert len(table) == 2 + 12
    assert max(map(len, table)) <= columns
    assert max(map(len, above[1:])) <= columns
    assert "c→r" in table[1] and "r→c" in table[1]
    assert [line[:16] for line in table].count("  sampling floor") == 2
    assert "--full prints every metric" in " ".join(below.split())
    assert "gao2025" not in out
    assert "is lower than" not in out


@pytest.mark.parametrize("columns", [80, 132])
def test_six_are_a_row_each(clouds, printed, columns):
    names = clouds[1]
    above, table, _, _ = printed(*names, columns=columns)
    head, rows = table[:2], table[2:]
    assert len(rows) == 6
    assert max(map(len, table)) <= columns
    assert [row.split()[0] for row in rows[:4]] == names[:4]
    ends = [row.split()[0] for row in rows[4:]]
    assert ends[0].endswith("17") and ends[1].endswith("18")
    words = " ".join(head).split()
    assert words.count("c→r") >= 2 and words.count("r→c") >= 2 and words.count("floor") >= 2
    assert len(above) <= 14  # two to four sentences
    if columns == 132:
        assert "points" in words


def test_a_doubtful_pose_is_marked_in_its_row(clouds, printed):
    folder, _ = clouds
    points = read_cloud(folder / "a.ply").points
    write_cloud(folder / "astray.ply", Cloud(1000 * (points - points.mean(axis=0)) + points.mean(axis=0)))
    above, table, _, _ = printed("a", "b", "astray")
    assert above[1].startswith("The registration of astray is doubtful")
    assert table[1].split()[0] == "pose"
    (row,) = [line for line in table if line.startswith("astray")]
    assert "doubtful" in row
    assert "doubtful" not in "".join(line for line in table if not line.startswith("astray"))


def test_a_small_overlap_stands_above_the_numbers(printed):
    above, _, _, _ = printed("beyond")
    said = " ".join(" ".join(above).split())
    assert "of it lies on the reference (within 5 of its spacings" in said
    assert "--crop reference measures" in said
    cropped, *_ = printed("beyond", options=["--crop", "reference"])
    assert "--crop reference" not in " ".join(cropped)


def test_full_prints_all(printed):
    _, _, _, out = printed("a", "b", options=["--full"])
    for label in ("Chamfer, sum of means", "mpeg: d1_psnr", "  median, signed", "  standard deviation", "  NMAD"):
        assert label in out
    assert "D1 MSE c→r: a and b cannot be told apart (difference in [" in " ".join(out.split())
    assert "b is not deformed against the reference" in " ".join(out.split())
    assert "--full" not in out


def test_what_was_asked_for_is_among_the_rows(printed):
    _, table, _, _ = printed("a", options=["--thresholds", "0.5,2"])
    assert [line.split("  ")[0] for line in table[-2:]] == ["F-score at 0.5", "F-score at 2"]
    _, table, _, _ = printed("a", options=["--map", "m3c2"])
    assert any(line.startswith("map m3c2: bias, rms") for line in table)
    assert len(table) <= 2 + 12


def test_where_the_rest_lies(printed):
    out = " ".join(printed("a", options=["--out", "kept"])[2].split())
    assert "report: kept/ holds table.md" in out
    for name in ("comparison.json", "metrics.csv", "*_deviation.ply", "*_T.txt"):
        assert name in out
    assert "figures" not in out  # none were drawn
    assert "NMAD" in Path("kept/table.md").read_text()
    out = " ".join(printed("a")[2].split())
    assert out.startswith("--out FOLDER keeps")


def test_a_sentence_is_a_line_where_no_width_is_known(clouds, run, monkeypatch):
    folder, _ = clouds
    monkeypatch.delenv("COLUMNS", raising=False)
    _, out, _ = run("compare", folder / "ref.ply", folder / "a.ply", "--register", "none")
    assert out.splitlines()[1].startswith("a lies ")
    assert out.splitlines()[1].endswith(".")
