"""Plotters: colours, precision, framing and errors of rendered scenes, against known answers."""

from dataclasses import replace

import numpy as np
import pytest
import shapes
from camera_rigs import random_rotation, rotated, sector
from optional import break_library, import_or_skip
from scene_folders import NAMES, orbit, ten_images_folder
from wording import check_error, check_text

import pcbench
from pcbench import Cloud, Mesh
from pcbench.errors import InputError, MissingExtra
from pcbench.io.colmap_model import write_colmap_model
from pcbench.opengl import NoFiguresError
from pcbench.report.colors import Range

import_or_skip("pyvista")
pytestmark = pytest.mark.usefixtures("off_screen")
UTM = np.array([500_000.0, 5_400_000.0, 0.0])


def render(plotter):
    """Return the picture (height, width, 3) and close the plotter."""
    picture = np.asarray(plotter.screenshot(return_img=True))[..., :3].astype(int)
    plotter.close()
    return picture


def scene_of(picture):
    """Return the middle of a picture, without title and colour bar."""
    return picture[50 : int(0.84 * len(picture))]


def pixels_of(picture, color, tolerance=2):
    return int((np.abs(picture - color).max(axis=2) <= tolerance).sum())


def background_share(picture):
    return pixels_of(picture, (0x1A, 0x1C, 0x20), 0) / picture[..., 0].size


@pytest.fixture(scope="module")
def comparison():
    rng = np.random.default_rng(0)
    reference = Cloud(shapes.city(4000, seed=1)[0], unit="m")
    points = shapes.city(1500, seed=2)[0]
    bent = points + np.stack([0 * points[:, 0], 0 * points[:, 0], 1e-3 * (points[:, :2] ** 2).sum(axis=1)], axis=1)
    candidates = {"a": Cloud(points + rng.normal(0, 0.05, points.shape)), "bent": Cloud(bent)}
    return pcbench.compare(reference, candidates)


@pytest.mark.parametrize("values", [[-1.0, -0.5, 0.0, 0.25, 1.0, 7.0], [0.0, 0.2, 0.4, 0.6, 0.8, 3.0]])
def test_points_have_exactly_the_colours_of_the_range(values):
    """Neither light nor blending changes them; values beyond the range have its last colour."""
    points = np.stack([np.arange(6.0), np.arange(6.0) % 2, 0 * np.arange(6.0)], axis=1)
    picture = scene_of(render(pcbench.plot.deviation(None, points, values, range=1.0, off_screen=True)))
    signed = min(values) < 0
    for color in Range(-1.0 if signed else 0.0, 1.0, signed=signed).colors(np.array(values)):
        assert pixels_of(picture, color) >= 12, color


def test_values_may_be_an_attribute_and_nan_is_left_out():
    cloud = Cloud(np.eye(3), attributes={"distance": np.array([0.0, 1.0, np.nan])}, unit="m")
    plotter = pcbench.plot.deviation(None, cloud, "distance", off_screen=True)
    assert plotter.actors["values"].mapper.dataset.n_points == 2
    check_text(next(iter(plotter.scalar_bars.keys())).strip())
    plotter.close()


def test_the_range_ends_at_the_95th_percentile():
    values = np.arange(101.0)
    plotter = pcbench.plot.deviation(None, np.random.default_rng(0).random((101, 3)), values, off_screen=True)
    assert plotter.actors["values"].mapper.scalar_range == (0.0, 95.0)
    plotter.close()


def test_the_first_rendering_is_as_later_ones():
    """VTK would move the labels of the colour bar with the second rendering, if there is a ghost."""
    points = np.random.default_rng(0).random((300, 3))
    plotter = pcbench.plot.deviation(points, points, points[:, 2] - 0.5, off_screen=True)
    first = np.asarray(plotter.screenshot(return_img=True))
    plotter.render()
    assert (first != np.asarray(plotter.screenshot(return_img=True))).mean() < 1e-4
    plotter.close()


