"""The runs of a bench: methods, sweeps and seeds, and wrong options."""

import pytest
from benches import executed_methods
from wording import check_text

from pcbench.plugins.run import Description
from pcbench.studies.bench.plan import Axis, Method, labels, trials


@pytest.mark.parametrize(
    "arguments",
    [
        ("--sweep", "image_scale"),
        ("--sweep", "image_scale=0.5,"),
        ("--sweep", "=1"),
        ("--sweep", "image_scale=0.5,two"),
        ("--sweep", "image_scale=2"),
        ("--sweep", "noise=1,1"),
        ("--sweep", "noise=1", "--set", "noise=2"),
        ("--sweep", "seed=1,2"),
        ("--set", "noise"),
        ("--sweep", "size=1,2"),
        ("--sweep", "Bad.noise=1"),
        ("--method", "methods.py:Good"),
        ("--register", "nonsense"),
        ("--register", "matrix:nowhere.txt"),
        ("--register", "points:nowhere.txt"),
        ("--crop", "box:1,2"),
        ("--crop", "box:900,900,900,901,901,901"),
        ("--sweep", f"noise={','.join(map(str, range(101)))}", "--seeds", "100"),
        ("--threshold", "nan"),
        ("--time-limit", "inf"),
        ("--reference", "nowhere.ply"),
    ],
)
def test_wrong_options_are_rejected_before_any_run(bench_folder, run, in_process, arguments):
    command = ("bench", "photos", "--reference", "truth.ply", "--method", "methods.py:Good", "--out", "out")
    code, out, err = run(*command, *arguments)
    assert (code, out) == (2, "")
    assert err.count("\n") == 1
    check_text(err.partition(" (see ")[0])  # the rest depends on how pytest was started
    assert executed_methods() == []


def test_zero_seeds_are_rejected(bench_folder, run):
    code, _, err = run("bench", "photos", "--reference", "truth.ply", "--method", "methods.py:Good", "--seeds", "0")
    assert code == 2
    assert "--seeds" in err  # the rest is click's message


def test_missing_method_is_rejected(bench_folder, run):
    assert "--method" in check_text(run("bench", "photos", "--reference", "truth.ply", "--out", "out")[2])


def method(label, *settings, problem=None):
    return Method(label, f"x.py:{label}", Description(settings, problem=problem))


def test_trials_are_the_product_of_sweeps():
    a, b, unusable = method("A", "n", "seed"), method("B", "n", "m"), method("C", problem="it cannot be imported")
    axes = [Axis.sweep("image_scale=0.5,1"), Axis.sweep("n=1,2"), Axis.sweep("B.m=x,y"), Axis.setting("A.n=7,8")]
    planned_trials, notes = trials([a, b, unusable], axes, 2)
    titles = [trial.title for trial in planned_trials]
    assert titles[:4] == [f"A image_scale={s} n=7,8 seed {k}" for s in ("0.5", "1") for k in (0, 1)]
    assert titles[4:12] == [f"B image_scale={s} n={n} m={m}" for s in ("0.5", "1") for n in "12" for m in "xy"]
    assert titles[12:] == ["C image_scale=0.5", "C image_scale=1"]
    assert planned_trials[1].settings == {"n": "7,8", "seed": "1"}
    assert planned_trials[1].image_scale == 0.5
    assert planned_trials[4].settings == {"n": "1", "m": "x"}
    check_text("\n".join(notes))
    assert labels(["sfm", "a/one.py:M", "two.py:M"]) == ["sfm", "a/one.py:M", "two.py:M"]
    assert labels(["sfm", "a/one.py:M"]) == ["sfm", "M"]
