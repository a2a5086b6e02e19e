"""`pcbench experiment gao`: tables, sentences and pictures of known results."""

import csv
import json
from dataclasses import replace

import numpy as np
import pytest
from gao_studies import deformation, scene, study, write_study
from optional import import_or_skip
from wording import check_error, check_text

from pcbench.errors import Notice
from pcbench.report import Figures
from pcbench.report.article import markdown
from pcbench.studies.gao import figures
from pcbench.studies.gao.figures import pictures
from pcbench.studies.gao.page import article
from pcbench.studies.gao.plan import FIELD, MEANS, MVS, SPARSE, SURFACE
from pcbench.studies.gao.results import KIND, TRUTH, CloudResult, ReferenceEvaluation
from pcbench.studies.gao.sentences import sentences
from pcbench.studies.gao.table import cost_table, csv_text, failures, measures_table, notes


def check_changed_sentences(*scenes, **settings):
    """Sentences of a study; those that differ from the default scene's are compared with the golden file."""
    default_sentences, study_sentences = study(scene()).sentences, study(*scenes, **settings).sentences
    check_text("\n".join(sentence for sentence in study_sentences if sentence not in default_sentences))
    return "\n".join(study_sentences)


def test_sentences_report_gains_and_costs():
    text = check_text("\n".join(study(scene()).sentences))
    for value in (
        "increases 1,000 points to 11,000",
        "2 m RMS becomes 0.51 m, 3.9 times smaller",
        "0.141 m RMS becomes 0.412 m, 2.9 times as large",
        "by 0.141 m RMS (c→r)",
        "by 0.224 m RMS (r→c)",
        "2,000 steps (density=classic)",
    ):
        assert value in text
    # Swapped: means that are more accurate than the sparse points, but less complete.
    sparse, mvs, means, surface, field = scene().clouds
    swapped = replace(
        scene(),
        clouds=(replace(means, name=SPARSE), mvs, replace(sparse, name=MEANS), replace(surface, name=SURFACE), field),
    )
    assert "0.51 m RMS becomes 2 m" in check_changed_sentences(swapped)
    unchanged = replace(scene(), clouds=(replace(means, name=SPARSE), mvs, means, surface, field))
    check_changed_sentences(unchanged)


def test_cameras_without_a_focus_are_drawn_without_rings(tmp_path, monkeypatch):
    """The axes of a vertical flight are parallel: no lines lead to a focus, and the level elevation is readable."""
    import_or_skip("matplotlib")
    saved = []
    monkeypatch.setattr(figures, "save", lambda figure, path: saved.append(figure))
    level = tuple((10.0 * k, 3.0, 50.0) for k in range(12))
    flight = scene(looked_at=None, region="quantile:0.5", positions=level)
    for drawn in (scene(), flight):
        assert figures.draw_rings([drawn], tmp_path / "rings.png")
    with_focus, without = (figure.axes for figure in saved)
    assert all(axis.lines for axis in with_focus)
    assert not any(axis.lines for axis in without)
    assert np.ptp(without[1].get_ylim()) > 0.3 * np.ptp(without[1].get_xlim())
    check_text(without[1].get_xlabel())


def test_training_without_densification_is_not_called_densification():
    sparse, mvs, means, *others = scene().clouds
    sparse_splats = replace(scene(), clouds=(sparse, mvs, replace(means, points=1000), *others))
    text = check_changed_sentences(sparse_splats)
    assert "adds no points" in text
    assert "increases" not in text


def test_scenes_are_averaged_and_counted():
    sparse, mvs, means, surface, field = scene().clouds
    opposite = replace(
        scene("b"), clouds=(replace(means, name=SPARSE), mvs, replace(sparse, name=MEANS), surface, field)
    )
    text = check_changed_sentences(scene("a"), scene("c", factor=4.0), opposite)
    # Geometric means: 2, 8 and 0.5 m become 0.5, 2 and 2 m, with errors of 0.1 m.
    assert "1.6 times smaller, in 2 of 3 scenes" in text


NON_AFFINE = deformation("non-affine", 0.2, slope=0.004)
UNDECIDED = deformation("undecided").with_warnings([Notice("few", "too few")])


@pytest.mark.parametrize(
    "scenes",
    [
        pytest.param([scene(bends={(MEANS, TRUTH): NON_AFFINE, (SPARSE, MVS): NON_AFFINE})], id="the truth decides"),
        pytest.param([scene(bends={(SURFACE, MVS): NON_AFFINE}, truth=False)], id="without a truth"),
        pytest.param(
            [
                scene("a", {(MEANS, TRUTH): NON_AFFINE}),
                scene("b", {(MVS, TRUTH): NON_AFFINE, (FIELD, TRUTH): UNDECIDED}),
            ],
            id="several scenes",
        ),
        pytest.param(
            [scene(bends={(MVS, TRUTH): replace(deformation("undecided"), conditional_verdict="non-affine")})],
            id="a doubtful pose",
        ),
    ],
)
def test_deformed_clouds_are_named(scenes):
    check_changed_sentences(*scenes)


def test_notes_have_the_errors_of_solved_cameras():
    text = "\n".join(notes(study(scene(cameras=replace(scene().cameras, astray=2)))))
    for value in (
        "0.1 m (median), 0.3 m (largest)",
        "1.0010 times",
        "2 of 40 are outliers",
        "by 0.5 m RMS",
        "by 0.25 m",
    ):
        assert value in text
    assert "position errors" not in "\n".join(notes(study(scene(cameras=None))))


