"""User-defined metrics: what they get, what they may return, how they are named, and where their values appear."""

import csv
import io
import json
import math
import sys
from fractions import Fraction
from importlib.metadata import EntryPoint
from pathlib import Path

import numpy as np
import oracles
import pytest
import shapes
from wording import check_error, check_text

from pcbench import Box, Cloud, Settings, compare
from pcbench.comparison.request import Request
from pcbench.comparison.run import run as run_request
from pcbench.measure.own_metrics import (
    FAILED_METRIC,
    MetricValue,
    OwnMetric,
    check_metrics,
    measure_own,
    own_metrics_between,
    own_scores,
)
from pcbench.report import document, html, markdown
from pcbench.report.exports import TABLES
from pcbench.report.folder import read_settings
from pcbench.report.notes import warnings

OFFSET = np.array([4e5, 5e6, 100.0])


def keep(pair):
    """The pair itself, kept for the tests."""
    keep.pair = pair
    return 1.0


def largest(pair):
    """Largest distance of each direction."""
    return {
        "candidate_to_reference": pair.accuracy.distances.max(),
        "reference_to_candidate": np.float32(2.5),
        "angle": MetricValue(30, (20, 40), "deg"),
    }


def mean(pair):
    """Mean distance to the nearest point.

    More is not shown.
    """
    return MetricValue(pair.accuracy.distances.mean(), (0.0, 1.0), "length")


def absent(pair):
    return MetricValue(None)


def broken(pair):
    pair.accuracy.distances[0] = 0
    return 1.0


@pytest.fixture(scope="module")
def clouds():
    reference = Cloud(OFFSET + shapes.terrain(600, seed=1)[0], unit="m")
    return reference, Cloud(OFFSET + shapes.terrain(300, seed=2)[0])


@pytest.fixture(scope="module")
def comparison(clouds):
    return compare(clouds[0], {"a": clouds[1]}, register="none", metrics=(largest, mean, absent, broken))


@pytest.mark.parametrize("crop", ["none", Box(OFFSET + [-5, -5, -20], OFFSET + [5, 5, 20])])
def test_a_metric_gets_the_closest_points_of_both_directions(clouds, crop):
    reference, candidate = clouds
    result = compare(reference, {"a": candidate}, register="none", crop=crop, metrics=(keep,))["a"]
    pair = keep.pair
    assert pair.unit == "m"
    # The points were moved by whole numbers, so only the last bits of the large coordinates are lost.
    np.testing.assert_allclose(pair.reference + pair.origin, reference.points, atol=1e-9)
    np.testing.assert_allclose(pair.candidate + pair.origin, candidate.points, atol=1e-9)
    for way, ours, others in (
        (pair.accuracy, pair.candidate, pair.reference),
        (pair.completeness, pair.reference, pair.candidate),
    ):
        inside = np.ones(len(ours), bool) if crop == "none" else crop.contains(ours + pair.origin)
        np.testing.assert_array_equal(way.points, ours[inside])
        distances, indices = oracles.nearest(way.points, others)
        np.testing.assert_allclose(way.distances, distances, rtol=1e-12, atol=1e-12)
        np.testing.assert_array_equal(way.indices, indices)
        np.testing.assert_array_equal(way.closest, others[indices])
        np.testing.assert_allclose(np.linalg.norm(way.normals, axis=1), 1, rtol=1e-12)
    signed = np.einsum("ij,ij->i", pair.accuracy.points - pair.accuracy.closest, pair.accuracy.normals)
    np.testing.assert_allclose(np.mean(signed**2), result.metrics.d2_mse.accuracy.value, rtol=1e-9)
    ways = [*vars(pair.accuracy).values(), *vars(pair.completeness).values()]
    assert not any(array.flags.writeable for array in (pair.candidate, pair.reference, pair.origin, *ways))


def test_values_are_in_all_outputs(comparison):
    (values,) = document(comparison)["candidates"]
    metrics, stored = comparison["a"].metrics, values["metrics"]["own"]
    farthest, average = metrics.hausdorff.accuracy.largest, metrics.mean_distance.accuracy.value
    assert stored["mean"] == metrics.own["mean"].value == pytest.approx(average, rel=1e-12)
    assert stored["ci"] == {"mean": [0.0, 1.0]}
    assert stored["largest"]["candidate_to_reference"] == farthest
    assert stored["largest"]["angle"] == metrics.own["largest"].values["angle"].value == 30
    assert stored["largest"]["ci"] == {"angle": [20.0, 40.0]}
    assert stored["absent"] is None
    assert stored["broken"] is None
    table = csv.DictReader(io.StringIO(TABLES["csv"](comparison)))
    rows = {(row["metric"], row["variant"], row["direction"]): row for row in table}
    assert rows["own.mean", "", ""]["definition"] == "Mean distance to the nearest point."
    assert (rows["own.mean", "", ""]["unit"], rows["own.mean", "", ""]["ci_high"]) == ("m", "1.0")
    assert float(rows["own.largest", "", "candidate_to_reference"]["value"]) == farthest
    assert rows["own.largest", "angle", ""]["unit"] == "deg"
    assert rows["own.broken", "", ""]["value"] == ""
    for table in (TABLES["latex"](comparison), markdown(comparison), html(comparison)):
        assert f"{average:.4g}" in table
        for name in ("mean", "largest", "largest.angle", "broken"):
            assert f"own.{name}" in table.replace(r"\_", "_")


