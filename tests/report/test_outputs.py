"""Each quantity of a candidate is in every output exactly once."""

import json
from dataclasses import replace
from statistics import NormalDist

import numpy as np
import pytest
import shapes
from wording import check_text

from pcbench import Cloud, Mesh, Settings, compare
from pcbench.deformation import size
from pcbench.geometry import mesh_samples
from pcbench.measure import directions, quantities, scores, summaries
from pcbench.measure.directions import MEAN_METRICS, MeanMetric
from pcbench.measure.intervals import Interval
from pcbench.measure.quantity import LENGTH, Quantity
from pcbench.measure.results import CANDIDATE_TO_REFERENCE, REFERENCE_TO_CANDIDATE
from pcbench.report import document, layout, markdown, rows, to_json
from pcbench.report.layout import Headline, Label, column_of
from pcbench.report.summary import main_columns, main_lines
from pcbench.report.table import lines

ALL_OPTIONS = {"presets": ("open3d", "pdal", "tnt"), "thresholds": (0.1, 0.3), "maps": ("m3c2",)}
SQUARE = Mesh(np.array([[0.0, 0, 0], [40, 0, 0], [40, 40, 0], [0, 40, 0]]), np.array([[0, 1, 2], [0, 2, 3]]))


def terrain(count, noise):
    points, rng = shapes.terrain(count, seed=count)[0], np.random.default_rng(count)
    return points + rng.normal(0, noise, points.shape)


def make_comparison(kind):
    """Compare with presets, two thresholds and M3C2; the same with a mesh and its map; and clouds of two points."""
    if kind == "mesh":
        return compare(SQUARE, {"a": terrain(300, 0.05)}, Settings(register="none", **ALL_OPTIONS))
    if kind == "points":
        return compare(np.zeros((1, 3)), np.ones((1, 3)), Settings(register="none", presets=("open3d", "tnt")))
    clouds = {"a": terrain(500, 0.05), "b": terrain(400, 0.1)}
    return compare(Cloud(terrain(900, 0), unit="m"), clouds, Settings(register="none", **ALL_OPTIONS))


@pytest.fixture(scope="module", params=["clouds", "mesh", "points"])
def comparison(request):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(mesh_samples, "REFERENCE_SAMPLES", 3000)
        return make_comparison(request.param)


@pytest.fixture(scope="module")
def clouds():
    return make_comparison("clouds")


def value_at(values, path):
    for key in path:
        values = values[key]
    return values


def test_metrics_csv_is_tidy(comparison):
    table_rows = list(rows(comparison))
    assert len({(r.candidate, r.metric, r.variant, r.threshold, r.direction) for r in table_rows}) == len(table_rows)
    thresholds = {score.threshold for score in comparison.candidates[0].metrics.fscores}
    for metric in ("fscore", "precision", "recall"):
        assert {r.threshold for r in table_rows if (r.metric, r.variant) == (metric, "")} == thresholds
    presets = {name for name in comparison.settings.presets if thresholds or name != "tnt"}
    assert {r.variant for r in table_rows} >= {"", "sum_squared", *presets}


def test_every_quantity_is_in_the_json_at_its_path(comparison):
    values = json.loads(to_json(document(comparison)))
    for candidate, json_candidate in zip(comparison, values["candidates"], strict=True):
        expected = [q for q in quantities.quantities(candidate) if q.path]
        assert len({q.path for q in expected}) == len(expected) > 50
        for quantity in expected:
            *parents, key = quantity.path
            assert value_at(json_candidate, quantity.path) == quantity.value
            if quantity.has_interval:
                interval = quantity.interval and list(quantity.interval)
                assert value_at(json_candidate, [*parents, "ci", key]) == interval
            if quantity.threshold is not None:
                assert value_at(json_candidate, [*parents, "threshold"]) == quantity.threshold


def test_every_difference_belongs_to_a_quantity(clouds):
    names = {q.difference for q in quantities.quantities(clouds["a"])} - {""}
    assert {difference.metric for difference in clouds.differences} == names


def maximum_quantities(candidate):
    """Return a maximum in both directions."""
    for direction, values in (
        (CANDIDATE_TO_REFERENCE, candidate.deviation),
        (REFERENCE_TO_CANDIDATE, candidate.completeness),
    ):
        yield Quantity("farthest", direction, "largest", float(values.scalars["distance"].max()), LENGTH)


def angle_quantities(candidate):
    """Return a quantity of normals, with an interval, in degrees."""
    value = 1.0 + len(candidate.name)
    interval = Interval(value - 0.5, value + 0.5)
    yield Quantity("normals", CANDIDATE_TO_REFERENCE, "angle", value, "deg", interval=interval, has_interval=True)


def color_quantities(candidate):
    """Return a quantity of colours, without a direction and in two variants."""
    for variant, value in (("rgb", 31.5), ("luma", 34.25)):
        yield Quantity("color_psnr", "both", "PSNR", value, "dB", variant)


