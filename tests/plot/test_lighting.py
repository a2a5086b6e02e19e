"""Eye-dome lighting: it darkens what lies behind, and keeps hues, planes, lone dots, text and background."""

import numpy as np
import pytest
from optional import import_or_skip

import pcbench
from pcbench.report.colors import Range
from pcbench.report.plotters.stage import Stage, Window

import_or_skip("pyvista")
pytestmark = pytest.mark.usefixtures("off_screen")
GROUND = (0x1A, 0x1C, 0x20)
LABELS = slice(728, 750)  # rows of the labels of the colour bar


def grid(size, height, step=0.25):
    x, y = np.meshgrid(np.arange(0, size, step), np.arange(0, size, step))
    return np.stack([x.ravel(), y.ravel(), np.full(x.size, height)], axis=1)


PLANE = grid(40.0, 0.0)
ROOF = grid(10.0, 12.0) + [15, 15, 0]
PILLARS = np.concatenate([PLANE, ROOF])  # a roof above a plane


def plotter_of(points, lighting=True, ghost=None, value=0.7, background="dark"):
    values = np.full(len(points), value)
    return pcbench.plot.deviation(
        ghost, points, values, range=1.0, off_screen=True, lighting=lighting, background=background
    )


def picture_of(plotter, **how):
    plotter.render()
    return np.asarray(plotter.screenshot(return_img=True, **how))[..., :3].astype(int)


def render(*given, **how):
    plotter = plotter_of(*given, **how)
    picture = picture_of(plotter)
    plotter.close()
    return picture


def is_color(picture, color, tolerance=2):
    return np.abs(picture - color).max(axis=2) <= tolerance


COLOR = Range(0.0, 1.0).colors(np.array([0.7]))[0]


def test_what_lies_behind_a_roof_is_darker():
    """The plane is darker along the edge of the roof, and has exactly its colour elsewhere."""
    lit, plain = render(PILLARS), render(PILLARS, lighting=False)
    points = is_color(plain, COLOR)
    assert points.mean() > 0.1
    darker = points & (lit.sum(axis=2) < plain.sum(axis=2) - 60)
    assert 0.005 < darker.sum() / points.sum() < 0.2
    assert (points & is_color(lit, COLOR)).sum() > 0.8 * points.sum()


def test_lighting_keeps_the_hue():
    """Each channel is multiplied by the same factor, up to the rounding of the picture."""
    lit, plain = render(PILLARS), render(PILLARS, lighting=False)
    points = is_color(plain, COLOR) & ~is_color(lit, COLOR)
    colors = lit[points]
    factors = colors.sum(axis=1) / COLOR.sum()
    difference = np.abs(colors - factors[:, None] * COLOR).max(axis=1)
    assert np.median(difference) < 1.5
    assert np.mean(difference < 3) > 0.9  # others are edges that multisampling blends with what lies behind them


@pytest.mark.parametrize("background", [pytest.param("dark", marks=pytest.mark.long), "white"])
def test_text_axes_and_background_do_not_change(background):
    """Only pixels of the lit points differ, so that text keeps the colour of ink."""
    lit, plain = render(PILLARS, background=background), render(PILLARS, lighting=False, background=background)
    changed = np.abs(lit - plain).max(axis=2) > 2
    rows, columns = np.nonzero(is_color(plain, COLOR)[:640])
    outside = np.ones_like(changed)
    outside[rows.min() - 6 : rows.max() + 7, columns.min() - 6 : columns.max() + 7] = False
    assert not changed[outside].any()
    ink = [int(c, 16) for c in (("1b", "1c", "1e") if background == "white" else ("e8", "e8", "e6"))]
    for part in (slice(0, 50), LABELS):
        counts = [is_color(picture[part], ink, 20).sum() for picture in (lit, plain)]
        assert min(counts) > 0.9 * max(counts) > 20