def test_a_metric_that_fails_is_missing_with_a_warning(comparison):
    (notice,) = [notice for notice in comparison["a"].warnings if notice.code == FAILED_METRIC]
    line = broken.__code__.co_firstlineno + 1
    assert notice.text.endswith(f"({__file__}, line {line})")
    check_text(notice.text.replace(__file__, "FILE"))
    assert str(comparison["a"]).splitlines()[1:] == [f"  warning: {notice.text}"]
    assert str(comparison).splitlines()[2:] == [f"  warning: a: {notice.text}"]
    assert f"a: {notice.text}" in warnings(comparison)  # as on the command line


def returns(value):
    def metric(pair):
        return value

    return metric


def raises(error):
    def metric(pair):
        raise error

    return metric


@pytest.mark.parametrize(
    "function",
    [
        *map(returns, (None, math.nan, math.inf, "0.1", True, 10**400, 10**5000, 1j, [1.0], (1.0, 0.0, 2.0), object())),
        *map(returns, (np.zeros(3), np.array(np.nan), {}, {"a": None}, {"a b": 1.0}, {"ci": 1.0}, {3: 1.0}, {"a": {}})),
        *map(returns, (MetricValue(1.0, (2.0, 1.0)), MetricValue(1.0, (0.0,)), MetricValue(1.0, (0.0, math.nan)))),
        returns(MetricValue(1.0, None, 3)),
        returns(MetricValue(1.0, better="more")),
        *map(raises, (ValueError("two\nlines"), SystemExit(3), RecursionError(), MemoryError(), UnicodeError("\x1b"))),
        lambda: 1.0,
    ],
)
def test_what_a_metric_may_not_do_is_a_warning(clouds, function):
    results, notices = own_metrics_between([OwnMetric("own", "here:own", function)], clouds[1], clouds[0])
    assert (results["own"].values, results["own"].value) == ({}, None)
    (notice,) = notices
    assert notice.text.startswith("the metric own is missing: ")
    assert f"({__file__}, line " in notice.text or "positional argument" in notice.text


@pytest.mark.parametrize("value", [1, 1.5, np.float32(1.5), np.int64(3), Fraction(1, 2), MetricValue(0.5)])
def test_numbers_of_all_kinds_are_values(clouds, value):
    results, notices = own_metrics_between([OwnMetric("own", "here:own", returns(value))], *clouds)
    expected = value.value if isinstance(value, MetricValue) else value
    assert (results["own"].value, notices) == (float(expected), ())


def test_values_are_scores_of_a_protocol(clouds):
    def spread(pair):
        return {"low": MetricValue(1.0, unit="length^2", better="lower"), "count": 3}

    results, _ = measured = own_metrics_between(check_metrics([mean, spread, broken]), *clouds)
    scores = own_scores(measured, "m")
    assert [score.name for score in scores] == ["own.mean", "own.spread.low", "own.spread.count", "own.broken"]
    assert scores[0] == ("own.mean", results["mean"].value, "m", None)
    assert scores[1] == ("own.spread.low", 1.0, "m^2", "lower")
    assert scores[3].value is None
    assert own_scores(measured, None)[0].unit == ""


def test_ctrl_c_ends_a_metric(clouds):
    with pytest.raises(KeyboardInterrupt):
        own_metrics_between([OwnMetric("own", "here:own", raises(KeyboardInterrupt()))], *clouds)


def test_what_a_metric_prints_goes_to_standard_error(clouds, capsys):
    def talks(pair):
        print("said")
        return 1.0

    own_metrics_between(check_metrics([talks]), *clouds)
    assert capsys.readouterr() == ("", "said\n")


def test_two_clouds_are_measured_as_they_are(clouds):
    results, _ = own_metrics_between([OwnMetric.of(mean)], clouds[1], clouds[0].points, unit="ft")
    assert results["mean"].value == pytest.approx(
        oracles.nearest(clouds[1].points, clouds[0].points)[0].mean(), rel=1e-6
    )


