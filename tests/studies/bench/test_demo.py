"""The bench that ends `pcbench demo`."""

import json

import pytest

from pcbench.errors import InputError


def test_the_demo_says_why_it_has_no_bench(monkeypatch):
    from pcbench.studies.bench import demo

    monkeypatch.setattr(demo, "find_spec", lambda name: None)
    assert demo.why_not() == "pycolmap is needed for the bench: pip install 'pcbench[plot,sfm]'"


def test_the_demo_removes_nothing_but_its_own(tmp_path):
    from pcbench.studies.bench.demo import demo_job

    (tmp_path / "city").mkdir()
    mine = tmp_path / "city" / "mine.txt"
    mine.write_text("mine")
    with pytest.raises(InputError, match="empty"):
        demo_job(tmp_path / "city", 0, lambda _: None)
    assert mine.read_text() == "mine"


@pytest.mark.slow
def test_the_demo_ends_with_a_bench(tmp_path, run):
    pytest.importorskip("pycolmap")
    code, out, _ = run("demo", "--points", 20_000, "--out", tmp_path / "demo")
    assert code == 0
    rows = json.loads((tmp_path / "demo/bench/bench.json").read_text())["rows"]
    assert [r["status"] for r in rows] == ["ok"] * 4
    assert rows[3]["fscore"] > 0.5
    assert (tmp_path / "demo/bench/figures/speed.png").is_file()
    code, out, _ = run("demo", "--points", 20_000, "--out", tmp_path / "demo", "--no-figures")
    assert out.count("(done before)") == 4  # the same city, byte for byte
