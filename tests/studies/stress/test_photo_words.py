"""Sentences, tables, pages and charts of reconstructors, from studies with known scores."""

import csv
import json
from dataclasses import replace

import pytest
from optional import import_or_skip
from photo_studies import SCORES, WARNING, photo_study

from pcbench.report import to_json
from pcbench.report.article import markdown
from pcbench.studies.stress.charts import draw_charts
from pcbench.studies.stress.page import article
from pcbench.studies.stress.reconstructors.charts import score_charts
from pcbench.studies.stress.reconstructors.ladders import UNPERTURBED
from pcbench.studies.stress.results import KIND, RECONSTRUCTION, REFUSED
from pcbench.studies.stress.study import csv_text
from pcbench.studies.stress.table import limits_table, outcome_table, stress_table
from pcbench.studies.stress.words import answer, reconstruction_sentences, sentences


def test_limits_and_failures_of_reconstructors():
    assert list(reconstruction_sentences(photo_study())) == [
        "sfm: F-score 0.2 at 2.4 m on the unperturbed scene, in 4 CPU s.",
        "sfm keeps at least half of its F-score down to 60 % (images kept) and up to 1 px (blur).",
        "sfm delivers a cloud with less than half of its F-score, without a warning, in 2 of 15 perturbed runs:"
        " blur (1) and hard city (1).",
        "sfm, images kept: at 40 %, 30 % and 20 % it refuses (too few features).",
        "sfm, blur: at 2 px it delivers a cloud with F-score 0.05, without a warning; at 4 px it crashes (SIGABRT); at"
        " 8 px it refuses (too few features).",
        "sfm: for half-turn symmetry it refuses (too few features); for hard city it delivers a"
        " cloud with F-score 0.02, without a warning.",
        "sfm, difficult surface: F-score 0.1 for repeated facades, 0.15 for lakes, 0.15 for lakes that reflect and 0.02"
        " for hard city.",
        "mvs: F-score 0.96 at 2.4 m on the unperturbed scene, in 4 CPU s.",
        "mvs keeps at least half of its F-score down to 20 % (images kept, the last level); it does not keep half at"
        " any tested level of blur.",
        "mvs delivers a cloud with less than half of its F-score, without a warning, in 2 of 15 perturbed runs:"
        " blur (1) and hard city (1).",
        "mvs warns about 1 of 10 clouds that keep half of its F-score.",
        "mvs, blur: at 0.5 px it delivers a cloud with F-score 0.4, and warns; at 2 px it delivers a cloud with F-score"
        " 0.3, without a warning; at 4 px it runs out of time; at 8 px it refuses (too few features)"
        ".",
        "mvs: for half-turn symmetry it delivers a cloud with F-score 0.1, and warns; for hard city it delivers a cloud"
        " with F-score 0.3, without a warning.",
        "mvs, difficult surface: F-score 0.9 for repeated facades, 0.8 for lakes, 0.7 for lakes that reflect, 0.1 for"
        " half-turn symmetry and 0.3 for hard city.",
    ]


def test_several_seeds_are_counted():
    study = photo_study({"mvs": {UNPERTURBED: [0.9], "blur": [0.9, 0.9, 0.2, 0.2, 0.1]}})
    better = tuple(replace(c, seed=1, fscore=0.8, outcome="right") for c in study.reconstructions)
    found = list(reconstruction_sentences(replace(study, reconstructions=(*study.reconstructions, *better))))
    assert found[1] == "mvs keeps at least half of its F-score up to 1 px (blur)."
    assert found[-1].startswith(
        "mvs, blur: at 2 px and 4 px it delivers a cloud with F-score 0.2, without a warning in 1 of 2 runs;"
    )


def test_a_cloud_that_cannot_be_measured():
    study = photo_study({"mvs": {UNPERTURBED: [0.9], "blur": [0.9, 0.9, 0.9, 0.9, 0.1]}})
    lost = (*study.reconstructions[:-1], replace(study.reconstructions[-1], fscore=None, message="no overlap"))
    found = list(reconstruction_sentences(replace(study, reconstructions=lost)))
    assert found[-1] == "mvs, blur: at 8 px it delivers a cloud that cannot be measured, without a warning."


def test_a_method_without_an_unperturbed_score_cannot_be_judged():
    study = photo_study({"sfm": {UNPERTURBED: [REFUSED], "blur": [0.2, 0.2, 0.2, 0.2, 0.2]}})
    assert list(answer(study)) == [
        "sfm: no cloud of the unperturbed scene can be measured, so its other clouds cannot be judged."
    ]


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
    rows = list(csv.DictReader(csv_text(study).splitlines()))
    assert len(rows) == 32 and {row["subject"] for row in rows} == {RECONSTRUCTION}
    (found,) = [r for r in rows if (r["method"], r["ladder"], r["level"]) == ("mvs", "blur", "2")]
    assert (found["outcome"], found["fscore"], found["standard"], found["cpu_s"]) == ("degraded", "0.3", "0.96", "4.0")
    (warned,) = [r for r in rows if (r["method"], r["ladder"], r["level"]) == ("mvs", "blur", "1")]
    assert warned["notes"] == f"10 images matched; {WARNING}"


def test_documents_without_reconstructions_are_read(tmp_path):
    values = KIND.values(photo_study(reconstructions=(), photographs=None))
    del values["reconstructions"], values["photographs"]
    (tmp_path / "stress.json").write_text(json.dumps(values))
    assert KIND.read(tmp_path).reconstructions == ()


def test_page_names_scene_threshold_and_figures():
    study = photo_study()
    names = ["outcomes_reconstruction.png", "scores_images.png", "scores_surface.png"]
    text = markdown(article(study, [f"figures/{name}" for name in names]))
    assert text.startswith("# Where reconstructors break\n")
    assert all(sentence in text for sentence in sentences(study))
    assert (
        "32 reconstructions on 3 ladders of perturbations. Each scene is a city of 100 m with 10 images of 160 x 120"
        " pixels; a pixel is 1.2 m on the surface. The F-score is measured at 2.4 m" in text
    )
    assert "CPU seconds against severity (images)](./figures/scores_images.png)" in text
    assert "- sfm solves for its cameras and aligns them to the given ones" in text
    assert "Left out: splat (torch is not installed" in text


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
