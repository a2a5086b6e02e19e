"""Rendered views: scores, means over blocks and scenes, table, pictures and command."""

import csv
import json
import math
import textwrap
from dataclasses import astuple
from unittest.mock import Mock

import numpy as np
import pytest
from command_line import is_one_line
from optional import import_or_skip
from scene_folders import orbit, ten_images_folder
from view_folders import photograph, psnr_of, write_view_folder
from wording import check_error, check_text

from pcbench.errors import ReconstructionError
from pcbench.io.colmap_model import write_colmap_model
from pcbench.io.json_values import to_json
from pcbench.measure.images import ssim
from pcbench.measure.perceptual import Perceptual
from pcbench.report.article import markdown
from pcbench.report.figures import Figures
from pcbench.scenes.splits import split_every
from pcbench.scenes.views import ViewImages, write_views
from pcbench.studies.frame.folder import write_files
from pcbench.studies.views.page import article
from pcbench.studies.views.pictures import draw_views, select_views, title_of
from pcbench.studies.views.runs import ViewsJob, run_views
from pcbench.studies.views.scores import KIND, score_views, scores_csv
from pcbench.studies.views.table import sentences, table

Image = import_or_skip("PIL.Image")

NO_PERCEPTUAL_METRICS = Perceptual(None, None)
SPLIT_OF_NINE = split_every([f"{k}.png" for k in range(9)])

# A user's reconstructor that renders all views in one grey.
PAINTER = textwrap.dedent(
    """
    from dataclasses import dataclass
    import numpy as np
    from pcbench.geometry.cloud import Cloud
    from pcbench.plugins import Reconstruction
    from pcbench.scenes.splits import hold_out
    from pcbench.scenes.views import ViewImages, write_views

    @dataclass(frozen=True)
    class Painter:
        "Grey."
        hold_out: str = "none"
        grey: float = 0.5

        def reconstruct(self, scene, workspace):
            split = hold_out(scene.images, self.hold_out)

            def render(name):
                photograph = scene.read_image(name)
                return ViewImages(name, np.full(photograph.shape, self.grey), photograph)

            write_views(workspace / "rendered", scene.name, "painter", split, render)
            return Reconstruction(Cloud(np.zeros((4, 3))), "arbitrary")

    @dataclass(frozen=True)
    class Silent:
        "No views."
        hold_out: str = "none"

        def reconstruct(self, scene, workspace):
            return Reconstruction(Cloud(np.zeros((4, 3))), "arbitrary")
    """
)


def test_scores_of_views_and_means(tmp_path):
    (scene,) = score_views([write_view_folder(tmp_path)], perceptual=NO_PERCEPTUAL_METRICS).scenes
    test, train = (0, 8, 16), [k for k in range(18) if k % 8]
    for scored in (*scene.select(test=True), *scene.select(test=False)):
        number = int(scored.view.name.removesuffix(".png"))
        truth = photograph(number)
        assert scored.scores.psnr == pytest.approx(psnr_of(number))
        assert scored.scores.ssim == ssim(truth + np.uint8(8 + number), truth)
    assert scene.mean(test=True).psnr == pytest.approx(np.mean([psnr_of(k) for k in test]))
    assert scene.mean(test=False).psnr == pytest.approx(np.mean([psnr_of(k) for k in train]))
    assert scene.mean(test=True).lpips is None
    assert scene.standard_error() == pytest.approx(np.std([psnr_of(k) for k in test], ddof=1) / math.sqrt(3))


def test_standard_error_is_computed_over_blocks(tmp_path):
    (scene,) = score_views([write_view_folder(tmp_path, count=40, blocks=2)], perceptual=NO_PERCEPTUAL_METRICS).scenes
    numbers_by_block = {}
    for scored in scene.select(test=True):
        numbers_by_block.setdefault(scored.view.block, []).append(int(scored.view.name[:-4]))
    means = [np.mean([psnr_of(k) for k in block]) for block in numbers_by_block.values()]
    assert [len(block) for block in numbers_by_block.values()] == [2, 2]
    assert scene.standard_error() == pytest.approx(np.std(means, ddof=1) / math.sqrt(2))


