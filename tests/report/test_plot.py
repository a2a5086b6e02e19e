"""Pictures drawn from a report folder: content, common frame and colours, and one-line errors."""

import json
import re
import shutil
import sys
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import shapes
from children_here import drawing_here
from optional import break_library, import_or_skip
from wording import check_error, check_text

from pcbench import Cloud, Settings, read_cloud, write_cloud
from pcbench.deformation import Deformation
from pcbench.errors import MissingExtra, PcbenchError
from pcbench.opengl import NoFiguresError
from pcbench.report import Figures, plot
from pcbench.report.plot import bends, draw, worker
from pcbench.report.plot.maps import Framing, frame
from pcbench.report.plot.pictures import pictures

pytestmark = pytest.mark.usefixtures("coarse_pictures")

# The others are compared with golden ones in test_golden_pictures.py.
PICTURES = ("distribution", "b_distance", "b_m3c2_distance")


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    """A report of two candidates, without pictures yet."""
    from pcbench import cli

    folder = tmp_path_factory.mktemp("plot")
    rng = np.random.default_rng(0)
    reference = shapes.city(6000, seed=1)[0]
    write_cloud(folder / "ref.ply", Cloud(reference, unit="m"))
    for name, noise in (("a", 0.02), ("b", 0.1)):
        points = shapes.city(2000, seed=2)[0]
        write_cloud(folder / f"{name}.ply", Cloud(points + rng.normal(0, noise, points.shape)))
    files = [str(folder / f"{name}.ply") for name in ("ref", "a", "b")]
    arguments = ["compare", *files, "--out", str(folder / "report"), "--no-figures", "--map", "m3c2", "-q"]
    cli.app(arguments, standalone_mode=False)
    return folder / "report"


@pytest.fixture(scope="module")
def figures(report):
    import_or_skip("matplotlib")
    with drawing_here():
        return {path.stem: path for path in draw(report, PICTURES)}


def test_every_picture_exists_and_is_not_empty(figures):
    from matplotlib.image import imread

    assert figures.keys() == set(PICTURES)
    for name, path in figures.items():
        image = imread(path)[..., :3]
        assert image.shape[0] >= 350
        assert 1000 < image.shape[1] < 2200
        background = np.median(image.reshape(-1, 3), axis=0)
        foreground = (np.abs(image - background) > 0.05).any(axis=2)
        # No picture is empty, and each view shows something.
        assert 0.02 < foreground.mean() < 0.9, name
        if name != "distribution":
            for panel in np.array_split(foreground[:, : int(0.9 * foreground.shape[1])], 3, axis=1):
                assert panel.mean() > 0.02, name


def test_one_picture_is_redrawn(figures, report):
    figures["b_distance"].unlink()
    with drawing_here():
        assert draw(report, ("b_distance",)) == [report / "figures/b_distance.png"]
        assert figures["b_distance"].is_file()
        with check_error():
            draw(report, ("z",))


def test_the_reference_may_be_missing(figures, report, tmp_path):
    copy = tmp_path / "copy"
    shutil.copytree(report, copy)
    shutil.rmtree(copy / "figures")
    settings = json.loads((copy / "settings.json").read_text())
    settings["reference"]["path"] = "/nowhere/ref.ply"
    (copy / "settings.json").write_text(json.dumps(settings))
    with drawing_here():
        with check_error():
            draw(copy, ("reference",))
        assert draw(copy, ("distribution",)) == [copy / "figures/distribution.png"]


@pytest.mark.with_deformation
def test_candidates_with_colours_are_drawn_in_them(tmp_path):
    import_or_skip("matplotlib")
    from matplotlib.image import imread

    from pcbench import compare

    points = shapes.city(4000, seed=4)[0]
    green = np.tile(np.array([[20, 200, 40]], np.uint8), (len(points), 1))
    write_cloud(tmp_path / "ref.ply", Cloud(points))
    write_cloud(tmp_path / "green.ply", Cloud(points + [0.05, 0, 0], colors=green))
    compare(tmp_path / "ref.ply", tmp_path / "green.ply").save(tmp_path / "report", figures=False)
    (path,) = draw_in_process(tmp_path / "report", "green_colors")
    image = np.rint(255 * imread(path)[..., :3])
    assert (image == [20, 200, 40]).all(axis=2).mean() > 0.02
    with check_error(PcbenchError):
        draw_in_process(tmp_path / "report", "ref_colors")


@pytest.mark.parametrize(
    "points",
    [
        pytest.param(np.full((300, 3), 2.0), id="point", marks=pytest.mark.long),
        pytest.param(np.outer(np.arange(300.0), [1, 0, 0]), id="line"),
    ],
)
def test_points_without_extent_are_drawn(points, tmp_path):
    import_or_skip("matplotlib")
    from pcbench import compare

    compare(points, {"same": points}, Settings(register="none")).save(tmp_path / "report", figures=False)
    assert "same_distance" in {path.stem for path in draw_in_process(tmp_path / "report")}


