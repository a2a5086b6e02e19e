"""Tables, pages and charts of reconstructors, from studies with known scores."""

import csv

import pytest
from optional import import_or_skip
from photo_studies import SCORES, WARNING, photo_study

from pcbench.io.json_values import to_json
from pcbench.report.article import markdown
from pcbench.studies.stress.charts import draw_charts
from pcbench.studies.stress.page import article
from pcbench.studies.stress.reconstructors.charts import score_charts
from pcbench.studies.stress.reconstructors.reconstruction import RECONSTRUCTION
from pcbench.studies.stress.results import KIND
from pcbench.studies.stress.table import limits_table, outcome_table, stress_csv, stress_table
from pcbench.studies.stress.words import answer, warnings


def test_tables():
    study = photo_study()
    assert limits_table(study, RECONSTRUCTION) == [
        ["", "sfm", "mvs"],
        ["unperturbed", "100 % right or said", "100 % right or said"],
        ["images kept [%]", "60", "all"],
        ["blur [px]", "1 !1", "none !1"],
        ["difficult surface", "80 % right or said !1", "80 % right or said !1"],
    ]
    head, sfm, mvs = outcome_table(study, RECONSTRUCTION)
    assert head == ["", "runs", "right", "warned", "refused", "degraded", "crash", "time-out", "CPU s", "MiB"]
    assert sfm[:5] == ["sfm", "16", "50", "0", "31"] and sfm[6:] == ["6.2", "0", "4", "100"]
    assert mvs[:5] == ["mvs", "16", "62", "12", "6.2"] and mvs[7] == "6.2"
    assert "degraded: less, without a warning" in stress_table(study)


def test_document_and_csv_hold_all_cells(tmp_path):
    study = photo_study()
    (tmp_path / "stress.json").write_text(to_json(KIND.values(study)))
    assert KIND.read(tmp_path) == study
    rows = list(csv.DictReader(stress_csv(study).splitlines()))
    assert len(rows) == 32 and {row["subject"] for row in rows} == {RECONSTRUCTION.name}
    (found,) = [r for r in rows if (r["method"], r["ladder"], r["level"]) == ("mvs", "blur", "2")]
    assert (found["outcome"], found["fscore"], found["standard"], found["cpu_s"]) == ("degraded", "0.3", "0.96", "4.0")
    (warned,) = [r for r in rows if (r["method"], r["ladder"], r["level"]) == ("mvs", "blur", "1")]
    assert warned["notes"] == f"10 images matched; {WARNING}"


def test_page_names_scene_threshold_and_figures():
    study = photo_study()
    names = ["outcomes_reconstruction.png", "scores_images.png", "scores_surface.png"]
    text = markdown(article(study, [f"figures/{name}" for name in names]))
    assert text.startswith("# Where reconstructors break\n")
    assert all(sentence in text for sentence in (*answer(study), *warnings(study)))
    assert (
        "32 reconstructions on 3 ladders of perturbations. Each scene is a city of 100 m with 10 images of 160 x 120"
        " pixels; a pixel is 1.2 m on the surface. The F-score is measured at 2.4 m" in text
    )
    assert "CPU seconds against severity (images)](./figures/scores_images.png)" in text
    assert "- sfm solves for its cameras and aligns them to the given ones" in text
    assert "Left out: splat (torch is not installed" in text


@pytest.mark.long
def test_charts(tmp_path):
    import_or_skip("matplotlib")
    study = photo_study()
    figures = dict(score_charts(study))
    assert list(figures) == ["images", "surface"]
    score, error, seconds = figures["images"].axes[3:6]  # the second row is the blur
    assert [tick.get_text() for tick in score.get_xticklabels()] == ["0", "0.5", "1", "2", "4", "8"]
    assert (score.get_ylabel(), error.get_ylabel()) == ("F-score at 2.4 m", "RMS error [m]")
    assert (seconds.get_ylabel(), seconds.get_xlabel()) == ("CPU time [s]", "blur [px]")
    lines = [list(line.get_ydata()) for line in score.lines if len(line.get_ydata()) == 6]
    assert lines == [[0.2, 0.2, 0.15, 0.05, 0, 0], [0.96, 0.4, 0.9, 0.3, 0, 0]]
    halves = [line.get_ydata()[0] for line in score.lines if line.get_linestyle() == ":"]
    assert halves == pytest.approx([0.1, 0.48])
    markers = [line for line in score.lines if len(line.get_xdata()) == 1]
    hollow = [line.get_ydata()[0] for line in markers if line.get_markerfacecolor() == "white"]
    assert hollow == [0.05, 0.3]
    assert sum(line.get_marker() == "x" for line in markers) == 4
    (tmp_path / "out").mkdir()
    assert {file.name for file in draw_charts(study, tmp_path / "out")} == {
        "outcomes_reconstruction.png", "matrix_reconstruction.png", "scores_images.png", "scores_surface.png",
        "severity_reconstruction_images.png",
    }  # fmt: skip
    assert set(SCORES) == {row[0] for row in outcome_table(study, RECONSTRUCTION)[1:]}
