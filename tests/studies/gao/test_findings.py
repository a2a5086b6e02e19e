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
from pcbench.studies.gao.figures import pictures
from pcbench.studies.gao.plan import MEANS, MVS, SPARSE, SURFACE
from pcbench.studies.gao.results import SCHEMA, TRUTH, CloudResult, ReferenceEvaluation, read_study
from pcbench.studies.gao.sentences import sentences
from pcbench.studies.gao.table import cost_table, csv_text, failures, markdown, measures_table


def other_sentences(*scenes, **more):
    """Sentences of a study; those that differ from the default scene's are compared with the golden file."""
    plain, found = study(scene()).sentences, study(*scenes, **more).sentences
    check_text("\n".join(sentence for sentence in found if sentence not in plain))
    return "\n".join(found)


def test_sentences_report_gains_and_costs():
    words = check_text("\n".join(study(scene()).sentences))
    for value in (
        "1,000 points out of 1,000",
        "2 m RMS becomes 0.5 m (4 times less)",
        "0.1 m RMS becomes 0.4 m (4 times as much)",
        "0.141 m RMS becomes 0.412 m",
        "0.412 m RMS becomes 0.224 m (1.8 times less)",
        "30 s for sparse, 100 s more for mvs, 300 s more for splats (3 times mvs)",
        "25.0 dB PSNR",
        "30.0 dB: a gap of 5.0 dB",
        "2,000 steps (density=classic)",
    ):
        assert value in words
    # Swapped: means that are more accurate than the sparse points, but less complete.
    sparse, mvs, means, surface = scene().clouds
    swapped = replace(
        scene(), clouds=(replace(means, name=SPARSE), mvs, replace(sparse, name=MEANS), replace(surface, name=SURFACE))
    )
    assert "0.5 m RMS becomes 2 m" in other_sentences(swapped)
    same = replace(scene(), clouds=(replace(means, name=SPARSE), mvs, means, surface))
    other_sentences(same)


def test_scenes_are_averaged_and_counted():
    sparse, mvs, means, surface = scene().clouds
    odd = replace(scene("b"), clouds=(replace(means, name=SPARSE), mvs, replace(sparse, name=MEANS), surface))
    words = other_sentences(scene("a"), scene("c", factor=4.0), odd)
    # Geometric means: 2, 8 and 0.5 m become 0.5, 2 and 2 m.
    assert "2 m RMS becomes 1.26 m (1.6 times less, in 2 of 3 scenes)" in words


def test_sentences_report_errors_hidden_by_mvs():
    words = "\n".join(study(scene()).sentences)
    for value in (
        "by 0.141 m RMS (c→r)",
        "by 0.224 m RMS (r→c)",
        "0.1 m RMS becomes 0.141 m",
        "splat-surface before splat-means before sparse",
        "mvs before splat-surface before splat-means before sparse",
    ):
        assert value in words
    other_sentences(scene(truth=False))


BENT = deformation("non-affine", 0.2, slope=0.004)
LARGE = deformation("non-affine", 0.6)


@pytest.mark.parametrize(
    "bends",
    [
        pytest.param({(SPARSE, TRUTH): BENT, (MVS, TRUTH): BENT, (MEANS, TRUTH): LARGE}, id="some against the truth"),
        pytest.param({(MEANS, TRUTH): BENT, (MEANS, MVS): BENT}, id="one against both"),
        pytest.param({(SURFACE, MVS): BENT, (MEANS, MVS): BENT, (MVS, TRUTH): BENT}, id="the reference"),
        pytest.param(
            {(SURFACE, MVS): BENT, (MVS, TRUTH): deformation("undecided"), (SURFACE, TRUTH): BENT}, id="undecided"
        ),
    ],
)
def test_causes_of_deformations(bends):
    words = other_sentences(scene(bends=bends))
    for value in ("0.1 m (median), 0.3 m (largest)", "1.0010 times", "by 0.5 m RMS", "by 0.25 m"):
        assert value in words


def test_outlier_cameras_are_reported():
    words = other_sentences(scene(cameras=replace(scene().cameras, astray=2)))
    assert "2 of 40 are outliers" in words


def test_given_cameras_cause_no_deformation():
    words = other_sentences(scene(bends={(SPARSE, TRUTH): BENT}, cameras=None), poses="given")
    assert "position errors" not in words


def test_verdicts_in_words():
    bends = {
        (SPARSE, MVS): deformation("undecided").with_warnings([Notice("few", "too few")]),
        (MEANS, MVS): BENT,
        (SURFACE, MVS): deformation("affine"),
    }
    words = other_sentences(scene(bends=bends, truth=False))
    assert "0.2 [0.18, 0.22] m RMS" in words
    assert words.count("4 ‰") == 2


