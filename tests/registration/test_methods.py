"""Methods as texts and as objects, the reference's target, and messages of all methods."""

from dataclasses import replace

import numpy as np
import pytest
import shapes
from registrations import codes, motion
from wording import check_error, check_text

from pcbench import Cloud, Similarity
from pcbench.errors import Notice, RegistrationError
from pcbench.geometry.neighbors import Index
from pcbench.geometry.normals import Surface
from pcbench.geometry.transform import format_matrix
from pcbench.registration import (
    ControlPoints,
    FeatureSettings,
    GivenPose,
    IcpSettings,
    Target,
    as_method,
    local_origin,
    parse_method,
    register,
)
from pcbench.registration.result import NO_CONVERGENCE, UNIT_MISMATCH, UNOBSERVABLE
from pcbench.scenes.synthetic import city


def test_invalid_methods_and_distant_clouds_are_refused(scene):
    reference, candidate = scene
    with check_error():
        register(reference, candidate, "magic")
    with check_error():
        register(reference, candidate, "matrix:no-such")
    for method in ("icp", "none"):
        with check_error(RegistrationError):
            register(reference, candidate + 5000, method)
    with check_error(RegistrationError):
        register(np.zeros((100, 3)), candidate)


def test_a_suspected_unit_is_a_warning(scene):
    reference, candidate = scene
    in_feet = register(reference, candidate / 0.3048, "none")
    assert UNIT_MISMATCH in codes(in_feet)
    check_text(*(notice.text for notice in in_feet.warnings if notice.code == UNIT_MISMATCH))
    assert not register(reference, candidate, "none").warnings


def test_tiny_clouds_are_registered():
    grid = shapes.plane_grid(4)
    result = register(Cloud(grid), Cloud(grid[:5]), "none")
    assert result.rmse == 0.0
    assert result.overlap == 1.0


@pytest.mark.parametrize(
    ("text", "method", "solves_scale"),
    [
        ("icp", IcpSettings(), False),
        ("icp-point", IcpSettings(residuals="point"), False),
        ("similarity", IcpSettings(with_scale=True), True),
        ("global", FeatureSettings(), False),
        ("global-similarity", FeatureSettings(with_scale=True), True),
    ],
)
def test_texts_and_objects_are_equal_methods(text, method, solves_scale):
    assert parse_method(text) == as_method(text) == as_method(method) == method
    assert method.text == text
    assert method.with_scale == solves_scale


def test_the_text_shows_changed_settings():
    assert IcpSettings(max_iterations=5).text == "icp (max_iterations=5)"
    assert IcpSettings(with_scale=True, max_correspondence_distance=2.0).text == (
        "similarity (max_correspondence_distance=2.0)"
    )


def test_files_are_read_when_the_text_is_parsed(tmp_path):
    (tmp_path / "T.txt").write_text(format_matrix(motion()))
    method = parse_method(f"matrix:{tmp_path / 'T.txt'}")
    assert isinstance(method, GivenPose)
    assert method.text == f"matrix:{tmp_path / 'T.txt'}"
    assert parse_method("none").text == "none"
    for text in ("matrix", "matrix:", "points", "points:", "icp:", "none:x", "ICP", ""):
        with check_error():
            parse_method(text)


@pytest.mark.parametrize("method", [None, 3, {"method": "icp"}, object()])
def test_invalid_methods_are_refused(method):
    with check_error():
        register(np.eye(3), np.eye(3), method)


def test_only_icp_takes_an_initial_pose():
    for method in ("none", "global", Similarity.identity(), ControlPoints(np.eye(3), np.eye(3))):
        with check_error():
            register(np.eye(3), np.eye(3), method, initial=np.eye(4))


def test_a_target_of_another_reference_is_refused(scene):
    reference, candidate = (Cloud(points) for points in scene)
    without_target = register(reference, candidate)
    with_target = register(reference, candidate, target=Target.of(reference))
    np.testing.assert_array_equal(with_target.T_local.matrix, without_target.T_local.matrix)
    points, origin = reference.points, local_origin(reference)
    moved = points.copy()
    moved[-1, 2] += 1e-6
    for target_points in (
        points[1:] - origin,
        points,
        points - origin - [1, 0, 0],
        moved - origin,
    ):
        with check_error():
            register(reference, candidate, target=Target(Surface(Index(target_points))))
    with check_error():
        register(Cloud(moved), candidate, target=Target.of(reference))


def test_warnings_of_a_wrong_pose_make_it_doubtful(scene):
    reference, candidate = scene
    assert not register(reference, candidate, "none").doubtful
    assert register(reference, candidate / 0.3048, "none").doubtful
    flattened = register(reference[:, :2] @ [[1.0, 0, 0], [0, 1, 0]], candidate[:, :2] @ [[1.0, 0, 0], [0, 1, 0]])
    assert codes(flattened) == {UNOBSERVABLE}  # the pose is right where it is known
    assert not flattened.doubtful
    unobservable, not_converged = Notice(UNOBSERVABLE, ""), Notice(NO_CONVERGENCE, "")
    assert not replace(flattened, warnings=(unobservable, not_converged)).doubtful
    assert replace(flattened, warnings=(not_converged,)).doubtful


