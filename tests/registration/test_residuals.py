"""Residuals of control and check points against closed forms."""

import csv
import json

import numpy as np
import pytest
from optional import import_or_skip
from registrations import motion
from wording import check_error, check_text

from pcbench import Cloud, compare, write_cloud
from pcbench.cli.clouds import register as register_command
from pcbench.registration import ControlPoints, SurveyResiduals, register
from pcbench.registration.control_points import fit_pairs
from pcbench.report.document import document

# Heights of a saddle on the corners of a square have no part along any translation, rotation or scale of them: the
# fit stays where it was, and the residuals are the offsets themselves. Check points may be off by anything.
CONTROL_SQUARE = np.array([[10.0, 10, 0], [-10, 10, 0], [-10, -10, 0], [10, -10, 0]])
SADDLE_OFFSETS = np.array([1.0, -1, 1, -1])[:, None] * [0, 0, 0.02]
CHECK_POINTS = np.array([[3.0, 1, 2], [-4, 5, 1]])
CHECK_OFFSETS = np.array([[0.03, 0.04, 0.12], [0.03, -0.04, 0.12]])  # H 0.05, Z 0.12, 3D 0.13
NAMES = ["a", "b", "c", "d", "p", "q"]
TRUE_POSE = motion(0.5, scale=1.5)


def survey_pairs(**changes):
    candidate = np.concatenate([CONTROL_SQUARE, CHECK_POINTS])
    reference = TRUE_POSE.apply(candidate) - np.concatenate([SADDLE_OFFSETS @ TRUE_POSE.rotation.T, CHECK_OFFSETS])
    return ControlPoints(candidate, reference, NAMES, [False] * 4 + [True] * 2, **changes)


def write_pairs(path, points, head=""):
    """Write a file of pairs; names of check points end in *."""
    lines = [
        f"{name}{'*' * bool(check)} {' '.join(map(repr, [*map(float, a), *map(float, b)]))}"
        for name, check, a, b in zip(points.names, points.is_check, points.candidate, points.reference, strict=True)
    ]
    path.write_text("\n".join([*([head] if head else []), *lines, ""]))


def test_residuals_are_the_known_offsets():
    T, residuals = fit_pairs(survey_pairs(z_is_up=True))
    # Rounding of coordinates below 100 m, a few times.
    np.testing.assert_allclose(T.matrix, TRUE_POSE.matrix, atol=1e-9)
    assert [point.name for point in residuals.control] == ["a", "b", "c", "d"]
    np.testing.assert_allclose(
        [point[1:] for point in residuals.control], SADDLE_OFFSETS @ TRUE_POSE.rotation.T, atol=1e-9
    )
    np.testing.assert_allclose([point[1:] for point in residuals.check], CHECK_OFFSETS, atol=1e-9)
    control, check = residuals.rmse(residuals.control), residuals.rmse(residuals.check)
    assert control.total == pytest.approx(0.02, abs=1e-9)
    assert check == pytest.approx((2, 0.13, 0.05, 0.12), abs=1e-9)


def test_horizontal_and_vertical_residuals_need_z_up():
    _, residuals = fit_pairs(survey_pairs())
    assert not residuals.z_is_up
    assert residuals.rmse(residuals.check).total == pytest.approx(0.13, abs=1e-9)
    assert residuals.rmse(residuals.check).horizontal is None
    assert residuals.rmse(residuals.check).vertical is None
    check_text("\n".join(residuals.rmse_lines()), masked=False)


def test_plain_values_round_trip():
    _, residuals = fit_pairs(survey_pairs(z_is_up=True))
    values = json.loads(json.dumps(residuals.plain()))
    assert SurveyResiduals.from_plain(values) == residuals
    assert values["point_rmse"]["check"]["vertical"] == pytest.approx(0.12, abs=1e-9)
    assert SurveyResiduals().plain()["point_rmse"] == {"control": None, "check": None}