SOURCE = "def one(pair):\n    return 1.0\n\n\nclass Other: ...\n\n\nnumber = 3\n"


@pytest.fixture
def own(tmp_path, monkeypatch):
    """Write own.py to the current folder."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "own.py").write_text(SOURCE)
    return tmp_path / "own.py"


@pytest.mark.parametrize(
    "given",
    [
        "own.py",
        "own.py:",
        "own.py:two",
        "own.py:Other",
        "own.py:number",
        "missing.py:one",
        "broken.py:one",
        "exits.py:one",
        "nowhere_at_all",
        "own.py:naïve",
        "own.py:ci",
        3,
        lambda pair: 1.0,
        OwnMetric,
    ],
)
def test_other_metrics_are_refused(own, given):
    own.with_name("broken.py").write_text("1 / 0\n")
    own.with_name("exits.py").write_text("import sys\nsys.exit(0)\n")
    with check_error():
        OwnMetric.of(given)


@pytest.mark.parametrize(
    "metrics", [(mean, mean), ("own.py:mean", mean), ("a.py:x", "b.py:x"), "own.py:one", 3, ("recall@x",)]
)
def test_names_are_different(metrics):
    with check_error():
        Settings(metrics=metrics)


def test_a_threshold_in_a_name_is_one_of_the_settings():
    assert Settings(metrics=("fscore@0.2", mean)) == Settings(metrics=(mean,), thresholds=(0.2,))
    assert Settings(metrics=("fscore@0.2", "recall@0.1"), thresholds=(0.1,)).thresholds == (0.1, 0.2)


def test_the_file_of_two_metrics_is_one_input():
    assert Settings(metrics=("own.py:one", "own.py:two")).files == [Path("own.py")]


def test_a_file_or_a_module_names_a_metric(own, monkeypatch):
    metric = OwnMetric.of("own.py:one")
    assert (metric.name, metric.text, metric.path) == ("one", f"{own}:one", own)
    assert metric.function(None) == 1.0
    monkeypatch.syspath_prepend(own.parent)
    assert OwnMetric.of("own:one").text == "own:one"
    del sys.modules["own"]
    assert OwnMetric.of(mean).text == f"{mean.__module__}:mean"


def test_installed_metrics_are_named_by_their_entry_point(own, monkeypatch):
    points = [EntryPoint("trimmed-mean", "own:one", "pcbench.metrics"), *2 * [EntryPoint("two", "own:one", "g")]]
    monkeypatch.setattr("pcbench.io.named_code.entry_points", lambda group: points)
    monkeypatch.syspath_prepend(own.parent)
    metric = OwnMetric.of("trimmed-mean")
    assert (metric.name, metric.text, metric.function(None)) == ("trimmed-mean", "trimmed-mean", 1.0)
    del sys.modules["own"]
    with check_error():
        OwnMetric.of("two")


def test_a_report_repeats_own_metrics_only_if_they_are_named_again(own, run):
    """The file may come from somebody else, and their code runs."""
    for name, seed in (("ref", 1), ("a", 2)):
        np.savetxt(f"{name}.xyz", shapes.terrain(200, seed=seed)[0])
    code, _, err = run("compare", "ref.xyz", "a.xyz", "--metric", "own.py:one", "--out", "r", "--no-figures", "-q")
    assert (code, err) == (0, "")
    settings = own.parent / "r/settings.json"
    assert json.loads(settings.read_text())["settings"]["metrics"] == [f"{own}:one"]
    assert read_settings(settings)[0].metrics == (f"{own}:one",)  # nothing is imported
    assert str(own) in [file["path"] for file in json.loads(settings.read_text())["files"]]
    for metrics in ((), ("own.py:two",), ("own.py:one", "own.py:two")):
        with check_error():
            Request.repeat(settings, metrics)
    repeated = run_request(Request.repeat(settings, ("own.py:one",))).comparison
    assert repeated["a"].metrics.own["one"].value == 1.0
    assert run("compare", "--settings", settings, "-q")[0] == 2
    assert run("compare", "ref.xyz", "a.xyz", "--metric", "own.py:one", "--tiles", "1000", "-q")[0] == 2
    assert run("compare", "ref.xyz", "a.xyz", "--metric", "own.py:one", "--json", "own.py", "-q")[0] == 2
    assert own.read_text() == SOURCE


def test_metrics_share_one_pair(clouds):
    pairs = []
    metrics = [OwnMetric(f"m{k}", "here", lambda pair: pairs.append(pair) or 1.0) for k in range(2)]
    compare(clouds[0], {"a": clouds[1]}, register="none", metrics=metrics)
    assert pairs[0] is pairs[1]
    assert len(measure_own(metrics, pairs[0]).by_name) == 2