def test_failure_is_a_row_and_a_sentence():
    sparse, mvs, _, surface = scene().clouds
    broken = replace(
        scene(),
        clouds=(
            sparse,
            mvs,
            CloudResult(MEANS, failure="out of memory"),
            replace(surface, against=(ReferenceEvaluation(MVS, failure="too few points"), *surface.against[1:])),
        ),
        views=None,
    )
    found = study(broken, scene("city_2"))
    check_text("\n".join(found.sentences[:2]))
    assert [MEANS in found.sentences[0], SURFACE in found.sentences[1]] == [True, True]
    assert list(failures(found)) == list(found.sentences[:2])
    rows = list(measures_table(found))
    scenes = [k for k, row in enumerate(rows) if row[0] in ("city_1", "city_2")]
    assert [rows[k][1] for k in scenes] == ["", ""]
    first = {(row[0], row[1]): row for row in rows[scenes[0] + 1 : scenes[1]]}
    assert (MEANS, "failed") in first
    assert first[(SURFACE, MVS)][3] == "failed"
    assert len(rows) - scenes[1] == 1 + 3 + 4
    assert "4 times less" in " ".join(found.sentences)  # the other scene still counts
    lost = [row for row in csv.DictReader(csv_text(found).splitlines()) if row["failure"]]
    assert [(row["cloud"], row["failure"]) for row in lost] == [(MEANS, "out of memory"), (SURFACE, "too few points")]


def test_tables():
    found = study(scene())
    header, *rows = measures_table(found)
    assert all(len(row) == len(header) for row in rows)
    assert [(row[0], row[1]) for row in rows[:3]] == [(SPARSE, MVS), (MEANS, MVS), (SURFACE, MVS)]
    assert [row[0] for row in rows[3:]] == [SPARSE, MVS, MEANS, SURFACE]
    first = dict(zip(header, rows[0], strict=True))
    assert (first["points"], first["cropped"]) == ("1,000", "900")
    # Mean squares of 0.1 m and 2 m.
    assert (first["D1 c→r"], first["D1 r→c"], first["Chamfer"], first["Hausdorff"]) == ("0.01", "4", "4.01", "3")
    assert first["bend RMS"] == "0.01 [0.009, 0.011]"
    assert dict(zip(header, rows[3], strict=True))["D2 mesh"] == "–"  # the truth has no Poisson mesh
    seconds = {
        row[0]: row[2]
        for row in cost_table(study(scene(clouds=(replace(scene().clouds[0], resumed=True), *scene().clouds[1:]))))
    }
    assert seconds == {"": "seconds", SPARSE: "≥ 30", MVS: "100", MEANS: "300", SURFACE: "+ 10"}
    read = list(csv.DictReader(csv_text(found).splitlines()))
    assert len(read) == 7
    assert float(read[0]["d1_back_mse"]) == pytest.approx(4.0)
    text = markdown(found, None)
    assert text.count("\n| ") == 2 + 8 + 5
    assert "sparse, against mvs" in text


def test_study_round_trip(tmp_path):
    found = study(scene(bends={(MEANS, MVS): BENT}), scene("b", truth=False, views=None, cameras=None, looked_at=None))
    again = read_study(write_study(tmp_path / "a", found))
    assert tuple(sentences(again)) == found.sentences
    assert again == found
    (tmp_path / "a/experiment.json").write_text(json.dumps({"schema": "pcbench.experiment.bend/1"}))
    with check_error():
        read_study(tmp_path / "a")
    (tmp_path / "a/experiment.json").write_text(json.dumps({"schema": SCHEMA, "scenes": [{}]}))
    with check_error():
        read_study(tmp_path / "a")


def test_pictures(tmp_path, run):
    import_or_skip("matplotlib")
    image_of = import_or_skip("PIL.Image").open
    folder = write_study(tmp_path / "a", study(scene(bends={(MEANS, MVS): BENT})))
    assert run("plot", folder, "rings")[:2] == (0, f"{folder}/figures/rings.png\n")
    drawn = pictures(folder, Figures())
    assert sorted(drawn) == ["directions", "growth", "rings"]
    for name in ("directions", "growth"):
        assert drawn[name].draw(folder / f"figures/{name}.png")
    for name, color in (("directions", (0xD5, 0x5E, 0)), ("growth", (0xD5, 0x5E, 0)), ("rings", (0, 0x72, 0xB2))):
        pixels = np.asarray(image_of(folder / f"figures/{name}.png").convert("RGB")).astype(int)
        assert (np.abs(pixels - color).max(axis=2) < 12).sum() > 200, name
    lost = tuple(CloudResult(name, failure="no features") for name in (SPARSE, MVS, MEANS, SURFACE))
    empty = write_study(tmp_path / "b", study(scene(references={}, clouds=lost, views=None)))
    assert not pictures(empty, Figures())["directions"].draw(tmp_path / "none.png")