@pytest.fixture
def files(tmp_path):
    """A reference, a candidate in another frame, and a file of control and check points."""
    rng = np.random.default_rng(5)
    points = rng.uniform(-10, 10, (3000, 3)) * [1, 1, 0.1]
    write_cloud(tmp_path / "reference.ply", Cloud(TRUE_POSE.apply(points), unit="m"))
    write_cloud(tmp_path / "candidate.ply", Cloud(points))
    write_pairs(tmp_path / "points.txt", survey_pairs(), "# Z is up")
    return tmp_path


def test_register_prints_every_point_and_the_rmse(files, capsys):
    clouds = [str(files / "reference.ply"), str(files / "candidate.ply")]
    register_command([*clouds, "--register", f"points:{files / 'points.txt'}"], standalone_mode=False)
    lines = [line.removeprefix("# ") for line in capsys.readouterr().out.splitlines()]
    (check,) = (line for line in lines if line.startswith("check point p"))
    assert check.endswith(": 0.13 m (dx +0.03, dy +0.04, dz +0.12)")
    (rmse,) = (line for line in lines if line.startswith("2 check points: "))
    assert rmse.endswith(" H 0.05 m, Z 0.12 m, 3D 0.13 m")
    check_text("\n".join(lines[:-4]))
    np.testing.assert_allclose(np.loadtxt(lines[-4:]), TRUE_POSE.matrix, atol=1e-9)


def test_compare_writes_residuals_to_json_table_and_csv(files):
    comparison = compare(files / "reference.ply", files / "candidate.ply", register=f"points:{files / 'points.txt'}")
    (values,) = document(comparison)["candidates"]
    registration = values["registration"]
    assert registration["z_is_up"] is True
    assert [row["name"] for row in registration["check_points"]] == ["p", "q"]
    assert registration["check_points"][0]["error"] == pytest.approx(0.13, abs=1e-9)
    assert registration["point_rmse"]["check"] == pytest.approx(
        {"points": 2, "total": 0.13, "horizontal": 0.05, "vertical": 0.12}, abs=1e-9
    )
    comparison.save(files / "report", figures=False)
    with (files / "report/metrics.csv").open() as file:
        rows = {(row["metric"], row["variant"]): row["value"] for row in csv.DictReader(file)}
    assert float(rows["check_points_rmse", "vertical"]) == pytest.approx(0.12, abs=1e-9)
    assert float(rows["control_points_rmse", "3d"]) == pytest.approx(0.02, abs=1e-9)
    assert " H 0.05 m, Z 0.12 m, 3D 0.13 m" in (files / "report/table.md").read_text()


def test_z_is_up_in_projected_coordinates():
    import_or_skip("pyproj")
    points = np.random.default_rng(5).uniform(-10, 10, (500, 3))
    for crs, z_is_up in (("EPSG:32617", True), ("EPSG:4978", False), (None, False)):
        reference = Cloud(TRUE_POSE.apply(points), crs=crs)
        assert register(reference, points, survey_pairs()).residuals.z_is_up is z_is_up


def test_other_methods_have_no_residuals():
    points = np.random.default_rng(5).uniform(-10, 10, (500, 3))
    assert not register(points, points, "none").residuals


@pytest.mark.parametrize(
    ("names", "is_check"),
    [
        (["a", "b", "c", "d", "p", "a"], [False] * 6),
        (NAMES, [False] * 2 + [True] * 4),
        (NAMES, [True] * 6),
    ],
)
def test_unsuitable_points_are_refused(names, is_check, tmp_path):
    points = survey_pairs()
    with check_error():
        ControlPoints(points.candidate, points.reference, names, is_check)


def test_a_control_and_a_check_point_of_one_name_are_refused(tmp_path):
    (tmp_path / "p.txt").write_text("a 0 0 0 0 0 0\nb 1 0 0 1 0 0\nc 0 1 0 0 1 0\na* 1 1 0 1 1 0\n")
    with check_error():
        ControlPoints.read(tmp_path / "p.txt")
