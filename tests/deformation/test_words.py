"""Sentences on deformation respect the warnings of the registration, and rounding is not reported as a size."""

import json
import re

import numpy as np
import pytest
from bent_clouds import add_dome, add_noise, sample_city, verdict
from wording import check_text

from pcbench import Cloud, Settings, compare, deform
from pcbench.deformation import Deformation
from pcbench.deformation import verdict as models
from pcbench.registration import quality
from pcbench.registration.result import UNOBSERVABLE
from pcbench.report import to_json
from pcbench.report.answer import answer
from pcbench.report.table import markdown
from pcbench.scenes.synthetic import city

UTM = np.array([352300.0, 5123400.0, 300.0])


def corridor(bend, seed):
    """Return a floor and two walls of 60 m along x, which leave sliding free; the ends are bent upwards by `bend`."""
    rng = np.random.default_rng(seed)
    x, part, t = rng.uniform(-30, 30, 4_000), rng.integers(0, 3, 4_000), rng.uniform(-1, 1, 4_000)
    across, height = np.where(part == 0, 2 * t, np.where(part == 1, -2.0, 2.0)), np.where(part == 0, 0.0, 1.5 + 1.5 * t)
    points = np.stack([x, across, height], axis=1) + rng.normal(0, 0.01, (4_000, 3))
    return points + bend * np.outer(np.square(x / 30), [0, 0, 1])


def flat_ground(bend, seed):
    """Return flat ground of 40 m."""
    rng = np.random.default_rng(seed)
    xy = rng.uniform(-20, 20, (12_000, 2))
    return np.column_stack([xy, rng.normal(0, 0.01, len(xy)) + bend * np.square(xy / 20).sum(axis=1)])


@pytest.mark.parametrize("scene", [corridor, pytest.param(flat_ground, marks=pytest.mark.long)])
def test_an_undetermined_pose_is_reported_before_the_verdict(scene):
    reference, undeformed, deformed = scene(0.0, 1), scene(0.0, 2), scene(0.2, 3)
    registration, result = deform(reference, undeformed)
    assert registration.warnings[0].code == UNOBSERVABLE
    assert result.verdict == "none"
    check_text(result.sentence("a"))
    assert not result.further_warnings  # the sentence contains it
    _, result = deform(reference, deformed)
    assert result.verdict == "undecided"
    assert "p =" not in check_text(result.sentence("a"))
    assert (result.amplitude, result.p_value, result.local, result.minimum_detectable_rms) == (None,) * 4
    # A given pose was not estimated, so its free directions do not matter.
    _, result = deform(reference, deformed, "none")
    assert result.verdict == "non-affine"
    check_text(result.sentence("a"))


def test_a_dome_of_flat_ground_is_not_denied():
    """If the deformed cloud defines the planes, a stretch along its dome explains the same residuals."""
    reference = flat_ground(0.0, 1)[::2]
    assert deform(reference, flat_ground(0.0, 3), "none")[1].verdict == "none"
    _, result = deform(reference, flat_ground(0.2, 3), "none")
    assert result.verdict == "undecided"
    assert "stretch along surfaces" in check_text(result.sentence("a"))


@pytest.fixture(scope="module")
def town():
    return city(3).sample(9_000, np.random.default_rng(1))[0]


@pytest.mark.long
def test_wrong_poses_get_no_verdict():
    town, registered = (
        city(3).sample(count, np.random.default_rng(seed))[0] for seed, count in ((1, 15_000), (2, 8_000))
    )
    clouds = {"right": registered, "wrong": town[::2] + [11, 7, 0]}
    comparison = compare(town, clouds, Settings(register="none"))
    candidate = comparison["wrong"]
    assert candidate.registration.doubtful
    assert candidate.deformation.warnings[0].code == "doubtful-registration"
    result = candidate.deformation
    assert (result.label, result.amplitude, result.p_value, result.growth) == ("undecided", None, None, None)
    check_text(result.sentence("wrong"))
    assert result.sentence("wrong") in markdown(comparison)


def test_doubtful_poses_get_a_verdict_that_assumes_them(town, monkeypatch):
    monkeypatch.setattr(quality, "DOUBTFUL_CONTRAST", 10.0)
    monkeypatch.setattr(quality, "SURE_CONTRAST", 10.0)
    monkeypatch.setattr(quality, "returned_share", lambda *_, **__: 0.0)
    rng = np.random.default_rng(2)
    flat, bent = (city(3).sample(5_000, rng)[0] for _ in range(2))
    bent[:, 2] += 0.5 * np.square(bent[:, :2] / 200).sum(axis=1)
    comparison = compare(town, {"flat": flat, "bent": bent})
    text = markdown(comparison)
    for name, label in (("flat", "none"), ("bent", "non-affine")):
        result = comparison[name].deformation
        assert comparison[name].registration.doubtful
        assert (result.verdict, result.conditional_verdict, result.label) == ("undecided", label, f"{label} (?)")
        assert result.assuming_pose().verdict == label
        assert result.amplitude is not None
        assert result.label in text
        check_text(result.sentence(name))
        assert Deformation.from_json(json.loads(to_json(result))) == result
    check_text(" ".join(answer(comparison)))


