"""`pcbench info`, `crop`, `register` and `convert`."""

import json

import numpy as np
import pytest
from command_line import one_line

from pcbench import Cloud, read_cloud, write_cloud
from pcbench.geometry.transform import read_matrix


def test_crop_register_and_info(files, run):
    code, out, _ = run("crop", "a.ply", "cut.ply", "--crop", "box:0,0,-1,10,10,30")
    assert code == 0
    assert "1,500 points" in out
    assert (read_cloud("cut.ply").points[:, 0] <= 10).all()
    code, out, _ = run("register", "ref.ply", "a.ply", "--out", "aligned.ply", "--matrix", "T.txt")
    assert code == 0
    assert "converged" in out
    moved = read_matrix("T.txt").apply(read_cloud("a.ply").points)
    np.testing.assert_allclose(read_cloud("aligned.ply").points, moved, atol=1e-12)
    code, out, _ = run("compare", "ref.ply", "a.ply", "--register", "matrix:T.txt", "--json", "-")
    assert json.loads(out)["candidates"][0]["registration"]["method"] == f"matrix:{files / 'T.txt'}"
    code, out, _ = run("info", "ref.ply", "a.ply")
    assert code == 0
    assert "4,000 points" in out
    assert "1,500 points" in out


def test_no_file_that_a_setting_names_is_replaced(files, run):
    matrix = files / "bend/T.txt"
    matrix.parent.mkdir()
    rows = "\n".join(" ".join(map(str, row)) for row in np.eye(4))
    for name in ("deformation.json", "T.txt"):  # as `pcbench deform` leaves them
        (matrix.parent / name).write_text(rows)
    for command in (
        ("register", "ref.ply", "a.ply", "--register", "matrix:bend/T.txt", "--matrix", "bend/T.txt"),
        ("deform", "ref.ply", "a.ply", "--register", "matrix:bend/T.txt", "--out", "bend"),
    ):
        code, _, err = run(*command)
        assert code == 2
        assert one_line(err)
        assert "would replace" in err
        assert matrix.read_text() == rows


def test_convert(files, run):
    write_cloud("c.ply", Cloud(read_cloud("a.ply").points, attributes={"quality": np.arange(1500.0)}))
    for name in ("c.xyz", "c.npz", "c.las", "c.laz", "c.pcd"):
        if name.endswith("laz"):
            pytest.importorskip("lazrs")
        code, out, err = run("convert", "c.ply", name)
        assert code == 0, err
        assert "1,500 points" in out
        np.testing.assert_allclose(read_cloud(name).points, read_cloud("c.ply").points, atol=1e-4)
    code, _, err = run("convert", "c.ply", "c.xyz", "--classes", "2")
    assert code == 2
    assert one_line(err)
