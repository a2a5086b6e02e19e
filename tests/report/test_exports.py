"""Tables of a comparison for other programs."""

import csv
import io

import pytest
import shapes
from optional import import_or_skip
from wording import check_text

from pcbench import Settings, compare
from pcbench.report.exports import TABLES
from pcbench.report.markup import csv_text, latex

HOSTILE = r"50%_a&b\{c}#$~^"


@pytest.fixture(scope="module")
def comparison():
    points = shapes.city(3000, seed=1)[0]
    clouds = {"a": shapes.city(2000, noise=0.05, seed=2)[0], HOSTILE: shapes.city(1000, noise=0.1, seed=3)[0]}
    return compare(points, clouds, Settings(register="none"))


def test_a_latex_table_has_balanced_lines_and_no_special_characters(comparison):
    text = TABLES["latex"](comparison)
    lines = text.splitlines()
    assert lines[0] == r"\begin{tabular}{lrrrr}" and lines[-1] == r"\end{tabular}"
    assert [lines[k] for k in (1, 4, -2)] == [r"\toprule", r"\midrule", r"\bottomrule"]
    body = [line for line in lines[1:-1] if line.endswith(r"\\")]
    assert all(line.replace(r"\&", "").count("&") == 4 for line in body[1:])
    assert text.isascii()
    assert r"50\%\_a\&b\textbackslash{}\{c\}\#\$\textasciitilde{}\textasciicircum{}" in text
    value = comparison["a"].metrics.mean_distance.accuracy.value
    assert f"{value:.4g}" in text
    check_text("\n".join(line.split(" & ")[0] for line in body[1:]))


def test_a_latex_table_has_intervals_and_the_presets_that_were_asked_for(comparison):
    assert "tnt" not in TABLES["latex"](comparison)
    points = shapes.city(800, seed=1)[0]
    asked = compare(points, shapes.city(500, seed=2)[0], Settings(register="none", presets=("tnt", "pdal")))
    metrics = asked["candidate_1"].metrics
    (low, high), value = metrics.d2_rms.accuracy.interval, metrics.d2_rms.accuracy.value
    for text in (TABLES["latex"](asked), TABLES["markdown"](asked)):
        assert f"{value:.4g} [{low:.4g}, {high:.4g}]" in text
        assert f"{metrics.presets['tnt'].fscore[1].fscore:.4g}" in text
        assert f"{metrics.presets['pdal'].chamfer:.4g}" in text
    names = [line.split(" & ")[0] for line in TABLES["latex"](asked).splitlines() if line[:5] in ("tnt: ", "pdal:")]
    assert names == [f"tnt: F-score at {metrics.fscores[1].threshold:.4g}", "pdal: chamfer", "pdal: hausdorff"]


@pytest.mark.parametrize(("text", "expected"), [("c→r", r"c$\to$r"), ("a_b", r"a\_b"), ("m²", "m$^2$"), ("–", "--")])
def test_special_characters_are_escaped(text, expected):
    assert latex(text) == expected


def test_tables_equal_the_files_of_a_report(tmp_path):
    plain = compare(shapes.city(500, seed=1)[0], {"a": shapes.city(400, seed=2)[0]}, Settings(register="none"))
    plain.save(tmp_path / "report", figures=False)
    assert TABLES["csv"](plain) == (tmp_path / "report/metrics.csv").read_text()
    assert TABLES["markdown"](plain) == (tmp_path / "report/table.md").read_text()


def test_a_data_frame_has_the_rows_of_metrics_csv(comparison):
    import_or_skip("pandas")
    frame = comparison.to_dataframe()
    expected = list(csv.DictReader(io.StringIO(TABLES["csv"](comparison))))
    assert list(frame.columns) == list(expected[0])
    assert len(frame) == len(expected)
    d1 = frame[(frame.candidate == "a") & (frame.metric == "d1_mse") & (frame.direction == "candidate_to_reference")]
    assert d1.value.item() == comparison["a"].metrics.d1_mse.accuracy.value


@pytest.mark.parametrize(
    ("cell", "expected"),
    [
        ("=cmd|calc!A1", "'=cmd|calc!A1"),
        ("+1+1", "'+1+1"),
        ("-a", "'-a"),
        ("@sum", "'@sum"),
        ("-0.5", "-0.5"),
        (-2, "-2"),
    ],
)
def test_a_spreadsheet_runs_no_text_of_a_table(cell, expected):
    assert list(csv.reader(io.StringIO(csv_text(["name"], [[cell]])))) == [["name"], [expected]]
