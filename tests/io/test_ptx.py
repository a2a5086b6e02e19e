"""PTX: poses, directions without returns, several scans, and damage."""

import numpy as np
import pytest
from ptx_bytes import POINTS, TURN, scan
from refusals import refusal
from wording import check_text

from pcbench import read_cloud


def read(folder, text):
    (folder / "a.ptx").write_text(text)
    notes = []
    return read_cloud(folder / "a.ptx", on_warning=notes.append), notes


def test_poses_are_applied_to_row_vectors(tmp_path):
    cloud, notes = read(tmp_path, scan([*POINTS, (0, 0, 0, 0.5)], matrix=TURN))
    # A quarter turn about z takes x to y; then the translation.
    expected = [(100 - y, 200 + x, 10 + z) for x, y, z, _ in POINTS]
    np.testing.assert_allclose(cloud.points, expected, rtol=1e-15)
    assert cloud.attributes["intensity"].tolist() == [value for *_, value in POINTS]
    assert (cloud.unit, "scan" in cloud.attributes) == ("m", False)
    check_text("\n".join(notes))


def test_colors(tmp_path):
    rows = [(1, 2, 3, 0.5, 255, 0, 7), (0, 0, 0, 0.5, 0, 0, 0)]
    cloud, _ = read(tmp_path, scan(rows, columns=1).replace("\n", "\r\n"))
    assert (cloud.points.tolist(), cloud.colors.tolist()) == ([[1, 2, 3]], [[255, 0, 7]])


def test_several_scans(tmp_path):
    text = scan(POINTS, matrix=TURN) + scan([(0, 0, 0, 0)]) + "\n" + scan([(1, 2, 3, 0.5, 255, 0, 7)])
    cloud, notes = read(tmp_path, text)
    assert cloud.attributes["scan"].tolist() == [0, 0, 0, 0, 2]
    np.testing.assert_array_equal(cloud.points[4], [1, 2, 3])
    assert cloud.colors is None and len(cloud.attributes["intensity"]) == 5
    check_text("\n".join(notes))


def test_coordinates_keep_their_digits(tmp_path):
    cloud, _ = read(tmp_path, scan([(1234567.123456, -0.000001, 3, 1)]))
    assert cloud.points.tolist() == [[1234567.123456, -0.000001, 3]]


GOOD = scan(POINTS)
LINES = GOOD.splitlines()
DAMAGED = {
    "half a header": "\n".join(LINES[:6]),
    "no numbers of columns": "x y z\n" + GOOD,
    "no columns": "0\n" + "\n".join(LINES[1:]),
    "2^31 columns": f"{2**31}\n" + "\n".join(LINES[1:]),
    "huge": "9" * 5000 + "\n" + "\n".join(LINES[1:]),
    "truncated": "\n".join(LINES[:-1]),
    "a line too many": GOOD + "1 2 3 4\n",
    "two values": GOOD.replace(LINES[10], "1 2"),
    "words": GOOD.replace(LINES[11], "a b c d"),
    "another width": GOOD.replace(LINES[11], "1 2 3"),
    "matrix of column vectors": scan(POINTS, matrix=np.array(TURN).T.tolist()),
    "matrix of words": GOOD.replace(LINES[7], "1 2 x 0"),
    "matrix of NaN": GOOD.replace(LINES[9], "nan 0 0 1"),
    "no returns": scan([(0, 0, 0, 0)] * 4),
    "binary": b"\0" * 100,
}


@pytest.mark.parametrize("name", DAMAGED)
def test_damaged_ptx(tmp_path, name):
    refusal(tmp_path / "a.ptx", DAMAGED[name])


def test_points_without_coordinates_are_dropped(tmp_path):
    cloud, notes = read(tmp_path, scan([(1, 2, 3, 4), (float("nan"), 0, 0, 1)], matrix=TURN))
    assert (len(cloud), len(notes)) == (1, 1)