def test_names_that_are_no_text_are_drawn(tmp_path):
    import_or_skip("matplotlib")
    from pcbench import compare

    points = shapes.city(2000, seed=5)[0]
    found = compare(points, {"\udcff\udcfe": points + [0, 0, 0.1]}, Settings(register="none"))
    found.save(tmp_path / "report", figures=False)
    names = [name for name in pictures(tmp_path / "report", Figures()) if name.endswith(("_distance", "distribution"))]
    assert len(draw_in_process(tmp_path / "report", *names)) == len(names) == 3


def test_a_display_is_not_needed(monkeypatch, report):
    monkeypatch.setattr("pcbench.opengl._LIBRARIES", ("libNoSuchThing.so",))
    monkeypatch.delenv("DISPLAY", raising=False)
    assert draw(report, ("a_distance",)) == [report / "figures/a_distance.png"]


def test_missing_matplotlib_names_the_extra(monkeypatch, report, tmp_path):
    break_library(monkeypatch, tmp_path, "matplotlib", None)
    with check_error(MissingExtra):
        draw(report)


def test_a_crash_while_drawing_is_one_line(monkeypatch, report):
    monkeypatch.setattr(sys, "executable", shutil.which("false"))
    with check_error(NoFiguresError):
        draw(report)


def test_a_folder_without_a_report_is_refused():
    with check_error():
        draw(Path("/"))


def draw_in_process(folder, *names, **options):
    """Draw in this process, because a child process takes seconds to start."""
    import_or_skip("matplotlib")
    return [folder / path for path in worker.draw(folder, plot.REPORT.function, Figures(**options), names)]


def text_labels(svg):
    """Return the texts of a drawing that are not numbers, sorted, each once."""
    texts = {"".join(text.itertext()).strip() for text in svg.iter("{http://www.w3.org/2000/svg}text")}
    return "\n".join(sorted(text for text in texts if re.search("[a-z]{2}", text)))


def test_formats_by_name_and_by_setting(report):
    svg, pdf = draw_in_process(report, "distribution.svg", "a_completeness.pdf")
    assert (svg.name, pdf.name) == ("distribution.svg", "a_completeness.pdf")
    root = ElementTree.parse(svg).getroot()
    assert root.tag.endswith("svg")
    check_text(text_labels(root))
    content = pdf.read_bytes()
    assert content.startswith(b"%PDF-")
    assert content.rstrip().endswith(b"%%EOF")
    assert b"/Image" in content  # the cloud stays an image
    first_bytes = svg.read_bytes()
    (redrawn,) = draw_in_process(report, "distribution", format="svg")
    assert redrawn.read_bytes() == first_bytes  # independent of time and random numbers
    with check_error(PcbenchError):
        draw_in_process(report, "distribution.gif")


def test_maps_and_charts_have_the_chosen_background(report):
    from matplotlib.image import imread

    for path in draw_in_process(report, "a_distance", "distribution", "a_deformation", background="#203040"):
        corner = np.rint(255 * imread(path)[2, 2, :3])
        assert corner.tolist() == [0x20, 0x30, 0x40], path


def test_a_map_states_its_unit_scale_and_colour_range(report):
    (path,) = draw_in_process(report, "b_completeness", format="svg")
    root = ElementTree.parse(path).getroot()
    assert sum(word.strip() in ("10 m", "20 m", "50 m") for word in root.itertext()) == 3  # one scale bar per view
    assert "6,000 points" in check_text(text_labels(root))
    (path,) = draw_in_process(report, "b_completeness", format="svg", range=0.123)
    check_text(text_labels(ElementTree.parse(path).getroot()))


def test_the_completeness_map_holds_the_reference_and_its_distances(report):
    """Compare with brute force: the points are the reference's, the scalar is their distance to the candidate."""
    from scipy.spatial import KDTree

    reference = read_cloud(report.parent / "ref.ply")
    completeness_map = read_cloud(report / "a_completeness.ply")
    aligned_cloud = read_cloud(report / "a_deviation.ply")
    np.testing.assert_array_equal(completeness_map.points, reference.points)
    expected = KDTree(aligned_cloud.points).query(reference.points)[0]
    np.testing.assert_allclose(completeness_map.attributes["distance"], expected, rtol=1e-5, atol=1e-6)
    assert completeness_map.unit == "m"
    # Larger distances have lighter colours.
    luma = np.asarray(completeness_map.colors) @ [0.2126, 0.7152, 0.0722]
    is_far = expected > np.percentile(expected, 90)
    assert luma[is_far].min() > luma[expected < np.percentile(expected, 10)].max()


def test_a_report_without_the_completeness_map_is_drawn_too(report, tmp_path):
    copy = tmp_path / "copy"
    shutil.copytree(report, copy)
    for path in copy.glob("*_completeness.ply"):
        path.unlink()
    assert draw_in_process(copy, "a_distance") == [copy / "figures/a_distance.png"]
    with check_error(PcbenchError):
        draw_in_process(copy, "a_completeness")