def test_an_undecided_deformation_has_its_size(monkeypatch):
    """A larger suspicion must not read as a smaller one."""
    monkeypatch.setattr(models, "_MIN_PREDICTION_GAIN", np.inf)  # no deformation is certain enough
    for size in (0.1, 0.4):
        rng = np.random.default_rng(1)
        reference, candidate = (add_noise(sample_city(6_000, rng), rng) for _ in range(2))
        result = verdict(reference, add_dome(candidate, size), "none")
        assert result.verdict == "undecided"
        stated = re.search(r"suggest a deformation of ([0-9.]+) m RMS", check_text(result.sentence("a", "m")))
        assert 0.75 * size < float(stated[1]) < size  # along normals, most of which point upwards


@pytest.mark.parametrize("frame", ["local", "feet"])
def test_cloud_compared_with_itself_has_no_differences(town, frame):
    cloud = Cloud(town) if frame == "local" else Cloud((town + UTM) / 0.3048, unit="ft")
    comparison = compare(cloud, cloud)
    candidate = comparison["candidate_1"]
    assert candidate.metrics.hausdorff.symmetric_max == 0
    assert candidate.registration.rmse == 0
    assert not (*candidate.warnings, *candidate.registration.warnings, *candidate.deformation.warnings)
    assert candidate.deformation.remaining_rms == candidate.deformation.noise.sigma_white == 0
    text = markdown(comparison)
    assert check_text(candidate.deformation.sentence("candidate_1")) in text
    assert not re.search(r"e-1\d", text)


def test_a_registered_copy_differs_by_rounding(town):
    candidate = compare(town + UTM, town + UTM + [0.3, 0.1, 0.05])["candidate_1"]
    assert 0 < candidate.metrics.hausdorff.symmetric_max < 1e-8
    assert not (*candidate.warnings, *candidate.registration.warnings, *candidate.deformation.warnings)
    check_text(candidate.deformation.sentence())
    assert candidate.deformation.amplitude.rms == candidate.deformation.minimum_detectable_rms == 0


@pytest.mark.long
def test_two_clouds_from_photographs_share_errors():
    """The sentence states it for any verdict, and only if both clouds have attributes of photogrammetry."""
    rng = np.random.default_rng(8)
    points = [add_noise(sample_city(20_000, rng), rng) for _ in range(2)]
    views = {"views": np.full(20_000, 5)}
    tracks = {"track_length": np.full(20_000, 3)}
    for bend in (0.0, 0.2):
        candidate = add_dome(points[1], bend) if bend else points[1]
        _, both = deform(Cloud(points[0], attributes=views), Cloud(candidate, attributes=tracks), "none")
        _, one = deform(Cloud(points[0]), Cloud(candidate, attributes=tracks), "none")
        check_text(both.sentence("a", "m"))
        assert both.verdict == one.verdict == ("non-affine" if bend else "none")
        assert both.sentence("a", "m").startswith(one.sentence("a", "m"))
        assert "photographs" not in one.sentence("a", "m")
        assert both.further_warnings == one.further_warnings


@pytest.mark.parametrize(
    ("scene", "noise", "reason"), [("facade", 0.01, "vertical"), ("ground", 0.6, "noisy"), ("ground", 0.01, "")]
)
def test_a_missing_size_limit_has_a_reason(scene, noise, reason):
    """A façade shows no vertical displacements, and noise can hide them."""

    def sample(seed):
        xy = np.random.default_rng(seed).uniform(-20, 20, (4_000, 2))
        if scene == "facade":
            return np.column_stack([xy[:, 0], 0.01 * np.sin(xy[:, 0]), xy[:, 1]])
        return np.column_stack([xy, 0.3 * np.sin(xy).sum(axis=1)])

    candidate = sample(2) + np.random.default_rng(3).normal(0, noise, (4_000, 3))
    _, result = deform(sample(1), candidate, "none")
    assert result.verdict == ("undecided" if reason else "none")
    assert (result.size_limit is None) == bool(reason) == bool(result.limit_problem)
    assert reason in result.limit_problem
    assert result.limit_problem in check_text(result.sentence("a"))
