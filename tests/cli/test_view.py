"""`pcbench view`: pictures without a window, and what it says where it cannot open one."""

import shutil
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import shapes
from camera_rigs import sector
from command_line import is_one_line
from optional import import_or_skip
from scene_folders import NAMES, orbit, ten_images_folder
from wording import check_text

from pcbench import Cloud, write_cloud
from pcbench.io.colmap_model import write_colmap_model

import_or_skip("pyvista")


@pytest.fixture(autouse=True)
def _no_display(monkeypatch):
    """No test may open a window."""
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)


@pytest.fixture
def shown(off_screen, monkeypatch):
    """Let pictures be rendered without the child process that tries it first; `off_screen` has tried it."""
    monkeypatch.setattr("pcbench.report.plotters.window.check_window", lambda *, off_screen: None)


def size_and_colors(path):
    from PIL import Image

    with Image.open(path) as picture:
        return picture.size, len(np.unique(np.asarray(picture.convert("RGB")).reshape(-1, 3), axis=0))


@pytest.mark.usefixtures("shown")
def test_a_picture_of_a_report_and_a_mesh(report, run):
    Path("mesh.off").write_text("OFF\n4 4 0\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n3 0 2 1\n3 0 1 3\n3 1 2 3\n3 0 3 2\n")
    for path in (report, "mesh.off"):  # and a cloud below
        assert run("view", path, "--screenshot", "view.png") == (0, "", "")
        size, colors = size_and_colors("view.png")
        assert size == (1200, 800)
        assert colors > 20
    # Inputs are never replaced, and nothing is left half-written.
    write_cloud("cloud.ply", Cloud(np.eye(3)))
    before = sorted(Path().iterdir())
    for name in ("view.jpg", "nowhere/view.png", "report"):
        code, out, err = run("view", "cloud.ply", "--screenshot", name)
        assert (code, out, is_one_line(err)) == (2, "", True)
        check_text(err)
    assert sorted(Path().iterdir()) == before


def test_without_a_display_it_says_what_to_do(report, run, monkeypatch):
    if not sys.platform.startswith("linux"):
        pytest.skip("only Linux has variables that name the display")
    for path in (report, "a.ply"):
        code, out, err = run("view", path)
        assert (code, out, is_one_line(err)) == (2, "", True)
        check_text(err)
    (report / "report.html").touch()
    assert "report.html in a browser" in check_text(run("view", report)[2])
    monkeypatch.setenv("DISPLAY", ":no-such-display")
    code, _, err = run("view", "a.ply")
    assert (code, is_one_line(err)) == (2, True)
    assert "no window: OpenGL fails" in err


def test_without_opengl_it_says_what_to_do(report, run, monkeypatch):
    monkeypatch.setattr("pcbench.opengl._LIBRARIES", ("libNoSuchThing.so",))
    monkeypatch.setattr("sys.platform", "linux")
    for path in (report, "a.ply"):
        code, _, err = run("view", path, "--screenshot", "view.png")
        assert (code, is_one_line(err)) == (2, True)
        check_text(err)


@pytest.mark.long
@pytest.mark.usefixtures("shown")
def test_a_folder_of_deform(run, tmp_path, monkeypatch):
    """Arrows of a bent cloud; a cloud without deformation, and damaged files, are one line."""
    monkeypatch.chdir(tmp_path)
    points = shapes.city(1500, seed=2)[0]
    bowl = np.stack([*(0 * points[:, :2]).T, 1e-3 * (points[:, :2] ** 2).sum(axis=1)], axis=1)
    write_cloud("ref.ply", Cloud(shapes.city(3000, seed=1)[0], unit="m"))
    write_cloud("bent.ply", Cloud(points + bowl))
    write_cloud("a.ply", Cloud(points))
    for name in ("bent", "a"):
        assert run("deform", "ref.ply", f"{name}.ply", "--out", name, "--no-figures", "-q")[0] == 0
    assert run("view", "bent", "--screenshot", "view.png") == (0, "", "")
    assert size_and_colors("view.png")[1] > 100
    cameras = [replace(camera, name=name) for camera, name in zip(sector(0, 80, 10), NAMES, strict=True)]
    write_colmap_model(ten_images_folder(Path("photos")) / "sparse/0", cameras)
    assert run("view", "bent", "--scene", "photos", "--screenshot", "beside.png") == (0, "", "")
    assert Path("beside.png").read_bytes() != Path("view.png").read_bytes()
    code, out, err = run("view", "a", "--screenshot", "none.png")
    assert (code, out, is_one_line(err)) == (2, "", True)
    check_text(err)
    write_cloud("bent/deformation.ply", np.eye(3))
    code, out, err = run("view", "bent", "--screenshot", "none.png")
    assert (code, out, is_one_line(err)) == (2, "", True)
    check_text(err)
    Path("bent/aligned.ply").unlink()
    code, out, err = run("view", "bent", "--screenshot", "none.png")
    assert (code, out, is_one_line(err)) == (2, "", True)
    assert not Path("none.png").exists()


@pytest.mark.usefixtures("off_screen")
def test_a_crash_of_opengl_is_one_line(files, run, monkeypatch):
    monkeypatch.setattr(sys, "executable", shutil.which("false"))
    code, _, err = run("view", "a.ply", "--screenshot", "view.png")
    assert (code, is_one_line(err)) == (2, True)
    check_text(err)


@pytest.mark.usefixtures("shown")
def test_a_scene_selects_the_view_of_a_file(report, run):
    photographs = ten_images_folder(Path("photos"))
    write_colmap_model(photographs / "sparse/0", orbit(NAMES))
    assert run("view", "a.ply", "--scene", "photos", "--screenshot", "view.png") == (0, "", "")
    assert size_and_colors("view.png")[1] > 20
    for arguments in (("a.ply", "--cameras", "x"), (report, "--scene", "photos"), ("a.ply", "--scene", "nowhere")):
        code, out, err = run("view", *arguments, "--screenshot", "view.png")
        assert (code, out, is_one_line(err)) == (2, "", True)
        check_text(err)


@pytest.mark.usefixtures("shown")
def test_what_cannot_be_shown_is_refused(files, run):
    Path("empty").mkdir()
    Path("damaged").mkdir()
    Path("damaged/comparison.json").write_text("{}")
    Path("text.docx").touch()
    for path in ("empty", "damaged", "nowhere.ply", "text.docx"):
        code, out, err = run("view", path, "--screenshot", "view.png")
        assert (code, out, is_one_line(err)) == (2, "", True)
        check_text(err)
    assert not Path("view.png").exists()
