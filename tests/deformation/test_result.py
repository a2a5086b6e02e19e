"""The result as an object, as JSON and as a folder; the inputs of `deform`."""

import json

import numpy as np
import pytest
from bent_clouds import add_dome, add_noise, sample_city
from wording import check_error, check_text

from pcbench import Cloud, read_cloud, write_cloud
from pcbench.deformation import Deformation, deform
from pcbench.deformation.size import _root_mean_square
from pcbench.errors import Notice
from pcbench.geometry.region_text import parse_region
from pcbench.geometry.regions import Box
from pcbench.geometry.transform import Similarity
from pcbench.report import to_json

LEFT_HALF = Box(np.array([-300.0, -300.0, -50.0]), np.array([0.0, 300.0, 100.0]))


@pytest.fixture(scope="module")
def clouds():
    rng = np.random.default_rng(14)
    points = add_noise(sample_city(10_000, rng), rng), add_noise(add_dome(sample_city(5_000, rng), 0.3), rng)
    return tuple(Cloud(values, unit="m") for values in points)


@pytest.fixture(scope="module")
def bent_result(clouds):
    return deform(*clouds)[1]


def test_result_json_round_trip(bent_result):
    assert bent_result.verdict == "non-affine"
    result_with_warning = bent_result.with_warnings([Notice("few-tiles", "only 3 tiles")])
    for result in (
        bent_result,
        result_with_warning,
        Deformation.undecided_because(Notice("few-pairs", "12 pairs of points")),
    ):
        restored = Deformation.from_json(json.loads(to_json(result)))
        assert restored == result  # the field is not compared
        assert restored.field is None


def test_json_has_the_documented_keys_in_order(bent_result):
    values = json.loads(to_json(bent_result.with_warnings([Notice("few-tiles", "only 3 tiles")])))
    assert list(values) == [
        "verdict", "model", "parameters", "p_value", "rungs", "amplitude", "remaining_rms", "coincides", "noise",
        "tiles", "pairs", "surface_share", "growth", "observable", "local", "minimum_detectable_rms",
        "negligible_rms", "stated_rms", "detectable", "shape", "wave", "waves_from", "conditional_verdict",
        "warnings", "warning_codes",
    ]  # fmt: skip
    assert list(values["amplitude"]) == ["rms", "p95", "max", "ci", "rms_surface", "ci_surface"]
    assert list(values["rungs"][0]) == ["model", "parameters", "cv_score", "cv_se", "bic_eff", "rms_explained"]
    assert list(values["growth"]["with_height"]) == ["slope", "ci", "profile"]
    assert list(values["growth"]["with_height"]["profile"][0]) == ["at", "mean", "ci", "null"]
    assert values["warnings"] == ["only 3 tiles"]
    assert values["warning_codes"] == ["few-tiles"]


def test_older_reports_without_both_sizes_are_read(bent_result):
    values = json.loads(to_json(bent_result))
    del values["amplitude"]["rms_surface"], values["amplitude"]["ci_surface"], values["local"]["largest"]
    values["p_value_noise"], values["tiles"]["agreement"] = 0.5, 1.0
    restored = Deformation.from_json(values)
    assert restored.amplitude.rms == bent_result.amplitude.rms
    assert restored.amplitude.rms_surface is None
    check_text(restored.sentence())


def test_numbers_have_six_digits(bent_result):
    numbers = [
        bent_result.amplitude.rms,
        bent_result.noise.n_eff,
        bent_result.growth.with_distance.profile[0].mean,
        bent_result.rungs[4].cv_score,
    ]
    assert numbers == [float(f"{number:.6g}") for number in numbers]


def test_sentence_and_repr_of_a_result(bent_result):
    amplitude = bent_result.amplitude
    assert f"{amplitude.rms:.3g} [{amplitude.ci[0]:.3g}, {amplitude.ci[1]:.3g}] m RMS" in check_text(
        bent_result.sentence("a.ply", "m")
    )
    assert f"{amplitude.rms:.3g} RMS, p < 1e-9" in check_text(repr(bent_result))
    text = "only 12 pairs of points: too few to distinguish a deformation from noise"
    undecided = Deformation.undecided_because(Notice("few-pairs", text))
    check_text(undecided.sentence("a.ply"), masked=False)
    check_text(repr(undecided))


@pytest.mark.parametrize("seed", [-1, 1.5, "x", None, [1], True])
def test_a_seed_must_be_an_integer(seed):
    with check_error():
        deform(np.eye(3), np.eye(3), seed=seed)


def test_arrays_are_clouds_without_a_unit(clouds, bent_result):
    _, result = deform(clouds[0].points, clouds[1].points)
    assert result.verdict == "non-affine"
    assert result.amplitude == bent_result.amplitude  # the scale is part of the affine field


@pytest.mark.long
def test_a_given_pose_is_an_object_or_an_array(clouds):
    _, expected = deform(*clouds, "none")
    for pose in (Similarity.identity(), np.eye(4)):
        assert deform(*clouds, pose)[1] == expected


def test_a_region_is_an_object_or_its_text(clouds):
    box = ",".join(map(str, [*LEFT_HALF.lower, *LEFT_HALF.upper]))
    _, result = deform(*clouds, crop=LEFT_HALF)
    assert result.field.places[:, 0].max() < 5  # planes at closest points extend a little beyond
    by_text = parse_region(f"box:{box}", clouds[0])
    np.testing.assert_array_equal((by_text.lower, by_text.upper), (LEFT_HALF.lower, LEFT_HALF.upper))


def test_an_empty_region_is_refused(clouds):
    with check_error():
        deform(*clouds, crop=Box(LEFT_HALF.lower - 1000, LEFT_HALF.upper - 1000))


def test_deform_writes_a_folder(clouds, bent_result, tmp_path, capsys):
    from pcbench import cli

    write_cloud(tmp_path / "ref.ply", clouds[0])
    write_cloud(tmp_path / "cand.ply", clouds[1])
    arguments = ["deform", str(tmp_path / "ref.ply"), str(tmp_path / "cand.ply"), "--out", str(tmp_path / "bend")]
    cli.app([*arguments, "--no-figures"], standalone_mode=False)
    assert "cand.ply" in capsys.readouterr().out
    values = json.loads((tmp_path / "bend/deformation.json").read_text())
    assert Deformation.from_json(values) == bent_result
    assert {p.name for p in (tmp_path / "bend").iterdir()} == {
        "T.txt", "aligned.ply", "deformation.csv", "deformation.json", "deformation.ply", "manifest.json",
    }  # fmt: skip
    field = read_cloud(tmp_path / "bend/deformation.ply")
    table = read_cloud(tmp_path / "bend/deformation.csv")
    np.testing.assert_allclose(table.points, field.points, rtol=1e-12)
    np.testing.assert_array_equal(table.attributes["pairs"], bent_result.field.counts)
    assert "displacement_z" in table.attributes


def test_a_form_of_rounding_errors_has_no_size():
    """A surface that no affine field leaves gives a form of zeros, up to rounding, whose scatter may be negative."""
    covariance = np.array([[0.0010167, 0.00011566], [0.00011566, 0.0007632]])
    form = np.array([[-7.76460693e-19, 1.02029085e-18], [-8.38494706e-19, 2.36178781e-19]])
    value, (low, high) = _root_mean_square(np.array([0.07965301, -0.08159726]), covariance, form)
    assert low <= value <= high < 1e-6