def test_scores_round_trip(tmp_path):
    empty_mask = np.zeros((48, 64), dtype=bool)
    folders = [write_view_folder(tmp_path / "a"), write_view_folder(tmp_path / "b", "masked", 9, mask=empty_mask)]
    write_views(
        tmp_path / "c", "same", "splat", SPLIT_OF_NINE, lambda name: ViewImages(name, photograph(1), photograph(1))
    )
    study = score_views([*folders, tmp_path / "c"], perceptual=NO_PERCEPTUAL_METRICS)
    write_files(tmp_path, {"scores.csv": scores_csv(study), "scores.json": to_json(KIND.values(study))})
    restored = KIND.read(tmp_path)
    assert restored.notes == study.notes
    assert [note.code for note in study.notes] == ["masked-views"]
    for scene, other in zip(study.scenes, restored.scenes, strict=True):
        assert other.views == scene.views
        here, there = (np.array([astuple(scores) for scores in one.scores], float) for one in (scene, other))
        np.testing.assert_array_equal(here, there)
    rows = list(csv.DictReader((tmp_path / "scores.csv").read_text().splitlines()))
    assert len(rows) == 18 + 9 + 9
    assert float(rows[0]["psnr"]) == study.scenes[0].scores[0].psnr
    assert [row["set"] for row in rows[:18]] == ["train"] * 15 + ["test"] * 3
    document = json.loads((tmp_path / "scores.json").read_text())
    assert document["scenes"][0]["test"]["psnr"] == pytest.approx(study.scenes[0].mean(test=True).psnr)
    assert document["scenes"][2]["test"]["psnr"] == "inf"
    write_view_folder(tmp_path / "a", count=20)
    with check_error():
        KIND.read(tmp_path)


def test_table_has_one_row_per_scene_and_a_mean(tmp_path):
    study = score_views(
        [write_view_folder(tmp_path / "a", "near", 9), write_view_folder(tmp_path / "b", "far", 18)],
        perceptual=NO_PERCEPTUAL_METRICS,
    )
    header, near_row, far_row, mean_row = table(study)
    assert header == ["scene", "held out", "views", "train PSNR", "train SSIM", "test PSNR", "test SSIM"]
    assert near_row[:3] == ["near", "one image in 8", "7 + 2"]
    error = study.scenes[0].standard_error()
    assert near_row[5] == f"{(psnr_of(0) + psnr_of(8)) / 2:.2f} ± {error:.2f}"
    assert far_row[3] == f"{np.mean([psnr_of(k) for k in range(18) if k % 8]):.2f}"
    test_psnrs = [scene.mean(test=True).psnr for scene in study.scenes]
    assert mean_row[0] == "mean of 2"
    assert mean_row[5] == f"{np.mean(test_psnrs):.2f}"
    assert markdown(article(study)).count("\n| ") == 5
    check_text("\n".join(sentences(study)))
    study_of_two_methods = score_views(
        [tmp_path / "a", write_view_folder(tmp_path / "c", "near", 9, method="mine")], perceptual=NO_PERCEPTUAL_METRICS
    )
    assert [row[1] for row in table(study_of_two_methods)[:3]] == ["method", "splat", "mine"]


def test_measured_metrics_have_columns(tmp_path):
    perceptual = Perceptual(lambda *_: 0.25, None)
    study = score_views([write_view_folder(tmp_path, count=9)], perceptual=perceptual)
    header, row = table(study)
    assert row[header.index("test LPIPS")] == "0.250"
    assert not any("FLIP" in name for name in header)


def test_worst_median_and_best_views_are_selected(tmp_path):
    (scene,) = score_views([write_view_folder(tmp_path / "a", count=40)], perceptual=NO_PERCEPTUAL_METRICS).scenes
    assert {word: s.view.name for word, s in select_views(scene).items()} == {
        "worst": "32.png",
        "median": "16.png",
        "best": "0.png",
    }
    check_text(title_of(scene))
    (scene,) = score_views([write_view_folder(tmp_path / "b", count=9)], perceptual=NO_PERCEPTUAL_METRICS).scenes
    assert {word: s.view.name for word, s in select_views(scene).items()} == {"worst": "8.png", "best": "0.png"}
    assert "median" not in check_text(title_of(scene))


def test_picture_shows_photograph_rendering_and_error(tmp_path):
    """The patch with the largest errors is yellow, the rest is dark."""
    import_or_skip("matplotlib")
    truth = np.full((48, 64, 3), (90, 60, 30), dtype=np.uint8)
    image = truth + np.uint8(6)
    image[10:14, 20:24] += 100
    mask = np.ones((48, 64), dtype=bool)
    mask[30:, :20] = False
    split = SPLIT_OF_NINE
    write_views(tmp_path / "v", "city", "splat", split, lambda name: ViewImages(name, image, truth, mask))
    (scene,) = score_views([tmp_path / "v"], perceptual=NO_PERCEPTUAL_METRICS).scenes
    path = tmp_path / "p.png"
    draw_views({"best": scene.select(test=True)[0]}, "a title", path, Figures(range=50.0))
    pixels = np.array(Image.open(path).convert("RGB")).astype(int)

    def count_pixels(color):
        return float((np.abs(pixels - color).max(axis=2) <= 2).mean() * pixels.shape[0] * pixels.shape[1])

    panel = count_pixels((90, 60, 30))  # pixels of the photograph
    assert panel > 1e5
    assert count_pixels((196, 166, 136)) / panel == pytest.approx(16 / (48 * 64), rel=0.1)
    assert count_pixels((253, 231, 37)) / panel == pytest.approx(16 / (48 * 64), rel=0.6)  # and a part of the bar
    assert count_pixels((150, 150, 150)) / panel == pytest.approx(18 * 20 / (48 * 64), rel=0.1)


