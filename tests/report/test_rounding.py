"""Coordinates in coarse steps: warned about, named in the answer, in comparison.json, and the same in tiles."""

from functools import partial

import numpy as np
import pytest
from tiled_pairs import compare_on_disk
from wording import check_text

import pcbench
from pcbench import Cloud, Settings
from pcbench.measure.tiled.settings import TilingSettings
from pcbench.registration.rounding import COARSE_STEP, step_warnings
from pcbench.report.answer import answer
from pcbench.report.document import document
from pcbench.report.notes import warnings

FAR = np.array([5e5, 5.6e6, 100])


def hills(seed):
    """Return 4,000 points of hills on 50 x 50."""
    xy = np.random.default_rng(seed).uniform(0, 50, (4_000, 2))
    return np.column_stack([xy, 8 * np.sin(xy[:, 0] / 8) * np.cos(xy[:, 1] / 9)]) + FAR


def single(points):
    return points.astype(np.float32).astype(np.float64)


compare = partial(pcbench.compare, register="none")


def has_warning(comparison):
    return any(notice.code == COARSE_STEP for notice in comparison.candidates[0].registration.warnings)


@pytest.mark.long
@pytest.mark.with_deformation
def test_rounding_is_named_as_what_explains_the_distances():
    comparison = compare(single(hills(0)), {"a": single(hills(1))})
    d2 = comparison["a"].metrics.d2_mse
    for estimate in (d2.accuracy, d2.completeness):
        assert estimate.value > 20 * compare(hills(0), hills(1)).candidates[0].metrics.d2_mse.accuracy.floor
        assert estimate.value == pytest.approx(estimate.floor, rel=0.3)
    assert comparison.reference.steps[1] == comparison["a"].steps[1] == 0.5
    values = document(comparison)
    assert values["reference"]["steps"][:2] == values["candidates"][0]["steps"][:2] == [2**-5, 0.5]
    check_text("\n".join([*answer(comparison), *warnings(comparison)]))


@pytest.mark.parametrize(
    ("reference", "candidate", "is_coarse"),
    [
        (hills(0), hills(1), False),
        (np.round(hills(0), 3), np.round(hills(1), 3), False),
        (hills(0), single(hills(1)), True),
        (single(hills(0)), hills(1), True),
        (single(hills(0) - FAR), single(hills(1) - FAR), False),
    ],
    ids=["float64", "millimetres", "candidate", "reference", "float32 at the origin"],
)
def test_only_coarse_steps_are_a_warning(reference, candidate, is_coarse):
    noise = np.random.default_rng(2).normal(0, 0.03, (4_000, 1)) * [0, 0, 1]
    comparison = compare(reference, candidate + noise if not is_coarse else candidate)
    assert has_warning(comparison) == is_coarse


@pytest.mark.parametrize(
    ("step", "noise", "spacing", "is_coarse"),
    [
        (0.001, 0.0018, 0.2, False),  # error-free points on a curved surface: the noise is the surface between them
        (0.001, 0.007, 0.2, False),
        (0.01, 0.027, 0.2, True),
        (0.01, 0.027, 1.0, True),
        (0.01, 0.09, 0.2, False),
        (0.001, 0.0004, 0.2, True),  # the noise is rounding
        (0.001, 0.05, 0.005, True),
    ],
)
def test_steps_are_a_warning_where_they_matter_for_the_numbers(step, noise, spacing, is_coarse):
    cloud = Cloud(np.round(hills(0) / step) * step)
    found = step_warnings(cloud, cloud, scale=1.0, spacing=spacing, noise=noise, extent=70.0, unit=None)
    assert any(found) == is_coarse


@pytest.mark.long
def test_tiles_have_the_steps_floors_and_warnings_of_the_memory(tmp_path):
    clouds = [single(hills(0)), np.round(hills(1), 1)]
    for name, cloud in zip("ra", clouds, strict=True):
        pcbench.write_cloud(tmp_path / f"{name}.npy", cloud)
    settings = Settings(register="none")
    tiled = compare_on_disk(
        tmp_path / "r.npy",
        {"a": tmp_path / "a.npy"},
        settings,
        TilingSettings(tile_points=1_500, workers=1),
        workspace=tmp_path,
    )
    memory = pcbench.compare(*clouds, settings).candidates[0]
    assert has_warning(tiled)
    assert tiled["a"].registration.warnings == memory.registration.warnings
    for name, metric in tiled["a"].metrics.directed.items():
        expected = memory.metrics.directed[name]
        assert (metric.accuracy.floor, metric.completeness.floor) == (
            expected.accuracy.floor,
            expected.completeness.floor,
        )
    values = document(tiled)
    assert values["candidates"][0]["steps"] == pytest.approx([0.1] * 3)