def test_a_ghost_is_not_lit():
    """A ghost far below a sparse cloud looks as without lighting."""
    ghost = grid(40.0, -20.0, 0.1)
    cloud = np.array([[5.0, 5, 0], [35, 35, 0], [5, 35, 0]])
    lit, plain = render(cloud, ghost=ghost), render(cloud, ghost=ghost, lighting=False)
    shown = np.abs(plain - GROUND).max(axis=2) > 8
    assert shown[:640].mean() > 0.1
    assert abs(lit[:640][shown[:640]].mean() - plain[:640][shown[:640]].mean()) < 3


@pytest.mark.parametrize(("parallel", "zoom"), [(True, 4.0), (False, 1.0)])
def test_planes_keep_their_colours_from_all_sides(parallel, zoom):
    plotter = plotter_of(PLANE)
    plotter.camera.parallel_projection = parallel
    plotter.camera.zoom(zoom)
    for azimuth, elevation in ((0, 0), (30, 25), (70, -20)):
        plotter.camera.azimuth, plotter.camera.elevation = azimuth, elevation
        picture = picture_of(plotter)[50:640]
        hue = np.abs(picture - picture.sum(axis=2, keepdims=True) / COLOR.sum() * COLOR).max(axis=2) < 4
        points = hue & (picture.sum(axis=2) > 0.3 * COLOR.sum())
        assert points.mean() > 0.05
        assert np.median(picture[points].sum(axis=1)) > 0.97 * COLOR.sum()
    plotter.close()


def test_perspective_also_darkens_what_lies_behind():
    plotter = plotter_of(PILLARS)
    plotter.camera.parallel_projection = False
    plotter.reset_camera()
    lit = picture_of(plotter)
    plotter.renderer.SetPass(None)
    plain = picture_of(plotter)
    plotter.close()
    points = is_color(plain, COLOR)
    assert 0.005 < (points & (lit.sum(axis=2) < plain.sum(axis=2) - 60)).sum() / points.sum() < 0.25


def test_lighting_can_be_switched_off_and_on():
    stage = Stage(pcbench.report.plot.maps.frame(None, {"": pcbench.Cloud(PILLARS)}), "m", Window(off_screen=True))
    stage.add_values(PILLARS, np.full(len(PILLARS), 0.7), Range(0.0, 1.0))
    pictures = []
    for stage.lighting.enabled in (True, False, True):
        pictures.append(picture_of(stage.plotter))
    stage.plotter.close()
    assert (pictures[0] == pictures[2]).mean() > 0.999
    assert is_color(pictures[1], COLOR).sum() > is_color(pictures[0], COLOR).sum()


@pytest.mark.long
def test_passes_of_pyvista_replace_the_lighting_without_errors(capfd):
    plotter = plotter_of(PILLARS)
    picture_of(plotter)
    plotter.enable_anti_aliasing("ssaa")
    replaced = picture_of(plotter)
    plotter.close()
    plotter = plotter_of(PILLARS, lighting=False)
    plotter.enable_anti_aliasing("ssaa")
    expected = picture_of(plotter)
    plotter.close()
    assert (np.abs(replaced - expected).max(axis=2) > 2).mean() < 0.001
    assert not capfd.readouterr().err


@pytest.mark.long
def test_large_pictures_and_new_window_sizes(capfd):
    """Dots keep their size in pixels in a larger picture, so that the plane behind is seen through the roof."""
    plotter = plotter_of(PILLARS)
    large = picture_of(plotter, scale=2)
    assert large.shape == (1600, 2400, 3)
    assert is_color(large, COLOR).mean() > 0.03
    plotter.window_size = (500, 300)
    small = picture_of(plotter)
    assert small.shape == (300, 500, 3)
    assert is_color(small, COLOR).mean() > 0.1
    plotter.close()
    assert not capfd.readouterr().err


def test_a_page_can_be_exported(tmp_path):
    plotter = plotter_of(PILLARS)
    try:
        plotter.export_html(tmp_path / "page.html")
    except ImportError as error:  # of the extra `jupyter` of pyvista
        pytest.skip(str(error))
    finally:
        plotter.close()
    assert (tmp_path / "page.html").stat().st_size > 100_000
