"""Sentences on deformation respect the warnings of the registration, and rounding is not reported as a size."""

import re

import numpy as np
import pytest
from wording import check_text

from pcbench import Cloud, Settings, compare, deform
from pcbench.registration.result import UNOBSERVABLE
from pcbench.report.table import markdown
from pcbench.scenes.synthetic import city

UTM = np.array([352300.0, 5123400.0, 300.0])


def corridor(bend, seed):
    """Return a floor and two walls of 60 m along x, which leave sliding free; the ends are bent upwards by `bend`."""
    rng = np.random.default_rng(seed)
    x, part, t = rng.uniform(-30, 30, 6_000), rng.integers(0, 3, 6_000), rng.uniform(-1, 1, 6_000)
    across, height = np.where(part == 0, 2 * t, np.where(part == 1, -2.0, 2.0)), np.where(part == 0, 0.0, 1.5 + 1.5 * t)
    points = np.stack([x, across, height], axis=1) + rng.normal(0, 0.01, (6_000, 3))
    return points + bend * np.outer(np.square(x / 30), [0, 0, 1])


def field(bend, seed):
    """Return flat ground of 40 m."""
    rng = np.random.default_rng(seed)
    xy = rng.uniform(-20, 20, (12_000, 2))
    return np.column_stack([xy, rng.normal(0, 0.01, len(xy)) + bend * np.square(xy / 20).sum(axis=1)])


@pytest.mark.parametrize("scene", [corridor, field])
def test_an_undetermined_pose_is_reported_before_the_verdict(scene):
    reference, straight, bent = scene(0.0, 1), scene(0.0, 2), scene(0.2, 3)
    registration, found = deform(reference, straight)
    assert registration.warnings[0].code == UNOBSERVABLE
    assert found.verdict == "none"
    check_text(found.sentence("a"))
    assert not found.further_warnings  # the sentence contains it
    _, found = deform(reference, bent)
    assert found.verdict == "undecided"
    assert "p =" not in check_text(found.sentence("a"))
    assert (found.amplitude, found.p_value, found.local, found.minimum_detectable_rms) == (None,) * 4
    # A given pose was not estimated, so its free directions do not matter.
    _, found = deform(reference, bent, "none")
    assert found.verdict == "non-affine"
    check_text(found.sentence("a"))


@pytest.fixture(scope="module")
def town():
    return city(3).sample(15_000, np.random.default_rng(1))[0]


def test_candidates_with_doubtful_poses_get_no_verdict(town):
    other = city(3).sample(15_000, np.random.default_rng(2))[0]
    clouds = {"right": other, "wrong": town[::2] + [11, 7, 0]}
    found = compare(town, clouds, Settings(register="none"))
    wrong = found["wrong"]
    assert wrong.registration.doubtful
    assert wrong.deformation.warnings[0].code == "doubtful-registration"
    assert (wrong.deformation.amplitude, wrong.deformation.p_value, wrong.deformation.growth) == (None, None, None)
    text = markdown(found)
    check_text(wrong.deformation.sentence("wrong"))
    assert wrong.deformation.sentence("wrong") in text
    assert "than wrong" not in text
    assert "told apart" not in text


@pytest.mark.parametrize("place", ["where it is", "survey", "feet"])
def test_a_cloud_against_itself_differs_by_nothing(town, place):
    cloud = {
        "where it is": Cloud(town),
        "survey": Cloud(town + UTM),
        "feet": Cloud((town + UTM) / 0.3048, unit="ft"),
    }[place]
    found = compare(cloud, cloud)
    itself = found["candidate_1"]
    assert itself.metrics.hausdorff.symmetric_max == 0
    assert itself.registration.rmse == 0
    assert not (*itself.warnings, *itself.registration.warnings, *itself.deformation.warnings)
    assert itself.deformation.remaining_rms == itself.deformation.noise.sigma_white == 0
    text = markdown(found)
    assert check_text(itself.deformation.sentence("candidate_1")) in text
    assert not re.search(r"e-1\d", text)


def test_a_registered_copy_differs_by_rounding(town):
    found = compare(town + UTM, town + UTM + [0.3, 0.1, 0.05])["candidate_1"]
    assert 0 < found.metrics.hausdorff.symmetric_max < 1e-8
    assert not (*found.warnings, *found.registration.warnings, *found.deformation.warnings)
    check_text(found.deformation.sentence())
    assert found.deformation.amplitude.rms == found.deformation.minimum_detectable_rms == 0
