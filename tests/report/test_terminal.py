"""Output of `compare`: at most 16 rows, fitted to the terminal, and where to find the rest."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import shapes
from wording import check_text

from pcbench import Cloud, Settings, compare, write_cloud
from pcbench.measure.quantities import quantities
from pcbench.measure.results import REFERENCE_TO_CANDIDATE
from pcbench.report import print_comparison
from pcbench.report.layout import column_of, headline_of, label_of
from pcbench.report.summary import main_lines
from pcbench.report.table import lines

LONG_NAME = "reconstruction_of_the_whole_site_with_default_settings_2024-05-"


@pytest.fixture(scope="module")
def clouds(tmp_path_factory):
    """Write a reference in metres and two candidates, one of which extends far beyond it."""
    folder = tmp_path_factory.mktemp("clouds")
    write_cloud(folder / "ref.ply", Cloud(shapes.city(2000, noise=0.01, seed=1)[0], unit="m"))
    a = shapes.city(1000, noise=0.02, seed=9)[0]
    for name, points in (("a", a), ("b", shapes.city(800, noise=0.05, seed=8)[0])):
        write_cloud(folder / f"{name}.ply", Cloud(points))
    write_cloud(folder / "beyond.ply", Cloud(np.vstack([a, a + [np.ptp(a[:, 0]) + 5, 0, 0]])))
    return folder


@pytest.fixture
def run_compare(clouds, run, monkeypatch, tmp_path):
    """Run compare on some candidates; return the lines of the answer, of the table and below it, and all output."""
    monkeypatch.chdir(tmp_path)

    def call(*names, options=()):
        monkeypatch.setenv("COLUMNS", "80")
        files = [clouds / f"{name}.ply" for name in ("ref", *names)]
        code, out, err = run("compare", *files, "--register", "none", *options)
        assert (code, err) == (0, "")
        return split_output(out)

    return call


def split_output(out):
    above, table, *below = out.split("\n\n")
    return above.splitlines(), table.splitlines(), " ".join("\n\n".join(below).split()), out


@pytest.fixture(scope="module")
def six_candidates():
    """Compare six candidates: two names differ only at their ends, and one is in millimetres."""
    reference = Cloud(shapes.city(1500, noise=0.01, seed=1)[0], unit="m")
    names = ["a", "b", "c", f"{LONG_NAME}17", f"{LONG_NAME}18"]
    points = {name: shapes.city(800, noise=0.02 * k, seed=10 + k)[0] for k, name in enumerate(names)}
    center = reference.points.mean(axis=0)
    clouds = {**points, "astray": 1000 * (points["a"] - center) + center}
    comparison = compare(reference, clouds, Settings(register="none"))
    *others, astray = comparison.candidates  # a pose that was found, because a given one is not doubted
    astray = replace(astray, registration=replace(astray.registration, method="icp"))
    return replace(comparison, candidates=(*others, astray))


@pytest.fixture
def print_candidates(six_candidates, monkeypatch, capsys):
    """Return a function that prints the comparison of some of the six on a terminal of `columns` columns."""

    def call(*names, columns=80):
        monkeypatch.setenv("COLUMNS", str(columns))
        candidates = tuple(six_candidates[name] for name in names)
        differences = tuple(d for d in six_candidates.differences if {d.a, d.b} <= set(names))
        print_comparison(replace(six_candidates, candidates=candidates, differences=differences))
        return split_output(capsys.readouterr().out)

    return call


@pytest.mark.parametrize("columns", [80, 132])
@pytest.mark.parametrize(
    "names", [("a",), (f"{LONG_NAME}17",), ("a", "b"), (f"{LONG_NAME}17", f"{LONG_NAME}18")], ids=len
)
def test_one_or_two_candidates_are_columns(print_candidates, names, columns):
    above, table, below, out = print_candidates(*names, columns=columns)
    assert len(table) == 2 + 14
    assert max(map(len, out.splitlines())) <= columns
    assert table[1].split() == ["lengths", "in", "m", *["c→r", "r→c"] * len(names)]
    assert [line[:16] for line in table].count("  sampling floor") == 2
    assert len({*table[0].split()}) == len(names)
    assert "--full" in below
    assert len(above) <= 1 + 4 * (3 if columns == 80 else 2)
    assert "gao2025" not in out
    check_text(below)


@pytest.mark.parametrize("columns", [60, 80, 132])
def test_six_candidates_are_rows(six_candidates, print_candidates, columns):
    names = [c.name for c in six_candidates]
    above, table, _, _ = print_candidates(*names, columns=columns)
    head, rows = table[:2], table[2:]
    assert len(rows) == 6
    assert max(map(len, table + above)) <= columns
    assert [row.split()[0] for row in rows if "reconst" not in row] == ["a", "b", "c", "astray"]
    shortened_names = [row.split()[0] for row in rows if "reconst" in row]
    assert [name[-2:] for name in shortened_names] == ["17", "18"]
    words = " ".join(head).split()
    assert "c→r" in words and "r→c" in words
    if columns >= 80:
        assert words.count("floor") >= 2
    assert words.count("mean") == (2 if columns == 132 else 1)


def test_wide_letters_take_two_columns(clouds, run, monkeypatch, tmp_path):
    """Numbers are below their headings, and control characters in a name have no effect."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "80")
    names = ["點雲", "b", "c"]
    for name in names:
        shutil.copy(clouds / "a.ply", f"{name}.ply")
    shutil.copy(clouds / "ref.ply", "re\x1b[31m\nf.ply")
    code, out, _ = run("compare", "re\x1b[31m\nf.ply", *(f"{name}.ply" for name in names), "--register", "none")
    assert code == 0
    assert out.startswith("re?[31m?f.ply: ")
    wide, narrow = (next(line for line in out.splitlines() if line.startswith(f"{name} ")) for name in names[:2])
    assert wide.index("%") + 2 == narrow.index("%")


