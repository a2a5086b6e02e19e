"""What a bench runs: methods, sweeps and seeds, and the mistakes in them."""

import pytest
from benches import counted

from pcbench.plugins.run import Description
from pcbench.studies.bench.plan import Axis, Method, labels, trials


@pytest.mark.parametrize(
    "arguments, message",
    [
        (("--sweep", "image_scale"), "expected --sweep [METHOD.]KEY=VALUE,VALUE,..., got 'image_scale'"),
        (("--sweep", "image_scale=0.5,"), "expected --sweep"),
        (("--sweep", "=1"), "expected --sweep"),
        (("--sweep", "image_scale=0.5,two"), "expected image scales above 0 and up to 1, got 'two'"),
        (("--sweep", "image_scale=2"), "got '2'"),
        (("--sweep", "noise=1,1"), "a value is there twice"),
        (("--sweep", "noise=1", "--set", "noise=2"), "noise is given twice"),
        (("--sweep", "seed=1,2"), "seeds are 0 to N-1 by --seeds N"),
        (("--set", "noise"), "expected --set [METHOD.]KEY=VALUE"),
        (("--sweep", "size=1,2"), "no method has the setting 'size': Good has noise, seed; the scene has image_scale"),
        (("--sweep", "Bad.noise=1"), "there is no method 'Bad' in this bench: there are Good"),
        (("--method", "methods.py:Good"), "is there twice"),
        (("--register", "nonsense"), "unknown registration 'nonsense': expected gauge, icp,"),
        (("--register", "matrix:nowhere.txt"), "nowhere.txt: cannot read a matrix"),
        (("--register", "points:nowhere.txt"), "nowhere.txt"),
        (("--crop", "box:1,2"), "box"),
        (("--crop", "box:900,900,900,901,901,901"), "leaves none of the reference's 10000 points"),
        (("--seeds", "0"), "0 is not in the range"),
        (("--sweep", f"noise={','.join(map(str, range(101)))}", "--seeds", "100"), "10,100 runs are asked for"),
        (("--threshold", "nan"), "expected --threshold as lengths, or as pixels"),
        (("--time-limit", "inf"), "inf is not a finite number"),
        (("--reference", "nowhere.ply"), "nowhere.ply"),
    ],
)
def test_mistakes_are_said_before_anything_runs(here, run, one_process, arguments, message):
    command = ("bench", "photos", "--reference", "truth.ply", "--method", "methods.py:Good", "--out", "out")
    code, out, err = run(*command, *arguments)
    assert (code, out) == (2, "")
    assert err.count("\n") == 1
    assert message in err
    assert counted() == []


def test_no_method_is_a_mistake(here, run):
    assert "at least one --method" in run("bench", "photos", "--reference", "truth.ply", "--out", "out")[2]


def method(label, *settings, problem=None):
    return Method(label, f"x.py:{label}", Description(settings, problem=problem))


def test_the_product_of_sweeps():
    a, b, unknown = method("A", "n", "seed"), method("B", "n", "m"), method("C", problem="it cannot be imported")
    axes = [Axis.sweep("image_scale=0.5,1"), Axis.sweep("n=1,2"), Axis.sweep("B.m=x,y"), Axis.fixed("A.n=7,8")]
    found, notes = trials([a, b, unknown], axes, 2)
    said = [trial.words for trial in found]
    assert said[:4] == [f"A image_scale={s} n=7,8 seed {k}" for s in ("0.5", "1") for k in (0, 1)]
    assert said[4:12] == [f"B image_scale={s} n={n} m={m}" for s in ("0.5", "1") for n in "12" for m in "xy"]
    assert said[12:] == ["C image_scale=0.5", "C image_scale=1"]
    assert found[1].settings == {"n": "7,8", "seed": "1"}
    assert found[1].image_scale == 0.5
    assert found[4].settings == {"n": "1", "m": "x"}
    assert "B has no setting 'seed': one run instead of 2" in notes
    assert "C has no setting 'n': its runs do not vary with it" in notes
    assert labels(["sfm", "a/one.py:M", "two.py:M"]) == ["sfm", "a/one.py:M", "two.py:M"]
    assert labels(["sfm", "a/one.py:M"]) == ["sfm", "M"]