def test_a_cloud_against_itself_has_no_empty_panel(tmp_path):
    import_or_skip("matplotlib")
    from matplotlib.image import imread

    from pcbench import compare

    points = shapes.city(2000, seed=3)[0]
    compare(points, {"same": points}, Settings(register="none")).save(tmp_path / "report", figures=False)
    paths = {path.stem: path for path in draw_in_process(tmp_path / "report")}
    assert "distribution" not in paths  # all distances are zero
    assert not any(name.endswith("_section") for name in paths)
    with check_error(PcbenchError):
        draw_in_process(tmp_path / "report", "distribution")
    image = imread(paths["same_distance"])[..., :3]
    assert (np.abs(image - image[2, 2]) > 0.05).any(axis=2).mean() > 0.05


def framing(background=None):
    """Return the framing of a picture of a unit square."""
    corners = Cloud(np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]]))
    return Framing(frame(None, {"a": corners}), "m", Figures(background))


def test_evidence_has_panels_for_available_data_only(report, tmp_path):
    """Unknown growth of errors, and tiles with too few pairs, leave no empty axes."""
    import_or_skip("matplotlib")
    from matplotlib.image import imread

    def drawn_size(document):
        field = Cloud(np.zeros((3, 3)), attributes={name: np.full(3, 100.0) for name in ("pairs", "local", "changed")})
        path = tmp_path / "deformation.png"
        is_drawn = bends.evidence(Deformation.from_json(document), field, "title", framing(), path)
        return imread(path).shape[:2] if is_drawn else None

    document = json.loads((report / "comparison.json").read_text())["candidates"][0]["deformation"]
    size_of_four = drawn_size(document)
    size_of_two = drawn_size({**document, "growth": None})
    size_of_one = drawn_size({**document, "growth": None, "rungs": []})
    assert size_of_two[1] == pytest.approx(size_of_four[1], rel=0.01)
    assert size_of_two[0] < 0.6 * size_of_four[0]
    assert size_of_one[1] == pytest.approx(0.5 * size_of_two[1], rel=0.01)


@pytest.mark.parametrize("background", [None, "black", "#888888"])
def test_changed_tiles_are_visible_on_any_background(report, tmp_path, background):
    """All tested tiles are drawn, however few pairs they have; those with large residuals stand out most."""
    import_or_skip("matplotlib")
    from matplotlib.image import imread

    document = json.loads((report / "comparison.json").read_text())["candidates"][0]["deformation"]
    document = {**document, "growth": None, "rungs": []}

    def draw_tiles(residuals):
        attributes = {"pairs": np.full(3, 2), "local": np.array(residuals), "changed": np.zeros(3)}
        field = Cloud(np.array([[0.0, 0, 0], [10, 10, 0], [5, 5, 0]]), attributes=attributes)
        path = tmp_path / "deformation.png"
        is_drawn = bends.evidence(Deformation.from_json(document), field, "title", framing(background), path)
        return imread(path)[..., :3] if is_drawn else None

    partial_image, untested_image = draw_tiles([0.5, 1.0, 0.6]), draw_tiles([0.5, 1.0, np.nan])
    contrast = np.abs(partial_image - partial_image[2, 2]).max(axis=2)
    # The third tile is tested in one image only.
    assert ((np.abs(partial_image - untested_image).max(axis=2) > 0.2) & (contrast > 0.2)).sum() > 50
    faint_image = draw_tiles([0.0, 1.0, np.nan])
    assert (
        (np.abs(faint_image - untested_image).max(axis=2) > 0.1)
        & (np.abs(faint_image - faint_image[2, 2]).max(axis=2) > 0.03)
    ).sum() > 50
    assert draw_tiles([np.nan] * 3) is None


def test_displacements_are_visible_from_all_sides(tmp_path):
    """From above, vertical arrows have no length; colours show rise and fall."""
    import_or_skip("matplotlib")
    from matplotlib.image import imread

    rng = np.random.default_rng(0)
    positions = rng.uniform(-10, 10, (200, 3)) * [1, 1, 0.1]
    rise = np.where(positions[:, 0] > 0, 0.1, -0.1)
    columns = {"displacement_x": 0 * rise, "displacement_y": 0 * rise, "displacement_z": rise}
    cloud, field = Cloud(rng.uniform(-10, 10, (5000, 3)) * [1, 1, 0.1]), Cloud(positions, attributes=columns)
    path = tmp_path / "displacement.png"
    cloud_framing = Framing(frame(None, {"a": cloud}), "m", Figures())
    assert bends.arrows(cloud, field, "title", cloud_framing, path)
    image = imread(path)[..., :3]
    red, blue = image[..., 0] - image[..., 2] > 0.3, image[..., 2] - image[..., 0] > 0.3
    top_view = slice(0, image.shape[1] // 4)
    assert red[:, top_view].sum() > 500
    assert blue[:, top_view].sum() > 500
    # Red is where the surface rises.
    assert np.nonzero(red[:, top_view])[1].mean() > np.nonzero(blue[:, top_view])[1].mean()
    zero_field = Cloud(positions, attributes=dict.fromkeys(columns, 0 * rise))
    assert not bends.arrows(cloud, zero_field, "title", cloud_framing, path)