def test_the_representation_is_one_line(scene):
    reference, candidate = scene
    representation = repr(register(reference, motion().inverse().apply(candidate), "similarity"))
    assert "\n" not in check_text(representation)
    check_text(repr(register(reference, candidate / 0.3048, "none")))


def check_failure(reference, candidate, method="icp"):
    with check_error(RegistrationError):
        register(reference, candidate, method)


def test_failures_report_stated_differences_first(scene):
    reference, candidate = (cloud[:6000] for cloud in scene)
    check_failure(Cloud(reference, unit="m"), Cloud(1000 * candidate + 1e6, unit="mm"))
    check_failure(
        Cloud(reference, unit="m", crs="LOCAL_A"), Cloud(candidate + 5000, unit="metre", crs="LOCAL_B"), "none"
    )
    check_failure(Cloud(reference, unit="m", crs="A"), Cloud(candidate + 5000, unit="ft", crs="B"), "none")
    check_failure(Cloud(reference, unit="m", crs="A"), Cloud(candidate + 5000, unit="Metre", crs="A"))


@pytest.mark.parametrize(
    ("factor", "message"),
    [
        (1000, "the candidate is about 1000 times as large as the reference: is it in millimetres"),
        (0.001, "the reference is about 1000 times as large as the candidate: is it in millimetres"),
        (100, "the candidate is about 100 times as large as the reference: is it in centimetres"),
        (0.3048, "the reference is about 3.281 times as large as the candidate: is it in feet"),
        (1 / 0.0254, "the candidate is about 39.37 times as large as the reference: is it in inches"),
        (304.8, "the candidate is about 304.8 times as large as the reference: is it in millimetres"),
    ],
)
def test_a_unit_is_suspected_from_sizes_if_none_is_stated(scene, factor, message):
    reference, candidate = (cloud[:6000] for cloud in scene)
    with check_error(RegistrationError) as caught:
        register(reference, factor * candidate + 1e6, "none")
    assert message in str(caught.value)
    check_failure(reference, 2 * candidate + 1e5, "none")


def test_a_failed_overlap_recommends_other_methods(scene):
    reference, candidate = (cloud[:6000] for cloud in scene)
    for method in ("icp", "none"):
        check_failure(reference, candidate + 5000, method)


def test_different_stated_units_are_a_warning(scene):
    reference, candidate = scene
    registration = register(Cloud(reference, unit="m"), Cloud(candidate, unit="ft"), "none")
    check_text(*(notice.text for notice in registration.warnings if notice.code == UNIT_MISMATCH))
    assert UNIT_MISMATCH in codes(registration)
    pose = Similarity(np.eye(3), np.zeros(3), 0.3048)
    in_feet = register(Cloud(reference, unit="m"), Cloud(candidate / 0.3048, unit="ft"), pose)
    assert UNIT_MISMATCH not in codes(in_feet)
    unknown = register(Cloud(reference, unit="m"), Cloud(candidate, unit="furlong"), "none")
    assert UNIT_MISMATCH in codes(unknown)


@pytest.mark.long
def test_lengths_of_a_mesh_reference_come_from_the_candidate():
    """Five spacings of a dense sampling are less than the noise: points are on the mesh although they are farther."""
    town, rng = city(3), np.random.default_rng(5)
    samples, rough = (town.sample(count, rng)[0] for count in (1_500_000, 100_000))
    samples, rough = (points[np.abs(points[:, :2]).max(axis=1) < 100] for points in (samples, rough))
    rough += 1.2 * rng.standard_t(2, rough.shape)  # heavy tails, as of photogrammetry
    surface = Surface(Index(samples - local_origin(Cloud(samples))))
    as_cloud, as_mesh = (register(samples, rough, "none", target=Target(surface, is_sampled=s)) for s in (False, True))
    assert as_cloud.overlap_distance == pytest.approx(5 * surface.spacing)
    assert as_cloud.overlap < 0.6 < 0.9 < as_mesh.overlap
    assert not as_mesh.doubtful
    assert register(samples, rough + [2.0, 0, 0], "none", target=Target(surface, is_sampled=True)).doubtful


def test_lengths_from_a_candidate_follow_its_scale(scene):
    reference, candidate = scene
    target = Target(Surface(Index(reference - local_origin(Cloud(reference)))), is_sampled=True)
    points = candidate - local_origin(Cloud(reference))
    spacing = target.for_candidate(points).spacing
    assert spacing > target.spacing
    assert target.for_candidate(1000 * points, scale=1e-3).spacing == pytest.approx(spacing, rel=1e-9)
    assert target.for_candidate(points[:2]) is target


@pytest.mark.parametrize("value", [-3.4028234663852886e38, 1e30])
def test_values_of_missing_data_are_named_as_the_cause_of_a_failure(value):
    clouds = [np.random.default_rng(seed).uniform(0, 100, (3_000, 3)) * [1, 1, 0.02] + 5e5 for seed in range(2)]
    filled = clouds[1].copy()
    filled[::50, 2] = value
    for reference, candidate in ((clouds[0], filled), (filled, clouds[0])):
        with check_error(RegistrationError) as caught:
            register(reference, candidate)
        assert "60 of 3,000 points): remove them with pcbench convert FILE OUT --drop-nodata" in str(caught.value)
        assert register(reference, candidate, "none").overlap > 0.4  # the others keep their places
