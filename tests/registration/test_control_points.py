"""Control and check points: from files and from arrays."""

import numpy as np
import pytest
from registrations import motion
from wording import check_error

from pcbench.registration import (
    ControlPoints,
    register,
)
from pcbench.registration.control_points import fit_pairs


def test_control_and_check_points_from_a_file_and_from_arrays_agree(scene, tmp_path):
    reference, candidate = scene
    true_pose = motion(1.0, scale=1.5)
    targets = candidate[[10, 500, 4000, 9000, 15000]]
    sources = true_pose.inverse().apply(targets)
    sources[4] += [0.1, 0, 0]  # a check point that is off by 0.1 of the candidate's unit
    names = ["a", "b", "c", "d", "check*"]
    numbers = np.hstack([sources, targets]).tolist()
    rows = [" ".join([name, *map(repr, row)]) for name, row in zip(names, numbers, strict=True)]
    (tmp_path / "pairs.txt").write_text("# name, candidate, reference\n" + "\n".join(rows))
    result = register(reference, true_pose.inverse().apply(candidate), f"points:{tmp_path / 'pairs.txt'}")
    np.testing.assert_allclose(result.T_reference_candidate.matrix, true_pose.matrix, atol=1e-9)
    assert result.check_points[0].name == "check"
    assert result.check_points[0].error == pytest.approx(0.15, rel=1e-6)
    assert result.solved_scale
    assert result.method == f"points:{tmp_path / 'pairs.txt'}"
    points = ControlPoints(sources, targets, names=["a", "b", "c", "d", "check"], is_check=[False] * 4 + [True])
    by_object = register(reference, true_pose.inverse().apply(candidate), points)
    np.testing.assert_array_equal(by_object.T_reference_candidate.matrix, result.T_reference_candidate.matrix)
    assert by_object.check_points == result.check_points
    assert by_object.method == "points"


PAIRS = [[0, 0.5, 0, 10, 0.25, 0], [1, 0, 0, 11, 0, 0], [0, 1.5, 0, 10, 1.5, 0], [0, 0, 2, 10, 0, 2]]
NUMBERS = ["\t".join(map(str, row)) for row in PAIRS]


@pytest.mark.parametrize(
    "lines",
    [
        [f"{name}\t{row}" for name, row in zip("abcd", NUMBERS, strict=True)],
        [f"{name};{row.replace('.', ',')};".replace("\t", ";") for name, row in zip("abcd", NUMBERS, strict=True)],
        [f"{name} {row.replace('.', ',')}".replace("\t", " ") for name, row in zip("abcd", NUMBERS, strict=True)],
        [f"{name},{row},".replace("\t", ",") for name, row in zip("abcd", NUMBERS, strict=True)],
    ],
    ids=["tabs", "decimal commas and trailing semicolons", "decimal commas between blanks", "trailing commas"],
)
@pytest.mark.parametrize("header", [[], ["id;x;y;z;x2;y2;z2;", ";m;m;m;m;m;m;"]], ids=["", "header and units"])
def test_tables_of_spreadsheets(tmp_path, lines, header):
    (tmp_path / "pairs.txt").write_text("\n".join([*header, *lines]))
    pairs = ControlPoints.read(tmp_path / "pairs.txt")
    np.testing.assert_array_equal(np.hstack([pairs.candidate, pairs.reference]), PAIRS)
    assert pairs.names == tuple("abcd")


@pytest.mark.parametrize(
    "text",
    [
        "a 1 2 3 4 5\n",
        "a 1 2 3 4 5 6\nb x 2 3 4 5 6\n",
        "a 0 0 0 0 0 0\nb 1 0 0 1 0 0\n",
        "a 0 0 0 0 0 0\nb 1 0 0 1 0 0\nc 2 0 0 2 0 0\n",
        "",
    ],
)
def test_invalid_files_of_pairs_are_refused(scene, tmp_path, text):
    (tmp_path / "pairs.txt").write_text(text)
    with check_error():
        register(*scene, f"points:{tmp_path / 'pairs.txt'}")


def test_control_points_without_scale_are_rigid():
    targets = np.random.default_rng(1).uniform(-20, 20, (6, 3))
    true_pose = motion()
    T, residuals = fit_pairs(ControlPoints(true_pose.inverse().apply(targets) / 1.1, targets, with_scale=False))
    assert T.scale == 1.0
    assert residuals.check == ()
    # About the mean of the points a wrong scale does not turn: rounding only.
    np.testing.assert_allclose(T.rotation, true_pose.rotation, atol=1e-12)
    T, _ = fit_pairs(ControlPoints(true_pose.inverse().apply(targets) / 1.1, targets))
    assert T.scale == pytest.approx(1.1, rel=1e-12)


@pytest.mark.parametrize(
    "arguments",
    [
        (np.eye(3), np.eye(3)[:2]),
        (np.eye(3), np.eye(4)),
        (np.eye(3) * np.nan, np.eye(3)),
        ("abc", np.eye(3)),
        (np.eye(3), np.eye(3), ["a"]),
        (np.eye(3), np.eye(3), (), [True, False, False]),
        (np.zeros((4, 3)), np.zeros((4, 3))),
    ],
)
def test_invalid_control_points_are_refused(arguments):
    with check_error():
        ControlPoints(*arguments)


def test_a_mistyped_first_line_is_not_a_header(tmp_path):
    """Its point would be missing without a word."""
    path = tmp_path / "control.txt"
    path.write_text("mast -l20 80 24 1 2 3\na 0 0 0 0 0 0\nb 1 0 0 1 0 0\nc 0 1 0 0 1 0\n")
    with check_error():
        ControlPoints.read(path)
    path.write_text("name x y z x_ref y_ref z_ref\na 0 0 0 0 0 0\nb 1 0 0 1 0 0\nc 0 1 0 0 1 0\n")
    assert len(ControlPoints.read(path).names) == 3
