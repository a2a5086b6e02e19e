"""Articles of all studies: the page has the tables and sentences of the Markdown file, and hostile names stay text."""

import json
import sys
from dataclasses import replace
from functools import cache, partial

import pytest
import shapes
import stress_studies
from benches import row
from benches import study as study_of_rows
from gao_studies import deformation
from gao_studies import scene as gao_scene
from gao_studies import study as gao_study
from html_pages import HOSTILE, PROVENANCE, check_page_of_study, markdown_tables
from photo_studies import photo_study
from view_folders import write_view_folder
from wording import check_text

from pcbench.errors import Notice
from pcbench.geometry.cloud import Cloud
from pcbench.measure.perceptual import Perceptual
from pcbench.report import to_json
from pcbench.report.article import Bullets, Figure, markdown
from pcbench.report.html import PAGE, InputRow, Origin, article_page
from pcbench.studies.bench import page as bench_page
from pcbench.studies.bench.results import ThresholdScore
from pcbench.studies.bend import page as bend_page
from pcbench.studies.bend.results import BendStudy, BendVerdict, Lens, MutualVerdict, SolutionResult, SurveyedScene
from pcbench.studies.frame.folder import StudyKind
from pcbench.studies.frame.publish import draw_here, write_report, write_results
from pcbench.studies.gao import page as gao_page
from pcbench.studies.gao.plan import MEANS, MVS, SPARSE
from pcbench.studies.gao.results import KIND as GAO
from pcbench.studies.stress import page as stress_page
from pcbench.studies.stress.descriptions import MissingMethod
from pcbench.studies.stress.results import SilentFailure
from pcbench.studies.stress.subject import SILENT
from pcbench.studies.tradeoff import page as tradeoff_page
from pcbench.studies.tradeoff.results import TradeoffSettings
from pcbench.studies.tradeoff.study import run_tradeoff
from pcbench.studies.views import page as views_page
from pcbench.studies.views.scores import ScoredScene, ViewStudy, score_views


def bench_study(name="photos"):
    """Bench in which one configuration is dominated and one failed."""
    at_threshold = ThresholdScore(0.1, 2.0, 0.5, 0.5, 0.5, None, None, 1.0, None, None)
    measured = partial(
        row, points=1234, threshold=0.1, pixels=2.0, peak_rss_bytes=2**28, choices={"image_scale": "0.5"},
        accuracy_to="points", thresholds=(at_threshold,),
    )  # fmt: skip
    rows = [
        measured(name, 1.0, 0.5),
        measured("b", 2.0, 0.9, notes=(name, "warning: few images")),
        measured("c", 3.0, 0.7),
        measured("d", 0.1, None, "failed", message=name),
    ]
    made = study_of_rows(rows, f"/data/{name}/truth.ply", f"/data/{name}", notes=(f"a note on {name}",))
    reference = replace(made.reference, visible_share=0.5, visibility="rays")
    return replace(made, reference=reference, provenance=PROVENANCE)


def bend_study(name="photos"):
    lens = Lens(350.0, 350.0, (0.0, 0.0, 0.0, 0.0), (400, 300))
    factors = {"images": "all", "focal": "true", "distortion": "true", "control": "False"}
    good = BendVerdict("none", "rigid", 0.01, (0.005, 0.015), 0.5, 0.02, None, (name,))
    bent = BendVerdict("non-affine", "cubic", 0.4, (0.3, 0.5), 1e-9, 0.02, None)
    mutual = MutualVerdict("non-affine", "cubic", 0.4, (0.3, 0.5), 1e-9, 0.02, None, against=name)
    rows = (
        SolutionResult(name, factors, 12, 12, None, (name,), 900, 0.5, lens, 0.0, good),
        SolutionResult("dome", {**factors, "distortion": "zero"}, 12, 11, None, (), 800, 0.6, lens, 1.5, bent, mutual),
        SolutionResult("none", factors, 12, 0, name),
    )
    return BendStudy(SurveyedScene(f"/data/{name}", 12, lens, "m"), "sfm", rows, (f"The cause is {name}.",), PROVENANCE)


def known_gao_study(name="city_1"):
    bends = {(MEANS, MVS): deformation("non-affine", 0.05, 1e-3)}
    made = gao_scene(name, bends)
    failed = replace(made.cloud(SPARSE), points=None, against=(), failure=f"{name}: no features")
    return gao_study(made, gao_scene("city_2", clouds=(failed, *made.clouds[1:])))


