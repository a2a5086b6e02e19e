"""`pcbench experiment gao`: tables, sentences and pictures of figures that are known."""

import csv
import json
from dataclasses import replace

import numpy as np
import pytest
from gao_studies import scene, stored, study, verdict
from optional import import_or_skip
from wording import refused

from pcbench.errors import Notice
from pcbench.report import Figures
from pcbench.studies.gao.figures import pictures
from pcbench.studies.gao.plan import MEANS, MVS, SPARSE, SURFACE
from pcbench.studies.gao.results import SCHEMA, TRUTH, Against, CloudResult, read_study
from pcbench.studies.gao.sentences import sentences
from pcbench.studies.gao.table import cost_table, csv_text, failures, markdown, measures_table


def said(*scenes, **more):
    return " ".join(study(*scenes, **more).sentences)


def test_gains_and_costs_follow_the_figures():
    words = said(scene())
    assert words.startswith("Densification makes 1,000 points of 1,000 (as many). ")
    assert "It gains completeness: mvs to cloud (r→c), 2 m RMS becomes 0.5 m (4 times less)." in words
    assert "It costs accuracy: cloud to mvs (c→r), 0.1 m RMS becomes 0.4 m (4 times as much)." in words
    assert "Against the truth it costs accuracy: cloud to truth (c→r), 0.141 m RMS becomes 0.412 m" in words
    assert "instead of their centres, against truth: c→r 0.412 m RMS becomes 0.224 m (1.8 times less)" in words
    assert "30 s sparse, 100 s more for mvs, 300 s more for splats (3 times mvs); memory up to 256, 256" in words
    assert "at 25.0 dB PSNR, those that were at 30.0 dB: a gap of 5.0 dB" in words
    assert "trained for at most 2,000 steps (density=classic)" in words
    # The other way round: means that are nearer than the sparse points, and miss more.
    sparse, mvs, means, surface = scene().clouds
    turned = replace(
        scene(), clouds=(replace(means, name=SPARSE), mvs, replace(sparse, name=MEANS), replace(surface, name=SURFACE))
    )
    words = said(turned)
    assert "It loses completeness: mvs to cloud (r→c), 0.5 m RMS becomes 2 m" in words
    assert "It gains accuracy" in words
    same = replace(scene(), clouds=(replace(means, name=SPARSE), mvs, means, surface))
    assert "It gains no completeness" in said(same)
    assert "It costs no accuracy" in said(same)


def test_several_scenes_are_averaged_and_counted():
    sparse, mvs, means, surface = scene().clouds
    odd = replace(scene("b"), clouds=(replace(means, name=SPARSE), mvs, replace(sparse, name=MEANS), surface))
    words = said(scene("a"), scene("c", factor=4.0), odd)
    # Geometric means: 2, 8 and 0.5 m become 0.5, 2 and 2 m.
    assert "(r→c), 2 m RMS becomes 1.26 m (1.6 times less, in 2 of 3 scenes)" in words


def test_what_a_reference_of_the_same_images_hides():
    words = said(scene())
    assert "mvs is 0.141 m RMS off the truth (c→r), and the truth that cameras saw is 0.224 m RMS from it" in words
    assert "By the truth sparse is worse than mvs says: c→r 0.1 m RMS becomes 0.141 m" in words
    assert "By the truth splat-means is as far off as mvs says" in words
    ranked = (
        "mvs ranks splat-surface before splat-means before sparse, and the truth gives the same order; with mvs among"
    )
    assert ranked in words
    assert "them: mvs before splat-surface before splat-means before sparse." in words
    assert "The truth is not known" in said(scene(truth=False))


BENT = verdict("non-affine", 0.2, slope=0.004)
LARGE = verdict("non-affine", 0.6)


@pytest.mark.parametrize(
    ("bends", "words"),
    [
        (
            {},
            "solved cameras are 0.1 m (median) to 0.3 m from those of the scene, with 1.0010 times their focal length;"
            " by themselves they deform the surface by 0.5 m RMS beyond a rigid motion, and bend it by 0.25 m beyond an"
            " affine one, in every cloud alike.",
        ),
        (
            {(SPARSE, TRUTH): BENT, (MVS, TRUTH): BENT, (MEANS, TRUTH): LARGE},
            "the bend of sparse and mvs against the truth is no more than what the cameras do; mvs as the reference"
            " does not show that of sparse. the bend of splat-means against the truth is more than what the cameras do",
        ),
        (
            {(MEANS, TRUTH): BENT, (MEANS, MVS): BENT},
            "splat-means and mvs have the same cameras, so cameras are not what bends it against mvs; against the truth"
            " splat-means is bent and mvs is not.",
        ),
        (
            {(SURFACE, MVS): BENT, (MEANS, MVS): BENT, (MVS, TRUTH): BENT},
            "splat-means, splat-surface and mvs have the same cameras, so cameras are not what bends them against mvs;"
            " against the truth mvs is bent and splat-means does not show it; against the truth mvs is bent and",
        ),
        (
            {(SURFACE, MVS): BENT, (MVS, TRUTH): verdict("undecided"), (SURFACE, TRUTH): BENT},
            "against the truth it cannot be told which of the two it is. the bend of splat-surface against the truth",
        ),
    ],
)
def test_where_a_bend_comes_from(bends, words):
    assert words in said(scene(bends=bends))