@pytest.mark.parametrize("make_quantities", [maximum_quantities, angle_quantities, color_quantities])
def test_a_new_quantity_is_in_every_output(clouds, monkeypatch, make_quantities):
    def part(candidate):
        for quantity in make_quantities(candidate):
            yield replace(quantity, path=("metrics", quantity.metric, quantity.variant or quantity.direction))

    for quantity in part(clouds["a"]):
        key = f"{quantity.metric}/{quantity.variant}" if quantity.variant else quantity.metric
        monkeypatch.setitem(layout.LABELS, key, Label(key))
    headline = Headline("{0.metric} {0.variant}", column=quantity.metric, ranks=(0, 0))
    monkeypatch.setitem(layout.HEADLINES, quantity.metric, headline)
    monkeypatch.setattr(quantities, "_PARTS", (*quantities._PARTS, part))
    json_candidates = json.loads(to_json(document(clouds)))["candidates"]
    table, summary = list(filter(None, lines(clouds))), main_lines(clouds)
    columns = main_columns(clouds, 300)
    for k, candidate in enumerate(clouds):
        for quantity in part(candidate):
            text = f"{quantity.value:.4g}"
            assert value_at(json_candidates[k], quantity.path) == quantity.value
            (row,) = [
                r
                for r in rows(clouds)
                if (r.candidate, r.metric, r.variant) == (candidate.name, quantity.metric, quantity.variant)
                and r.direction == quantity.direction
            ]
            assert (row.value, row.unit) == (quantity.value, "m" if quantity.unit == LENGTH else quantity.unit)
            assert (row.ci_low, row.ci_high) == (quantity.interval or (None, None))
            label = layout.label_of(quantity).text
            (line,) = [line for line in table if line.label == label]
            assert line.cells[k][column_of(quantity)].text == text
            (line,) = [line for line in summary if line.label == f"{quantity.metric} {quantity.variant}"]
            assert line.cells[k][column_of(quantity)].text == text
            assert any(
                c.head[0] == quantity.metric and float(c.cells[k]) == pytest.approx(quantity.value, rel=5e-3)
                for c in columns  # which have three digits
            )
            assert f"| {label} |" in markdown(clouds)


def test_a_new_mean_is_in_every_output(monkeypatch):
    """Its floor, interval and differences are there too."""
    capped = MeanMetric("capped", "at most 0.5", LENGTH, lambda d: np.minimum(d.to_points, 0.5))
    monkeypatch.setitem(layout.LABELS, "capped", Label("Capped"))
    monkeypatch.setitem(layout.HEADLINES, "capped", Headline("capped mean"))
    for module in (directions, scores, summaries, quantities):
        monkeypatch.setattr(module, "MEAN_METRICS", (*MEAN_METRICS, capped))
    comparison = make_comparison("clouds")
    values = document(comparison)["candidates"][0]["metrics"]["capped"]
    assert values[CANDIDATE_TO_REFERENCE] == pytest.approx(
        np.minimum(comparison["a"].deviation.scalars["distance"], 0.5).mean()
    )
    assert (
        values["ci"][CANDIDATE_TO_REFERENCE][0]
        < values[CANDIDATE_TO_REFERENCE]
        < values["ci"][CANDIDATE_TO_REFERENCE][1]
    )
    assert values["floor"][REFERENCE_TO_CANDIDATE] > 0
    assert {(r.metric, r.direction) for r in rows(comparison) if r.metric == "capped"} == {
        ("capped", direction) for direction in (CANDIDATE_TO_REFERENCE, REFERENCE_TO_CANDIDATE)
    }
    assert "Capped" in [line.label for line in lines(comparison) if line]
    assert "capped mean" in [line.label for line in main_lines(comparison)]
    assert {d.metric for d in comparison.differences} >= {
        f"capped/{CANDIDATE_TO_REFERENCE}",
        f"capped/{REFERENCE_TO_CANDIDATE}",
    }


def test_the_definition_of_detectable_matches_the_computation(clouds, monkeypatch):
    # The normal deviate has three decimals, which gives the power within 1e-4.
    assert NormalDist().cdf(size._POWER_Z) == pytest.approx(size.DETECTION_POWER, abs=1e-4)

    def definition():
        return next(r.definition for r in rows(clouds) if r.metric == "minimum_detectable_rms")

    check_text(definition(), masked=False)
    assert f"{100 * size.DETECTION_POWER:g} %" in definition() and f"p <= {size.MAX_P_SIGNIFICANT:g}" in definition()
    monkeypatch.setattr(quantities, "DETECTION_POWER", 0.625)
    monkeypatch.setattr(quantities, "MAX_P_SIGNIFICANT", 0.25)
    assert "62.5 %" in definition() and "p <= 0.25" in definition()