def test_missing_views_are_rendered(tmp_path):
    plugin = tmp_path / "painter.py"
    plugin.write_text(PAINTER)
    scenes = [ten_images_folder(tmp_path / name) for name in ("one", "two")]
    for scene in scenes:
        write_colmap_model(scene / "sparse/0", orbit([f"{k}.png" for k in range(10)]))
    workspace = write_view_folder(tmp_path / "three" / "plugin" / "rendered", "three", 9).parent.parent
    (tmp_path / "empty").mkdir()
    out = tmp_path / "out"
    job = ViewsJob((*scenes, workspace, tmp_path / "empty"), f"{plugin}:Painter", {"hold_out": "every", "grey": "0.25"})
    study = run_views(job, out, figures=False).study
    assert [scene.views.scene for scene in study.scenes] == ["one", "two", "three"]
    assert [len(scene.select(test=True)) for scene in study.scenes] == [2, 2, 2]
    assert study.notes[0].code == "no-views"
    assert "empty" in study.notes[0].text
    first_view = study.scenes[0].select(test=True)[0]
    assert (first_view.view.read().rendering == 64).all()
    assert (out / "views.md").read_text().count("\n| ") == 6
    with check_error():
        run_views(job, tmp_path / "one")


def test_scores_do_not_depend_on_the_page(tmp_path, monkeypatch):
    out, job = tmp_path / "out", ViewsJob((write_view_folder(tmp_path / "a", "near", 9),))
    assert run_views(job, out, figures=False).without_page is None
    assert (out / "views.md").is_file() and (out / "report.html").is_file()
    monkeypatch.setattr("pcbench.studies.views.runs.article", Mock(side_effect=KeyError("near_splat")))
    check_text(run_views(job, out, figures=False).without_page)
    assert len(KIND.read(out).scenes) == 1
    assert not (out / "views.md").exists() and not (out / "report.html").exists()


def test_views_command(tmp_path, run, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_view_folder(tmp_path / "a", "near", 9)
    write_view_folder(tmp_path / "b", "far", 18)
    code, out, _ = run("views", "a", "b", "--out", "out", "--no-figures")
    lines = out.splitlines()
    assert code == 0
    assert lines[0].split()[:2] == ["scene", "held"]
    assert [line.split()[0] for line in lines[1:4]] == ["near", "far", "mean"]
    assert lines[-1].startswith("views: out/ has report.html")
    assert {path.name for path in (tmp_path / "out").iterdir()} == {
        "study.json",
        "scores.json",
        "scores.csv",
        "views.md",
        "report.html",
        "runs",
    }
    import_or_skip("matplotlib")
    code, out, _ = run("plot", "out", "near_splat", "--range", "20")
    assert (code, out) == (0, "out/figures/near_splat.png\n")
    with Image.open("out/figures/near_splat.png") as image:
        assert image.width > 1000
    for arguments in (("nowhere", "--out", "other"), ("a", "--out", "b")):
        code, _, err = run("views", *arguments)
        assert code == 2
        assert is_one_line(err)


@pytest.mark.parametrize("name", ["Silent", "Nobody"])
def test_method_without_views_is_an_error(tmp_path, name):
    (tmp_path / "painter.py").write_text(PAINTER)
    scene = ten_images_folder(tmp_path / "one")
    with check_error(ReconstructionError):
        run_views(ViewsJob((scene,), f"{tmp_path}/painter.py:{name}"), tmp_path / "out")


def test_views_without_held_out_images_are_rejected_early(tmp_path, run):
    code, _, err = run(
        "views", str(ten_images_folder(tmp_path / "one")), "--out", str(tmp_path / "o"), "--set", "hold_out=none"
    )
    assert code == 2
    assert is_one_line(err)
    check_text(err)
    assert not (tmp_path / "o").exists()


def test_workspace_without_renderings_is_rejected_early(tmp_path, run):
    (tmp_path / "cloud.work/plugin").mkdir(parents=True)
    (tmp_path / "cloud.work/job.json").write_text("{}")
    code, _, err = run("views", tmp_path / "cloud.work", "--out", tmp_path / "o")
    assert code == 2
    assert is_one_line(err)
    assert "--set hold_out=every" in check_text(err)
    assert not (tmp_path / "o").exists()