def test_large_coordinates_lose_no_precision():
    """The picture of a scene in UTM is that of the scene near 0, pixel by pixel, except for the labels of the axes."""
    points = np.round(1024 * np.random.default_rng(0).random((400, 3))) / 1024  # exact, also after the shift
    values = np.linspace(0, 1, 400)
    near, far = (pcbench.plot.deviation(p, p, values, off_screen=True) for p in (points, points + UTM))
    datasets = [plotter.actors["values"].mapper.dataset for plotter in (near, far)]
    steps = [np.diff(data.points.astype(float), axis=0) for data in datasets]
    assert np.abs(steps[0] - np.diff(points, axis=0)).max() < 1e-6
    assert np.abs(steps[1] - np.diff(points, axis=0)).max() < 1e-6  # float32 coordinates have steps of 0.5 here
    assert np.abs(datasets[1].points).max() < 10
    pictures = [render(plotter)[250:450, 450:750] for plotter in (near, far)]
    assert np.mean(np.abs(pictures[0] - pictures[1]).max(axis=2) > 30) < 0.02
    assert background_share(pictures[0]) < 0.95


def test_every_scene_shows_something(comparison):
    reference = Cloud(comparison["a"].completeness.points, unit="m")
    mesh = Mesh(np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]]), [[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])
    field = comparison["bent"].deformation.field
    plotters = [
        pcbench.plot.cloud(reference, off_screen=True),
        pcbench.plot.cloud(mesh, off_screen=True),
        pcbench.plot.deviation(mesh, reference, reference.points[:, 2], off_screen=True),
        pcbench.plot.displacements(reference, field.places, field.displacements, off_screen=True),
        *(comparison.plot("bent", kind, off_screen=True) for kind in ("distance", "completeness", "deformation")),
    ]
    for number, plotter in enumerate(plotters):
        shown = 1 - background_share(scene_of(render(plotter)))
        assert 0.02 < shown < 0.8, number


@pytest.mark.parametrize("points", [[[5e5, 5e6, 1e2]], [[k, 0, 0] for k in range(9)]])
def test_points_without_extent_are_visible(points):
    for plotter in (
        pcbench.plot.cloud(points, off_screen=True),
        pcbench.plot.deviation(points, points, np.zeros(len(points)), off_screen=True),
    ):
        assert pixels_of(scene_of(render(plotter)), Range(0.0, 1.0).colors(np.zeros(1))[0]) >= 12


def test_a_cloud_keeps_its_colours():
    colors = [[250, 10, 20], [20, 240, 30], [40, 50, 230]]
    picture = render(pcbench.plot.cloud(Cloud(np.eye(3), colors=colors), off_screen=True))
    assert all(pixels_of(picture, color) >= 12 for color in colors)


def test_window_size_and_background():
    picture = render(pcbench.plot.cloud(np.eye(3), off_screen=True, window_size=(300, 200), background="#204060"))
    assert picture.shape == (200, 300, 3)
    assert picture[100, 2].tolist() == [0x20, 0x40, 0x60]


def test_cameras_are_pyramids_about_their_positions(tmp_path):
    photographs = ten_images_folder(tmp_path)
    points = Cloud(np.random.default_rng(0).normal(size=(500, 3)))
    write_colmap_model(photographs / "sparse/0", orbit(NAMES), points)
    plotter = pcbench.plot.cameras(photographs, off_screen=True)
    pyramids = plotter.actors["cameras"].mapper.dataset
    assert pyramids.n_cells == len(NAMES)
    assert pyramids.n_points == 11 * len(NAMES)
    assert {"order", "ghost"} <= plotter.actors.keys()
    check_text(plotter.actors["title"].input)
    picture = render(plotter)
    assert pixels_of(picture, (0x56, 0xB4, 0xE9)) > 100
    assert pixels_of(picture, (0xE6, 0x9F, 0x00)) > 20
    with check_error():
        pcbench.plot.cameras(pcbench.read_scene(photographs, cameras="none"))


