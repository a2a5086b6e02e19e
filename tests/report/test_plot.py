"""Pictures: drawn from a report folder, with content, the same limits for all, and no crash where they cannot be."""

import json
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
import shapes

from pcbench import Cloud, write_cloud
from pcbench.errors import InputError, MissingExtra
from pcbench.opengl import NoFiguresError
from pcbench.report import plot
from pcbench.report.colors import ramp
from pcbench.report.plot import draw
from pcbench.report.plot.maps import limits


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    """A report of two candidates, without pictures yet."""
    from pcbench import cli

    folder = tmp_path_factory.mktemp("plot")
    rng = np.random.default_rng(0)
    reference = shapes.city(20_000, seed=1)[0]
    write_cloud(folder / "ref.ply", Cloud(reference, unit="m"))
    for name, noise in (("a", 0.02), ("b", 0.1)):
        points = shapes.city(3000, seed=2)[0]
        write_cloud(folder / f"{name}.ply", Cloud(points + rng.normal(0, noise, points.shape)))
    files = [str(folder / f"{name}.ply") for name in ("ref", "a", "b")]
    arguments = ["compare", *files, "--out", str(folder / "report"), "--no-figures", "--map", "m3c2", "-q"]
    cli.app(arguments, standalone_mode=False)
    return folder / "report"


@pytest.fixture(scope="module")
def figures(report):
    try:
        plot.check_libraries()
    except (NoFiguresError, MissingExtra) as error:
        pytest.skip(str(error))
    return {path.stem: path for path in draw(report)}


def test_every_picture_is_there_and_shows_something(figures):
    from matplotlib.image import imread

    names = {"reference", "distribution"} | {
        f"{c}_{s}" for c in "ab" for s in ("distance", "plane_distance", "m3c2_distance", "deformation")
    }
    assert figures.keys() - {"a_displacement", "b_displacement"} == names
    for name, path in figures.items():
        image = imread(path)[..., :3]
        assert image.shape[0] >= 500
        background = np.median(image.reshape(-1, 3), axis=0)
        drawn = (np.abs(image - background) > 0.05).any(axis=2)
        # Not empty, and each third of a map holds its view.
        assert 0.02 < drawn.mean() < 0.9, name
        if name != "distribution" and not name.endswith("_deformation"):
            for panel in np.array_split(drawn[:, : int(0.93 * drawn.shape[1])], 3, axis=1):
                assert panel.mean() > 0.02, name


def test_one_picture_again(figures, report):
    figures["a_distance"].unlink()
    assert draw(report, ("a_distance",)) == [report / "figures/a_distance.png"]
    assert figures["a_distance"].is_file()
    with pytest.raises(InputError, match="no picture 'z': expected distribution, reference"):
        draw(report, ("z",))


def test_the_reference_may_have_gone(figures, report, tmp_path):
    copy = tmp_path / "copy"
    shutil.copytree(report, copy)
    shutil.rmtree(copy / "figures")
    settings = json.loads((copy / "settings.json").read_text())
    settings["reference"]["path"] = "/nowhere/ref.ply"
    (copy / "settings.json").write_text(json.dumps(settings))
    with pytest.raises(InputError, match="reference's file has gone"):
        draw(copy, ("reference",))
    assert draw(copy, ("distribution",)) == [copy / "figures/distribution.png"]


def test_limits_are_shared_and_symmetric_where_signed():
    few, many = np.linspace(0, 1, 101), np.linspace(0, 2, 101)
    assert limits([few, many]).high == pytest.approx(1.9)
    assert limits([few]).low == 0
    signed = limits([few - 0.5, few])
    assert signed.low == -signed.high


def test_ramp_runs_from_blue_to_red():
    colors = ramp(np.array([-1.0, 0.0, 0.2, 0.85, 1.0, 5.0]), 0.0, 1.0).astype(int)
    assert colors[2, 2] > colors[2, 0]
    assert colors[3, 0] > colors[3, 2]
    assert (colors[0] == colors[1]).all()
    assert (colors[4] == colors[5]).all()


def test_without_opengl_it_says_so(monkeypatch, report):
    monkeypatch.setattr("pcbench.opengl._LIBRARIES", ("libNoSuchThing.so",))
    monkeypatch.delenv("DISPLAY", raising=False)
    with pytest.raises(NoFiguresError, match="neither a display nor EGL nor OSMesa"):
        draw(report)


def test_without_pyvista_it_names_the_extra(monkeypatch, report):
    monkeypatch.setattr(plot, "find_spec", lambda name: None)
    with pytest.raises(MissingExtra, match=r"pip install 'pcbench\[plot\]'"):
        draw(report)


def test_a_crash_while_drawing_is_one_line(monkeypatch, report):
    monkeypatch.setattr(sys, "executable", shutil.which("false"))
    with pytest.raises(NoFiguresError, match="drawing failed"):
        draw(report)


def test_not_a_report():
    with pytest.raises(InputError, match="expected a report folder"):
        draw(Path("/"))
