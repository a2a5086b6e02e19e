"""`pcbench info`, `crop`, `register` and `convert`."""

import json
import os
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from command_line import is_one_line
from optional import import_or_skip
from wording import check_text

from pcbench import Cloud, read_cloud, write_cloud
from pcbench.cli import clouds, convert
from pcbench.geometry.transform import read_matrix
from pcbench.io.meshes import read_mesh


def test_crop_register_and_info(files, run):
    code, out, _ = run("crop", "a.ply", "cut.ply", "--crop", "box:0,0,-1,10,10,30")
    assert code == 0
    assert "1,500 points" in check_text(out)
    assert (read_cloud("cut.ply").points[:, 0] <= 10).all()
    code, out, _ = run("register", "ref.ply", "a.ply", "--out", "aligned.ply", "--matrix", "T.txt")
    assert code == 0
    check_text(out.splitlines()[0])
    aligned = read_matrix("T.txt").apply(read_cloud("a.ply").points)
    np.testing.assert_allclose(read_cloud("aligned.ply").points, aligned, atol=1e-12)
    code, out, _ = run("compare", "ref.ply", "a.ply", "--register", "matrix:T.txt", "--json", "-")
    assert json.loads(out)["candidates"][0]["registration"]["method"] == f"matrix:{files / 'T.txt'}"
    code, out, _ = run("info", "ref.ply", "a.ply")
    assert code == 0
    check_text(out)
    assert "4,000 points" in out
    assert "1,500 points" in out