def test_lost_cameras_are_said():
    words = said(scene(cameras=replace(scene().cameras, astray=2)))
    assert "their focal length (2 of 40 are lost); by themselves the others deform the surface by 0.5 m" in words


def test_true_cameras_bend_nothing():
    words = said(scene(bends={(SPARSE, TRUTH): BENT}, cameras=None), poses="given")
    assert "the bend of sparse against the truth is more than what the cameras do" in words
    assert "solved cameras" not in words


def test_verdicts_in_words():
    bends = {
        (SPARSE, MVS): verdict("undecided").with_warnings([Notice("few", "too few")]),
        (MEANS, MVS): BENT,
        (SURFACE, MVS): verdict("affine"),
    }
    words = said(scene(bends=bends, truth=False))
    assert (
        "against mvs, splat-means is bent by 0.2 [0.18, 0.22] m RMS (rising by 4 ‰ with distance and rising by 4 ‰ with"
        " height); splat-surface is stretched, not bent; sparse: undecided (too few)." in words
    )
    assert "whether cameras bend both cannot be told without a truth" in words


def test_what_fails_is_a_row_and_a_sentence():
    sparse, mvs, _, surface = scene().clouds
    broken = replace(
        scene(),
        clouds=(
            sparse,
            mvs,
            CloudResult(MEANS, failure="out of memory"),
            replace(surface, against=(Against(MVS, failure="too few points"), *surface.against[1:])),
        ),
        views=None,
    )
    found = study(broken, scene("city_2"))
    assert found.sentences[:2] == (
        "city_1 splat-means failed: out of memory",
        "city_1 splat-surface could not be measured against mvs: too few points",
    )
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
    # Mean squares: 0.1 and 2 m.
    assert (first["D1 c→r"], first["D1 r→c"], first["Chamfer"], first["Hausdorff"]) == ("0.01", "4", "4.01", "3")
    assert first["bend RMS"] == "0.01 [0.009, 0.011]"
    assert dict(zip(header, rows[3], strict=True))["D2 mesh"] == "–"  # there is no Poisson mesh of the truth
    took = {
        row[0]: row[2]
        for row in cost_table(study(scene(clouds=(replace(scene().clouds[0], resumed=True), *scene().clouds[1:]))))
    }
    assert took == {"": "seconds", SPARSE: "≥ 30", MVS: "100", MEANS: "300", SURFACE: "+ 10"}
    read = list(csv.DictReader(csv_text(found).splitlines()))
    assert len(read) == 7
    assert float(read[0]["d1_back_mse"]) == pytest.approx(4.0)
    text = markdown(found, None)
    assert text.count("\n| ") == 2 + 8 + 5
    assert "sparse, against mvs" in text


def test_a_study_is_read_as_it_was_written(tmp_path):
    found = study(scene(bends={(MEANS, MVS): BENT}), scene("b", truth=False, views=None, cameras=None, looked_at=None))
    again = read_study(stored(tmp_path / "a", found))
    assert tuple(sentences(again)) == found.sentences
    assert again == found
    (tmp_path / "a/experiment.json").write_text(json.dumps({"schema": "pcbench.experiment.bend/1"}))
    with refused():
        read_study(tmp_path / "a")
    (tmp_path / "a/experiment.json").write_text(json.dumps({"schema": SCHEMA, "scenes": [{}]}))
    with refused():
        read_study(tmp_path / "a")


def test_pictures(tmp_path, run):
    import_or_skip("matplotlib")
    image_of = import_or_skip("PIL.Image").open
    folder = stored(tmp_path / "a", study(scene(bends={(MEANS, MVS): BENT})))
    assert run("plot", folder, "rings")[:2] == (0, f"{folder}/figures/rings.png\n")
    drawn = pictures(folder, Figures())
    assert sorted(drawn) == ["directions", "growth", "rings"]
    for name in ("directions", "growth"):
        assert drawn[name].draw(folder / f"figures/{name}.png")
    for name, color in (("directions", (0xD5, 0x5E, 0)), ("growth", (0xD5, 0x5E, 0)), ("rings", (0, 0x72, 0xB2))):
        pixels = np.asarray(image_of(folder / f"figures/{name}.png").convert("RGB")).astype(int)
        assert (np.abs(pixels - color).max(axis=2) < 12).sum() > 200, name
    lost = tuple(CloudResult(name, failure="no features") for name in (SPARSE, MVS, MEANS, SURFACE))
    empty = stored(tmp_path / "b", study(scene(references={}, clouds=lost, views=None)))
    assert not pictures(empty, Figures())["directions"].draw(tmp_path / "none.png")