def view_study(folder, name="city"):
    scored = score_views([write_view_folder(folder, count=18)], perceptual=Perceptual(None, None))
    (scene,) = scored.scenes
    named = ScoredScene(replace(scene.views, scene=name), scene.scores)
    return ViewStudy((named, scene), (Notice("missing", f"{name} has no LPIPS"),))


def stress_study(name="icp"):
    cell = next(cell for cell in stress_studies.study().registrations if cell.outcome == SILENT)
    failure = SilentFailure(replace(cell, method=name), "worst_1.npz")
    return stress_studies.study(worst=(failure,), missing=(MissingMethod(name, f"{name} is not installed"),))


@cache
def tradeoff_study():
    clouds = (Cloud(shapes.city(points, seed=points)[0], unit="m") for points in (400, 200))
    settings = TradeoffSettings(levels=(0.25,), seeds=3, only=("random both",), register="none")
    return run_tradeoff(*clouds, settings).study


def hostile_tradeoff(name):
    study = tradeoff_study()
    rows = tuple(replace(row, name=name) for row in study.rows)
    return replace(study, rows=(*rows, replace(rows[0], message=name)), skipped=(name,))


# Functions that return the article of a study with a name in all texts that users or files choose.
ARTICLES = {
    "bench": lambda name, _: bench_page.article(bench_study(name)),
    "bend": lambda name, _: bend_page.article(bend_study(name)),
    "gao": lambda name, folder: gao_page.article(known_gao_study(name), view_study(folder / "v", name)),
    "stress": lambda name, _: stress_page.article(stress_study(name)),
    "reconstructors": lambda name, _: stress_page.article(photo_study(missing=(MissingMethod(name, name),))),
    "tradeoff": lambda name, _: tradeoff_page.article(hostile_tradeoff(name)),
    "views": lambda name, folder: views_page.article(view_study(folder / "v", name)),
}


def page(article, folder):
    return article_page(article, Origin(PROVENANCE), folder)


def text_of(parsed):
    return " ".join(" ".join(parsed.words).split())


@pytest.mark.parametrize("study", ARTICLES)
def test_page_and_markdown_have_the_same_tables_and_sentences(study, tmp_path):
    article = ARTICLES[study]("name", tmp_path)
    parsed, text = check_page_of_study(page(article, tmp_path)), markdown(article)
    expected = [[row if any(row[1:]) else row[:1] for row in table] for table in markdown_tables(text)]
    assert parsed.tables == expected
    assert len(expected) >= 1 and all(len(table) > 1 for table in expected)
    words = text_of(parsed)
    bullets = [
        sentence for s in article.sections for b in s.blocks if isinstance(b, Bullets) for sentence in b.sentences
    ]
    for sentence in (*article.answer, *article.warnings, *article.setup, *bullets):
        assert sentence in words and sentence in text
    assert words.index(article.answer[0]) < words.index("What not to trust") < words.index(article.sections[0].title)
    assert PROVENANCE["command"] in words and PROVENANCE["machine"] in words


@pytest.mark.parametrize("study", ARTICLES)
def test_hostile_names_stay_text(study, tmp_path):
    name = HOSTILE.replace("\u2028", "") + "\n\u202e"
    hostile, plain = (
        page(ARTICLES[study](text, tmp_path / word), tmp_path) for text, word in ((name, "h"), ("x", "p"))
    )
    parsed = check_page_of_study(hostile)
    assert "img" not in parsed.tags and set(parsed.tags) == set(check_page_of_study(plain).tags)
    assert "\u202e" not in hostile and "{{ 7 * 7 }}" in text_of(parsed)


def test_answers_of_bench_and_views(tmp_path):
    check_text("\n".join(bench_page.article(bench_study()).answer), masked=False)
    study = bench_study()
    seeds = (replace(study.rows[0], seed=1), replace(study.rows[3], method="photos", seed=2))
    for rows in (study.rows[3:], study.rows[:1], seeds):
        check_text("\n".join(bench_page.article(replace(study, rows=rows)).answer), masked=False)
    views = view_study(tmp_path)
    check_text("\n".join(views_page.article(views).answer), masked=False)
    check_text("\n".join(views_page.article(ViewStudy(views.scenes[:1])).answer), masked=False)


