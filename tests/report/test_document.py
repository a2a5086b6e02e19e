"""Contents of comparison.json beside the metrics, and dependence of its numbers on the seed."""

import re

import numpy as np
import pytest
import shapes
from repository import ROOT

from pcbench import compare
from pcbench.geometry.voxels import robust_extent
from pcbench.measure import intervals
from pcbench.measure.quantities import quantities
from pcbench.report import document
from pcbench.report.words import rounding_limit


@pytest.fixture(scope="module")
def clouds():
    rng, candidate = np.random.default_rng(0), shapes.terrain(500, seed=2)[0]
    return shapes.terrain(900, seed=1)[0], candidate + rng.normal(0, 0.05, candidate.shape)


def leaves(value, path=()):
    """Return each value of nested JSON by its path."""
    if not isinstance(value, dict | list):
        return {path: value}
    items = value.items() if isinstance(value, dict) else enumerate(value)
    return {key: leaf for name, item in items for key, leaf in leaves(item, (*path, name)).items()}


def test_the_contrast_of_a_registration_is_in_the_document(clouds):
    comparison = compare(*clouds, register="none")
    (candidate,) = document(comparison)["candidates"]
    assert candidate["registration"]["contrast"] == comparison["candidate_1"].registration.contrast
    assert candidate["registration"]["contrast"] > 0
    corners = np.eye(3)
    assert document(compare(corners, corners, register="none"))["candidates"][0]["registration"]["contrast"] is None


def test_a_root_has_the_floor_and_the_interval_of_its_mean_square(clouds):
    comparison = compare(*clouds, register="none")
    (values,) = document(comparison)["candidates"]
    metrics = comparison["candidate_1"].metrics
    for square, root, typed in (("d1_mse", "d1_rms", metrics.d1_rms), ("d2_mse", "d2_rms", metrics.d2_rms)):
        squares, roots = values["metrics"][square], values["metrics"][root]
        for way, estimate in (
            ("candidate_to_reference", typed.accuracy),
            ("reference_to_candidate", typed.completeness),
            ("symmetric_max", typed.symmetric_max),
        ):
            assert roots[way] == np.sqrt(squares[way]) == estimate.value
            np.testing.assert_array_equal(roots["ci"][way], np.sqrt(squares["ci"][way]))
            assert estimate.interval == tuple(roots["ci"][way])
            assert estimate.interval.low <= estimate.value <= estimate.interval.high
            if way != "symmetric_max":
                assert roots["floor"][way] == np.sqrt(squares["floor"][way]) == estimate.floor
        assert typed.accuracy.area_weighted == np.sqrt(squares["area_weighted"]["candidate_to_reference"])


@pytest.mark.with_deformation
def test_each_printed_value_with_its_interval_is_in_the_document(clouds):
    comparison = compare(*clouds, register="none", maps=("m3c2",), presets=("tnt",))
    (values,) = document(comparison)["candidates"]
    with_interval = set()
    for quantity in quantities(comparison["candidate_1"]):
        if quantity.interval is not None:
            with_interval.add(quantity.metric)
        if not quantity.path:  # a larger object has it
            continue
        *path, last = quantity.path
        node = values
        for key in path:
            node = node[key]
        assert node[last] == quantity.value
        if quantity.interval is not None:
            assert node["ci"][last] == list(quantity.interval)
    means = {"d1_mse", "d1_rms", "d2_mse", "d2_rms", "mean_distance", "chamfer", "fscore", "precision", "recall"}
    assert with_interval == means | {"offset", "deformation_rms"}
    assert values["offset"]["interval"] == list(comparison["candidate_1"].offset.interval)
    assert values["deformation"]["amplitude"]["ci"] == list(comparison["candidate_1"].deformation.amplitude.ci)


def test_each_key_is_explained_on_its_page(clouds):
    """Settings, presets, percentiles and steps have separate pages or explain themselves."""

    def keys(node):
        if isinstance(node, dict):
            for key, value in node.items():
                yield key
                if key not in ("settings", "presets", "percentiles", "timings_s"):
                    yield from keys(value)
        elif isinstance(node, list):
            for value in node[:1]:
                yield from keys(value)

    page = (ROOT / "docs/comparison-json.md").read_text()
    explained = set(re.findall(r"\w+", " ".join(re.findall(r"`([^`]+)`", page))))
    values = document(compare(*clouds, maps=("m3c2",), presets=("tnt",), thresholds=(0.5,)))
    assert set(keys(values)) - {"schema"} <= explained


def test_the_extent_does_not_depend_on_the_cell_size(clouds, monkeypatch):
    reference = clouds[0]
    comparison = compare(reference, clouds[1], register="none")
    assert document(comparison)["reference"]["extent"] == comparison.reference.extent
    # The bounds are computed from coordinates relative to an origin.
    assert comparison.reference.extent == pytest.approx(robust_extent(reference), rel=1e-12)
    monkeypatch.setattr(intervals, "_CELLS_ALONG_DIAGONAL", 14)
    coarse_comparison = compare(reference, clouds[1], register="none")
    assert coarse_comparison.reference.block_side == pytest.approx(2 * comparison.reference.block_side)
    assert rounding_limit(coarse_comparison) == rounding_limit(comparison) == 1e-9 * comparison.reference.extent


@pytest.mark.with_deformation
def test_the_seed_changes_only_sampling_floors_and_cross_validation():
    """As the help of --seed says; a mesh as the reference is sampled by it too."""
    reference, candidate = (shapes.city(count, noise=0.02, seed=count)[0] for count in (6000, 700))
    documents = [leaves(document(compare(reference, candidate, seed=seed))["candidates"][0]) for seed in (0, 1)]
    first, second = ({p: v for p, v in d.items() if p[0] not in ("timings_s", "peak_rss_bytes")} for d in documents)
    changed_paths = {path for path in first if first[path] != second[path]}
    floors = {path for path in changed_paths if path[0] == "metrics"}
    assert floors
    assert all(path[-1] == "reference_to_candidate" and path[1][:3] == "d2_" and "floor" in path for path in floors)
    # In the budget, the floor limits the noise, and which fields are visible above it.
    noise = {path for path in changed_paths if path[0] == "budget"}
    assert all(path[1] == "reference_to_candidate" for path in noise)
    rest = changed_paths - floors - noise
    assert rest
    assert all(path[:2] == ("deformation", "rungs") and path[-1][:3] == "cv_" for path in rest)
