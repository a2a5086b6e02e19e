"""The option `--tolerance` of `pcbench compare`."""

import json

import pytest
import shapes
from command_line import is_one_line
from wording import check_text

from pcbench import Cloud, write_cloud
from pcbench.measure import plane_sample, reference


@pytest.mark.long
def test_settings_repeat_a_sampled_comparison(files, run, monkeypatch):
    monkeypatch.setattr(reference, "_MIN_SAMPLED_POINTS", 0)
    monkeypatch.setattr(plane_sample, "_FIRST_SIZE", 500)
    for name, count, noise in (("ref", 8000, 0.0), ("a", 6000, 0.1)):
        write_cloud(files / f"{name}.ply", Cloud(shapes.city(count, noise=noise, seed=count)[0]))
    code, out, err = run("compare", "ref.ply", "a.ply", "--tolerance", "20%", "--out", "first", "--no-figures")
    assert code == 0, err
    assert "is estimated from" in out
    assert run("compare", "--settings", "first/settings.json", "--out", "second", "--no-figures")[0] == 0
    first, second = (
        json.loads((files / name / "comparison.json").read_text())["candidates"][0]["metrics"]
        for name in ("first", "second")
    )
    assert first == second


@pytest.mark.parametrize("tolerance", ["0", "100%", "-1%", "nan", "small"])
def test_tolerances_outside_their_range_are_refused(files, run, tolerance):
    code, out, err = run("compare", "ref.ply", "a.ply", "--tolerance", tolerance)
    assert code == 2 and out == "" and is_one_line(err)
    check_text(err)