def test_a_doubtful_pose_is_marked_in_its_row(six_candidates, print_candidates):
    above, table, _, _ = print_candidates("a", "b", "astray")
    check_text(" ".join(" ".join(above).split()))
    assert table[1].removeprefix("lengths in m").split()[0] == "pose"
    (row,) = [line for line in table if line.startswith("astray")]
    assert "doubtful" in row
    assert "doubtful" not in "".join(line for line in table if not line.startswith("astray"))
    assert "pose" not in print_candidates("a", "b", "c")[1][1]


@pytest.mark.with_deformation
def test_a_small_overlap_is_printed_above_the_numbers(run_compare):
    above, _, _, _ = run_compare("beyond")
    assert "--crop reference" in check_text(" ".join(" ".join(above).split()))
    above_cropped, *_ = run_compare("beyond", options=["--crop", "reference"])
    assert "--crop reference" not in " ".join(above_cropped)


def test_full_prints_intervals_if_they_fit(six_candidates, monkeypatch, capsys):
    one = replace(six_candidates, candidates=six_candidates.candidates[:1])
    rms = one["a"].metrics.d2_rms.accuracy
    text = f"{rms.value:.4g} [{rms.interval.low:.4g}, {rms.interval.high:.4g}]"
    for width, fits in (("80", False), ("140", True), (None, True)):
        if width is None:
            monkeypatch.delenv("COLUMNS")
        else:
            monkeypatch.setenv("COLUMNS", width)
        print_comparison(one, full=True)
        out = capsys.readouterr().out
        assert (text in out) == fits
        assert f"{rms.value:.4g}" in out


def test_full_prints_all_metrics(run_compare):
    _, _, _, out = run_compare("a", "b", options=["--full"])
    for label in ("Chamfer, sum of means", "mpeg: d1_psnr", "  median, signed", "  standard deviation", "  NMAD"):
        assert label in out
    assert "D1 MSE c→r: no significant difference between a and b" in " ".join(out.split())
    assert "--full" not in out


def test_requested_metrics_are_among_the_rows(run_compare):
    _, table, _, _ = run_compare("a", options=["--thresholds", "0.5,2"])
    assert [line.split("  ")[0] for line in table[-2:]] == ["F-score at 0.5", "F-score at 2"]
    _, table, _, _ = run_compare("a", options=["--map", "m3c2"])
    assert any(line.startswith("map m3c2: ") for line in table)
    assert len(table) <= 2 + 16


def test_numbers_below_r_to_c_are_of_that_direction():
    """Two numbers that are no pair of directions have their own rows."""
    reference = shapes.terrain(1500, seed=1)[0]
    comparison = compare(reference, {"a": reference + 0.01}, Settings(register="none", maps=("m3c2",)))
    second = {"points measured"}
    for q in quantities(comparison.candidates[0]):
        if column_of(q) == 1:
            assert q.direction in (REFERENCE_TO_CANDIDATE, "a_to_b")
            second |= {label.text for label in (label_of(q), headline_of(q)) if label is not None}
    for line in (*main_lines(comparison), *filter(None, lines(comparison))):
        assert line.label in second or not any(right.text for _, right in line.cells), line.label
    labels = {line.label for line in lines(comparison) if line is not None}
    assert {"map m3c2: bias", "significant share", "rmse", "overlap", "detectable RMS"} <= labels


@pytest.mark.with_deformation
def test_the_folder_with_all_results_is_named(run_compare):
    out = check_text(run_compare("a", options=["--out", "kept"])[2])
    for name in ("table.md", "comparison.json", "metrics.csv", "*_deviation.ply", "*_T.txt"):
        assert name in out
    assert "figures" not in out  # none were drawn
    assert "NMAD" in Path("kept/table.md").read_text()
    check_text(run_compare("a")[2])


def test_sentences_are_not_wrapped_without_a_known_width(clouds, run, monkeypatch):
    monkeypatch.delenv("COLUMNS", raising=False)
    _, out, _ = run("compare", clouds / "ref.ply", clouds / "a.ply", "--register", "none")
    assert check_text(out.splitlines()[1]).endswith(".")


def test_a_terminal_of_unknown_width_has_the_default(clouds, run, monkeypatch):
    monkeypatch.setenv("COLUMNS", "0")
    code, out, err = run("compare", clouds / "ref.ply", clouds / "a.ply", "--register", "none")
    assert (code, err) == (0, "")
    assert any(line.startswith("a lies ") for line in out.splitlines())
    assert max(map(len, out.splitlines()[:5])) <= 80