def test_failure_is_a_row_and_a_sentence():
    sparse, mvs, _, surface, field = scene().clouds
    failed_scene = replace(
        scene(),
        clouds=(
            sparse,
            mvs,
            CloudResult(MEANS, failure="out of memory"),
            replace(surface, against=(ReferenceEvaluation(MVS, failure="too few points"), *surface.against[1:])),
            field,
        ),
        views=None,
    )
    result = study(failed_scene, scene("city_2"))
    check_text("\n".join(result.sentences[:2]))
    assert [MEANS in result.sentences[0], SURFACE in result.sentences[1]] == [True, True]
    assert list(failures(result)) == list(result.sentences[:2])
    rows = list(measures_table(result))
    scene_indices = [index for index, row in enumerate(rows) if row[0] in ("city_1", "city_2")]
    assert [rows[index][1] for index in scene_indices] == ["", ""]
    rows_of_first_scene = {(row[0], row[1]): row for row in rows[scene_indices[0] + 1 : scene_indices[1]]}
    assert (MEANS, "failed") in rows_of_first_scene
    assert rows_of_first_scene[(SURFACE, MVS)][3] == "failed"
    assert len(rows) - scene_indices[1] == 1 + 4 + 5
    assert "3.9 times smaller" in " ".join(result.sentences)  # the other scene still counts
    failed_rows = [row for row in csv.DictReader(csv_text(result).splitlines()) if row["failure"]]
    assert [(row["cloud"], row["failure"]) for row in failed_rows] == [
        (MEANS, "out of memory"),
        (SURFACE, "too few points"),
    ]


def test_tables_and_csv_of_a_study():
    result = study(scene())
    header, *rows = measures_table(result)
    assert all(len(row) == len(header) for row in rows)
    assert [(row[0], row[1]) for row in rows[:4]] == [(SPARSE, MVS), (MEANS, MVS), (SURFACE, MVS), (FIELD, MVS)]
    assert [row[0] for row in rows[4:]] == [SPARSE, MVS, MEANS, SURFACE, FIELD]
    first_row = dict(zip(header, rows[0], strict=True))
    assert (first_row["points"], first_row["cropped"]) == ("1,000", "900")
    # Mean squares of 0.1 m and 2 m.
    assert (first_row["D1 c→r"], first_row["D1 r→c"], first_row["Chamfer"], first_row["Hausdorff"]) == (
        "0.01",
        "4",
        "4.01",
        "3",
    )
    assert first_row["bend RMS"] == "0.01 [0.009, 0.011]"
    assert dict(zip(header, rows[4], strict=True))["D2 mesh"] == "–"  # the truth has no Poisson mesh
    seconds = {
        row[0]: row[2]
        for row in cost_table(study(scene(clouds=(replace(scene().clouds[0], resumed=True), *scene().clouds[1:]))))
    }
    assert seconds == {"": "seconds", SPARSE: "≥ 30", MVS: "100", MEANS: "300", SURFACE: "+ 10", FIELD: "200"}
    csv_rows = list(csv.DictReader(csv_text(result).splitlines()))
    assert len(csv_rows) == 9
    assert float(csv_rows[0]["d1_back_mse"]) == pytest.approx(4.0)
    text = markdown(article(result, None))
    assert text.count("\n| ") == 2 + 10 + 6
    assert "sparse, against mvs" in text


def test_study_round_trip(tmp_path):
    original = study(
        scene(bends={(MEANS, MVS): NON_AFFINE}), scene("b", truth=False, views=None, cameras=None, looked_at=None)
    )
    restored = KIND.read(write_study(tmp_path / "a", original))
    assert tuple(sentences(restored)) == original.sentences
    assert restored == original
    (tmp_path / "a/experiment.json").write_text(json.dumps({"schema": "pcbench.experiment.bend/1"}))
    with check_error():
        KIND.read(tmp_path / "a")
    (tmp_path / "a/experiment.json").write_text(json.dumps({"schema": KIND.schema, "scenes": [{}]}))
    with check_error():
        KIND.read(tmp_path / "a")


@pytest.mark.long
def test_figures_are_drawn(tmp_path, run):
    import_or_skip("matplotlib")
    image_of = import_or_skip("PIL.Image").open
    folder = write_study(tmp_path / "a", study(scene(bends={(MEANS, MVS): NON_AFFINE})))
    assert run("plot", folder, "rings")[:2] == (0, f"{folder}/figures/rings.png\n")
    figures = pictures(folder, Figures())
    assert sorted(figures) == ["directions", "growth", "rings"]
    for name in ("directions", "growth"):
        assert figures[name].draw(folder / f"figures/{name}.png")
    for name, color in (("directions", (0xD5, 0x5E, 0)), ("growth", (0xD5, 0x5E, 0)), ("rings", (0, 0x72, 0xB2))):
        pixels = np.asarray(image_of(folder / f"figures/{name}.png").convert("RGB")).astype(int)
        assert (np.abs(pixels - color).max(axis=2) < 12).sum() > 200, name
    failed_clouds = tuple(CloudResult(name, failure="no features") for name in (SPARSE, MVS, MEANS, SURFACE))
    empty = write_study(tmp_path / "b", study(scene(references={}, clouds=failed_clouds, views=None)))
    assert not pictures(empty, Figures())["directions"].draw(tmp_path / "none.png")