def test_answers_are_those_of_the_results(tmp_path):
    study = bench_study()
    best = max(study.rows[:3], key=lambda row: row.score.fscore)
    assert (
        f"{best.method} image_scale=0.5 has the highest F-score of {best.score.fscore:g}"
        in (bench_page.article(study).answer[0])
    )
    scene = view_study(tmp_path).scenes[0]
    assert f"PSNR of {scene.mean(test=True).psnr:.2f}" in "".join(views_page.article(view_study(tmp_path)).answer)


def test_failures_and_limits_are_what_not_to_trust(tmp_path):
    warnings = {study: "\n".join(make("photos", tmp_path / study).warnings) for study, make in ARTICLES.items()}
    assert "d image_scale=0.5, seed 0: failed: photos" in warnings["bench"]
    assert "'none' failed: photos" in warnings["bend"] and "'photos': photos" in warnings["bend"]
    assert "city_2 sparse failed: photos: no features" in warnings["gao"] and "2,000 steps" in warnings["gao"]
    assert "photos has no LPIPS" in warnings["gao"]
    assert "Left out: photos (photos is not installed)." in warnings["stress"]
    assert "skipped: photos" in warnings["tradeoff"] and "failed: photos: photos" in warnings["tradeoff"]
    assert "photos has no LPIPS" in warnings["views"]


def test_gao_links_to_the_reports_that_exist_and_shows_its_pictures(tmp_path):
    (tmp_path / "city_1/against-mvs").mkdir(parents=True)
    (tmp_path / "city_1/against-mvs" / PAGE).touch()
    (tmp_path / "figures").mkdir()
    (tmp_path / "figures/rings.png").write_bytes(b"a picture")
    study = known_gao_study()
    reports = ["city_1/against-mvs", "city_1/against-truth"]
    article = gao_page.article(study, None, ["figures/rings.png"], reports=reports)
    parsed = check_page_of_study(page(article, tmp_path))
    assert parsed.values("href") == ["./city_1/against-mvs/report.html"]
    assert len(parsed.values("src")) == 1
    cells = [cell for table in parsed.tables for row in table for cell in row]
    values = json.loads(to_json(GAO.values(study)))
    points = [cloud["points"] for cloud in values["scenes"][0]["clouds"]]
    assert all(f"{count:,}" in cells for count in points)


def test_bench_and_stress_show_speed_and_stability():
    charts = ["figures/speed.png", "figures/accuracy_completeness.png"]
    shown = [
        b.file for s in bench_page.article(bench_study(), charts).sections for b in s.blocks if isinstance(b, Figure)
    ]
    assert shown == charts
    names = ["outcomes_registration.png", "speed.png", "profiles.png", "severity_registration_start.png", "worst_1.png"]
    files = [f"figures/{name}" for name in names]
    article = stress_page.article(stress_study(), files)
    shown = [b.file for s in article.sections for b in s.blocks if isinstance(b, Figure)]
    assert sorted(shown) == sorted(files)


KIND = StudyKind("bend", "experiment.json", "pcbench.bend/1", BendStudy, "bend.md")


def test_new_results_replace_the_pages_or_remove_them(tmp_path, monkeypatch):
    article = bend_page.article(bend_study())
    inputs = [InputRow("scene", "photos", "c" * 64)]
    assert write_report(tmp_path, KIND, lambda: article, PROVENANCE, inputs) is None
    assert "c" * 64 in (tmp_path / PAGE).read_text(encoding="utf-8")
    assert (tmp_path / "bend.md").read_text(encoding="utf-8") == markdown(article)
    write_results(tmp_path, KIND, {"experiment.json": "{}"})
    assert [path.name for path in tmp_path.iterdir()] == ["experiment.json"]
    assert write_report(tmp_path, replace(KIND, markdown=""), lambda: article, None) is None
    second = check_page_of_study((tmp_path / PAGE).read_text(encoding="utf-8"))
    assert PROVENANCE["machine"] not in text_of(second)
    assert not (tmp_path / "bend.md").exists()
    monkeypatch.setitem(sys.modules, "jinja2", None)
    assert check_text(write_report(tmp_path, KIND, lambda: article, PROVENANCE)).count("\n") == 0
    assert not (tmp_path / PAGE).exists() and (tmp_path / "bend.md").exists()


def test_results_do_not_depend_on_the_article_or_on_pictures(tmp_path):
    def fail():
        raise KeyError("an unknown picture")

    write_results(tmp_path, KIND, {"experiment.json": "{}"})
    check_text(write_report(tmp_path, KIND, fail, PROVENANCE))
    check_text(draw_here(fail).problem)
    assert [path.name for path in tmp_path.iterdir()] == ["experiment.json"]