def test_cameras_select_the_view(tmp_path):
    """A picture with cameras is that of the upright cloud, in whatever frame both are."""
    folder = ten_images_folder(tmp_path)
    rig = [replace(camera, name=name) for camera, name in zip(sector(-130, -50, 10), NAMES, strict=True)]
    points = shapes.city(4000, seed=1)[0]
    turn = random_rotation(8)
    write_colmap_model(folder / "sparse/0", rotated(rig, turn))
    colors = np.where(points[:, 2:] > 1, 200, 90).astype(np.uint8) * np.ones(3, np.uint8)
    plotter = pcbench.plot.cloud(Cloud(points @ turn.T, colors=colors), scene=folder, off_screen=True)
    up = turn.T @ np.array(plotter.camera.up)
    np.testing.assert_allclose(up, [0, 0, 1], atol=1e-6)
    toward = turn.T @ (np.array(plotter.camera.position) - np.array(plotter.camera.focal_point))
    assert toward[2] > 0 > toward[1]  # from above, and from the side of the cameras
    assert background_share(render(plotter)) < 0.95
    values = pcbench.plot.deviation(None, points @ turn.T, points[:, 2], scene=folder, off_screen=True)
    np.testing.assert_allclose(turn.T @ np.array(values.camera.up), [0, 0, 1], atol=1e-6)
    values.close()
    found = pcbench.compare(points @ turn.T, {"a": (points @ turn.T)[::2]}, scene=folder, register="none")
    plotter = found.plot("a", "distance", off_screen=True)
    np.testing.assert_allclose(turn.T @ np.array(plotter.camera.up), [0, 0, 1], atol=1e-6)
    plotter.close()
    raised = np.tile(0.02 * turn[:, 2], (3, 1))
    plotter = pcbench.plot.displacements(points @ turn.T, points[:3] @ turn.T, raised, scene=folder, off_screen=True)
    np.testing.assert_allclose(plotter.actors["arrows"].mapper.dataset["values"], 0.02, rtol=1e-6)  # upwards
    plotter.close()


def test_displacements_are_exaggerated_by_a_round_factor():
    places = np.array([[0.0, 0, 0], [100, 0, 0], [0, 100, 0]])
    vectors = np.array([[0, 0, 0.02], [0, 0, -0.01], [0, 0, 0]])
    plotter = pcbench.plot.displacements(places, places, vectors, unit="m", off_screen=True)
    low, high = plotter.actors["arrows"].mapper.dataset.bounds[4:]
    factor = high / 0.02
    assert np.isclose(factor, 500) and np.isclose(low, -0.01 * factor)  # a tenth of the diagonal is 700 times 0.0195
    check_text(plotter.actors["title"].input)
    plotter.close()
    with check_error():
        pcbench.plot.displacements(places, places, 0 * vectors, off_screen=True)
    with check_error():
        pcbench.plot.displacements(places, places, vectors[:2], off_screen=True)
    with check_error():
        pcbench.plot.displacements(places, places, vectors, exaggeration=-1, off_screen=True)


def test_a_comparison_plots_with_the_ranges_of_its_pictures(comparison):
    """Candidates of similar distances share a range."""
    highest = [np.percentile(np.abs(c.deviation.scalars["plane_distance"]), 95) for c in comparison]
    plotter = comparison.plot("a", off_screen=True)
    expected = max(highest) if max(highest) <= 5 * min(highest) else highest[0]
    assert np.allclose(plotter.actors["values"].mapper.scalar_range, (-expected, expected))
    assert {"values", "ghost", "title"} <= plotter.actors.keys()
    check_text(plotter.actors["title"].input)
    plotter.close()
    plotter = comparison.plot("a", "completeness", range=0.5, off_screen=True)
    assert plotter.actors["values"].mapper.scalar_range == (0.0, 0.5)
    assert plotter.actors["values"].mapper.dataset.n_points == len(comparison["a"].completeness.points)
    check_text(plotter.actors["title"].input)
    plotter.close()


def test_invalid_arguments_are_refused(comparison):
    points = np.eye(3)
    with pytest.raises(KeyError):
        comparison.plot("z")
    for call in (
        lambda: comparison.plot("a", "height"),
        lambda: comparison.plot("a", "deformation"),
        lambda: pcbench.plot.deviation(None, points, [1.0, 2.0]),
        lambda: pcbench.plot.deviation(None, points, [np.nan] * 3),
        lambda: pcbench.plot.deviation(None, points, "distance"),
        lambda: pcbench.plot.deviation(None, points, [1.0, 2.0, 3.0], range=0.0),
        lambda: pcbench.plot.cloud(points, background="mauve"),
    ):
        with check_error(InputError):
            call()


def test_a_missing_pyvista_names_the_extra(monkeypatch, tmp_path):
    break_library(monkeypatch, tmp_path, "pyvista", None)
    with check_error(MissingExtra):
        pcbench.plot.cloud(np.eye(3))


def test_missing_opengl_is_an_error_before_vtk_crashes(monkeypatch):
    monkeypatch.setattr("pcbench.opengl._LIBRARIES", ("libNoSuchThing.so",))
    monkeypatch.delenv("DISPLAY", raising=False)
    with check_error(NoFiguresError):
        pcbench.plot.cloud(np.eye(3), off_screen=True)
