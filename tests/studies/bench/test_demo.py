"""The bench at the end of `pcbench demo`."""

import json

import pytest
from optional import break_library, import_or_skip
from wording import check_error

from pcbench.extras import import_problem
from pcbench.plugins.run import Description


@pytest.mark.long
@pytest.mark.parametrize("library", ["pycolmap", "torch"])
def test_demo_reports_why_it_cannot_bench(monkeypatch, tmp_path, library):
    from pcbench.studies.bench import demo

    monkeypatch.setattr(demo, "check_renderer", lambda: None)
    break_library(monkeypatch, tmp_path, library)
    assert demo.why_not() == import_problem(library)
    assert "apt-get install libusb-1.0-0" in demo.why_not()


def test_demo_removes_only_its_own_folder(tmp_path, monkeypatch):
    from pcbench.studies.bench.demo import demo_job

    monkeypatch.setattr("pcbench.scenes.synthetic.files.check_renderer", lambda: None)  # nothing is rendered
    (tmp_path / "city").mkdir()
    foreign_file = tmp_path / "city" / "mine.txt"
    foreign_file.write_text("mine")
    with check_error():
        demo_job(tmp_path / "city", 0, lambda _: None)
    assert foreign_file.read_text() == "mine"


def test_demo_benches_sfm_mvs_and_splat(tmp_path, monkeypatch):
    from pcbench.studies.bench import demo
    from pcbench.studies.bench.plan import Method, trials

    monkeypatch.setattr(demo, "write_scene", lambda folder, settings, step: folder.mkdir())
    job = demo.demo_job(tmp_path / "city", 0, lambda _: None)
    settings_by_method = {"sfm": ("upsample",), "mvs": ("spacing",), "splat": ("steps", "cloud")}
    planned_trials, notes = trials(
        [Method(name, name, Description(settings_by_method[name])) for name in job.methods], job.axes, job.seeds
    )
    assert not notes
    assert [trial.title for trial in planned_trials] == [
        "sfm image_scale=0.5 upsample=false",
        "sfm image_scale=0.5 upsample=true",
        "sfm image_scale=1 upsample=false",
        "sfm image_scale=1 upsample=true",
        "mvs image_scale=0.35",
        "mvs image_scale=0.5",
        "splat image_scale=0.5 cloud=means steps=400",
        "splat image_scale=0.5 cloud=surface steps=400",
    ]


@pytest.mark.slow
def test_demo_ends_with_a_bench(tmp_path, run):
    import_or_skip("pycolmap")
    import_or_skip("torch")
    code, out, _ = run("demo", "--points", 20_000, "--out", tmp_path / "demo")
    assert code == 0
    assert f"bench: {tmp_path / 'demo/bench'}/ has report.html" in out
    assert (tmp_path / "demo/bench/report.html").is_file()
    rows = json.loads((tmp_path / "demo/bench/bench.json").read_text())["rows"]
    assert [(r["method"], r["status"]) for r in rows] == [("sfm", "ok")] * 4 + [("mvs", "ok")] * 2 + [
        ("splat", "ok")
    ] * 2
    assert rows[3]["fscore"] > 0.5
    assert min(r["fscore"] for r in rows[4:6]) > max(r["fscore"] for r in rows[:4])
    assert min(r["precision"] for r in rows[4:6]) > 0.9
    means, surface = rows[6:]
    assert surface["fscore"] > means["fscore"]
    assert (tmp_path / "demo/bench/figures/speed.png").is_file()
    code, out, _ = run("demo", "--points", 20_000, "--out", tmp_path / "demo", "--no-figures")
    assert out.count("(from an earlier bench)") == 8  # the city is the same in all bytes
