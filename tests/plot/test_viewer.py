"""The viewer of a report without its window: candidates, maps, colour range, and values of a point."""

import re
import shutil

import numpy as np
import pytest
import shapes
from optional import import_or_skip
from wording import check_error, check_text

import pcbench
from pcbench import Cloud
from pcbench.report.colors import DIVERGING
from pcbench.report.plotters.viewer import ReportViewer, describe_point

import_or_skip("pyvista")
pytestmark = pytest.mark.usefixtures("off_screen")


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    """A report in large coordinates."""
    folder = tmp_path_factory.mktemp("view") / "report"
    rng, utm = np.random.default_rng(0), [500_000.0, 5_400_000.0, 100.0]
    reference = Cloud(shapes.city(3000, seed=1)[0] + utm, unit="m")
    points = shapes.city(1000, seed=2)[0] + utm
    noise = rng.normal(0, 0.02, points.shape)
    candidates = {"a": Cloud(points + noise), "b": Cloud((points - noise)[:600])}
    pcbench.compare(reference, candidates).save(folder, figures=False)
    return folder


@pytest.fixture
def viewer(report):
    viewer = ReportViewer(report, print, off_screen=True)
    yield viewer
    viewer.plotter.close()


@pytest.fixture(scope="module")
def bent_report(tmp_path_factory):
    """A report with a candidate without a deformation, `a`, and one that is bent into a bowl."""
    folder = tmp_path_factory.mktemp("bent") / "report"
    points = shapes.city(4000, seed=2)[0]
    bowl = np.stack([*(0 * points[:, :2]).T, 1e-3 * (points[:, :2] ** 2).sum(axis=1)], axis=1)
    reference = Cloud(shapes.city(8000, seed=1)[0], unit="m")
    pcbench.compare(reference, {"a": Cloud(points), "bent": Cloud(points + bowl)}).save(folder, figures=False)
    return folder


def dataset(viewer):
    return viewer.plotter.actors["values"].mapper.dataset


def test_keys_go_through_candidates_and_maps(viewer):
    titles = []
    for action in (lambda: None, viewer.next_candidate, viewer.next_map, viewer.next_map, viewer.next_candidate):
        action()
        titles.append((viewer.name, viewer.scalar, dataset(viewer).n_points))
        check_text(viewer.plotter.actors["title"].input)
        assert len(viewer.plotter.scalar_bars) == 1
    assert titles == [
        ("a", "plane_distance", 1000),
        ("b", "plane_distance", 600),
        ("b", "completeness", 3000),
        ("b", "distance", 600),
        ("a", "distance", 1000),
    ]


def test_the_range_changes_the_colours(viewer):
    """A range much smaller than the values shows only its first and last colour."""

    def shares():
        picture = np.asarray(viewer.plotter.screenshot(return_img=True))[80:600, :, :3].astype(int)
        return [(np.abs(picture - color).max(axis=2) <= 2).mean() for color in (DIVERGING[0], DIVERGING[-1])]

    before = shares()
    viewer.set_range(1e-6)
    assert all(new > 3 * old for new, old in zip(shares(), before, strict=True))


def test_displacements_are_those_of_the_files(bent_report):
    """The key D shows arrows instead of the map; their length is that of the file times the factor in the title."""
    said = []
    viewer = ReportViewer(bent_report, said.append, off_screen=True)
    viewer.switch_displacements()
    assert (viewer.shows_displacements, len(said)) == (False, 1)
    check_text(said[0])
    viewer.next_candidate()
    viewer.switch_displacements()
    assert "values" not in viewer.plotter.actors
    field = pcbench.read_cloud(bent_report / "bent_deformation.ply")
    vectors = np.stack([field.attributes[f"displacement_{k}"] for k in "xyz"], axis=1)
    lengths = np.linalg.norm(vectors, axis=1)
    title = viewer.plotter.actors["title"].input
    check_text(re.sub(r"[0-9.]+", "#", title))
    factor = float(re.search(r"exaggerated ([0-9.]+) times", title)[1])
    assert f"95 % below {np.percentile(lengths[lengths > 0], 95):.3g} m, largest {lengths.max():.3g} m" in title
    assert len(viewer.plotter.scalar_bars) == 1

    def longest():
        data = viewer.plotter.actors["arrows"].mapper.dataset
        return np.ptp(data.points[:, 2].reshape(len(lengths), -1), axis=1).max()

    first = longest()
    assert np.isclose(first, factor * np.abs(vectors[:, 2]).max(), rtol=0.2)  # and the width of the arrow's head
    viewer.set_exaggeration(2 * factor)
    assert np.isclose(longest(), 2 * first)
    assert f"exaggerated {2 * factor:g} times" in viewer.plotter.actors["title"].input
    viewer.switch_displacements()
    assert "arrows" not in viewer.plotter.actors and dataset(viewer).n_points == 4000
    viewer.switch_displacements()
    viewer.next_map()
    assert "arrows" not in viewer.plotter.actors and not viewer.shows_displacements
    viewer.switch_displacements()
    viewer.next_candidate()  # which has no displacements
    assert "arrows" not in viewer.plotter.actors and viewer.name == "a"
    viewer.plotter.close()


def test_the_lighting_can_be_switched(viewer):
    pictures = []
    for _ in range(3):
        pictures.append(np.asarray(viewer.plotter.screenshot(return_img=True))[80:600, :, :3].astype(int))
        viewer.switch_lighting()
    assert pictures[0].sum() < pictures[1].sum()
    assert (pictures[0] != pictures[2]).mean() < 0.001


def test_values_of_a_point_are_those_of_the_files(report, viewer):
    """The neighbours are found by brute force."""
    cloud = pcbench.read_cloud(report / "a_deviation.ply")
    row = 123
    nearest = np.argsort(np.linalg.norm(cloud.points - cloud.points[row], axis=1), kind="stable")[:50]
    values = np.asarray(cloud.attributes["plane_distance"], float)
    place, value, neighbors = check_text(viewer.describe(row)).splitlines()
    assert place.endswith("point at " + ", ".join(f"{x:.4f}" for x in cloud.points[row]) + " m")
    assert value.endswith(f" {values[row]:.4g} m")
    assert f"mean {values[nearest].mean():.4g}, std {values[nearest].std():.3g} m" in neighbors
    radius = np.linalg.norm(cloud.points[nearest[-1]] - cloud.points[row])
    assert f"50 closest points, within {radius:.3g} m" in neighbors


def test_a_damaged_map_is_one_line(report, tmp_path):
    copy = tmp_path / "report"
    shutil.copytree(report, copy)
    pcbench.write_cloud(copy / "a_completeness.ply", np.eye(3))
    with check_error():
        ReportViewer(copy, print, off_screen=True)


def test_a_point_of_a_file_has_its_attributes():
    points = np.array([[500_000.125, 0, 0], [500_001, 1, 1]])
    cloud = Cloud(points, attributes={"intensity": np.array([7, 8], np.uint16)}, unit="m")
    text = check_text(describe_point(cloud, 0))
    assert "500000.125000, 0.000000, 0.000000 m" in text
    assert "intensity: 7" in text