def test_register_keeps_the_faces_of_a_mesh(files, run):
    rows = np.array([[0, 0, 0], [20, 0, 0], [0, 20, 0], [0, 0, 10]])
    lines = [f"v {x} {y} {z}" for x, y, z in rows] + ["f 1 3 2", "f 1 2 4", "f 1 4 3", "f 2 3 4"]
    Path("mesh.obj").write_text("\n".join(lines))
    Path("T.txt").write_text("0 -1 0 5\n1 0 0 6\n0 0 1 7\n0 0 0 1\n")
    assert run("register", "ref.ply", "mesh.obj", "--register", "matrix:T.txt", "--out", "moved.ply")[0] == 0
    mesh = read_mesh("moved.ply")
    np.testing.assert_array_equal(mesh.vertices, read_matrix("T.txt").apply(rows))
    np.testing.assert_array_equal(mesh.faces, [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    code, _, err = run("register", "ref.ply", "mesh.obj", "--register", "matrix:T.txt", "--out", "moved.las")
    assert code == 0
    assert "points sampled on the mesh; a .ply file keeps its faces" in err


def test_register_prints_the_motion_before_the_matrix(files, run):
    """The shift is that of the centroid: at the origin, 450 km away, a rotation of half a degree shifts by 4 km."""
    offset = np.array([450_000.0, 5_400_000.0, 300.0])
    points = read_cloud("ref.ply").points + offset
    centroid = points.mean(axis=0)
    angle = np.radians(0.5)
    rotation = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    write_cloud("far.ply", Cloud(points, unit="m"))
    write_cloud("moved.ply", Cloud((points - centroid) @ rotation.T + centroid + [0.03, 0.04, 0], unit="m"))
    code, out, _ = run("register", "far.ply", "moved.ply")
    assert code == 0
    shift_line, rotation_line, scale_line, overlap_line, fit_line, pose_line, title_line, *matrix_lines = (
        out.splitlines()
    )
    assert float(shift_line.split()[5]) == pytest.approx(0.05, abs=0.002)
    assert shift_line.split()[6] == "m"
    assert float(rotation_line.split()[2]) == pytest.approx(0.5, abs=0.002)
    assert float(rotation_line.rstrip(")").split()[-1]) == pytest.approx(-1, abs=1e-4)  # back about z
    assert scale_line.startswith("# scale: 1 ")
    assert "turned it by 0.5 ± " in overlap_line
    assert "100.0%" in fit_line
    assert pose_line.startswith(
        "# Registered by icp: 100.0% of the candidate lies on the reference, and the standard error"
    )
    check_text("\n".join([scale_line, title_line]))
    assert len(matrix_lines) == 4
    (files / "T.txt").write_text(out)  # the whole output is a valid matrix file
    np.testing.assert_allclose(read_matrix("T.txt").apply(read_cloud("moved.ply").points), points, atol=0.005)


def test_register_says_in_the_words_of_compare_whether_the_pose_can_be_trusted(files, run):
    rng = np.random.default_rng(0)
    write_cloud("plane.ply", Cloud(rng.random((2000, 3)) * [1, 1, 0]))
    low, high = read_cloud("ref.ply").bounds
    write_cloud("noise.ply", Cloud(rng.uniform(low, high, (2000, 3))))
    for reference, candidate in (("plane", "plane"), ("ref", "noise")):
        _, out, _ = run("register", f"{reference}.ply", f"{candidate}.ply")
        sentence = out.splitlines()[-6].removeprefix("# ")
        answer = run("compare", f"{reference}.ply", f"{candidate}.ply")[1]
        assert sentence.replace("the candidate", candidate) in answer
        check_text(sentence)


def test_register_of_a_cloud_with_itself_moves_nothing(files, run):
    code, out, _ = run("register", "ref.ply", "ref.ply", "--register", "none")
    assert code == 0
    shift_line, rotation_line, *_ = out.splitlines()
    assert "0 m (+0, +0, +0)" in check_text(shift_line)
    assert " 0 " in check_text(rotation_line)


@pytest.mark.parametrize("has_pyproj", [True, False], ids=["with pyproj", "without"])
def test_a_coordinate_system_is_one_line(files, run, monkeypatch, has_pyproj):
    from pcbench.geometry import crs

    if has_pyproj:
        import_or_skip("pyproj")
    else:
        monkeypatch.setattr(crs, "parse_crs", lambda text: None)
    wkt = (
        'PROJCS["Somewhere / in the north",\n  GEOGCS["GRS 1980(IUGG, 1980)",DATUM["unknown",SPHEROID["GRS80",6378137,'
        '298.257222101]],PRIMEM["Greenwich",0],UNIT["degree",0.0174532925199433]],PROJECTION["Transverse_Mercator"],'
        'PARAMETER["latitude_of_origin",0],PARAMETER["central_meridian",9],PARAMETER["scale_factor",0.9996],'
        'PARAMETER["false_easting",500000],PARAMETER["false_northing",0],UNIT["metre",1]]'
    )
    assert crs.crs_label(wkt) == "Somewhere / in the north"
    assert crs.crs_label("EPSG:32632") == ("WGS 84 / UTM zone 32N (EPSG:32632)" if has_pyproj else "EPSG:32632")
    assert len(crs.crs_label("x" * 5000)) == 100
    write_cloud("named.ply", Cloud(read_cloud("a.ply").points, crs="EPSG:32632"))
    code, out, _ = run("info", "named.ply")
    assert code == 0
    assert f"colours no, crs {crs.crs_label('EPSG:32632')}\n" in out


def test_files_named_by_settings_are_not_replaced(files, run):
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
        assert is_one_line(err)
        check_text(err)
        assert matrix.read_text() == rows


def test_convert(files, run):
    write_cloud("c.ply", Cloud(read_cloud("a.ply").points, attributes={"quality": np.arange(1500.0)}))
    for name in ("c.xyz", "c.npz", "c.las", "c.laz", "c.pcd"):
        if name.endswith("laz"):
            import_or_skip("lazrs")
        code, out, err = run("convert", "c.ply", name)
        assert code == 0, err
        assert out == f"{name}: 1,500 points\n"
        np.testing.assert_allclose(read_cloud(name).points, read_cloud("c.ply").points, atol=1e-4)
    code, _, err = run("convert", "c.ply", "c.xyz", "--classes", "2")
    assert code == 2
    assert is_one_line(err)


@pytest.mark.parametrize(
    ("module", "command", "steps"),
    [
        (clouds, ("info", "ref.ply"), ["reading ref.ply", "measuring the spacing"]),
        (
            clouds,
            ("crop", "ref.ply", "o.ply", "--crop", "box:0,0,-99,99,99,99"),
            ["reading ref.ply", "cropping", "writing o.ply"],
        ),
        (convert, ("convert", "ref.ply", "o.xyz"), ["reading ref.ply", "writing o.xyz"]),
    ],
)
def test_a_terminal_shows_the_steps(files, monkeypatch, module, command, steps):
    messages = []

    @contextmanager
    def record_steps(quiet):
        yield messages.append

    monkeypatch.setattr(module, "steps", record_steps)
    getattr(module, command[0]).main(command[1:], standalone_mode=False)
    assert messages == steps
    assert all(step.expected > 0 for step in messages)


def test_info_describes_the_files_after_a_bad_one(files, run, monkeypatch):
    def open_unless_locked(path, *mode, **how):
        if path.name == "locked.ply":  # as for others than the administrator
            raise PermissionError(13, "Permission denied", str(path))
        return opened(path, *mode, **how)

    (files / "empty.ply").touch()
    (files / "locked.ply").write_bytes((files / "a.ply").read_bytes())
    opened = Path.open
    monkeypatch.setattr(Path, "open", open_unless_locked)
    monkeypatch.setattr(os, "access", lambda path, *_: Path(path).name != "locked.ply")
    code, out, err = run("info", "none.ply", "empty.ply", "locked.ply", "a.ply")
    assert code == 2
    assert out.startswith("a.ply: ")
    assert [line.split(":")[1] for line in err.splitlines()] == [" none.ply", " empty.ply", " locked.ply"]
    check_text(err)
