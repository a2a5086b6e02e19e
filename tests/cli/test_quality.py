"""`pcbench quality`: the answer, the folder, two clouds, and errors."""

import json

import numpy as np
import pytest
from command_line import is_one_line
from optional import import_or_skip
from quality_clouds import floor, wall
from wording import check_text

from pcbench import Cloud, write_cloud
from pcbench.io.geotiff import read_geotiff
from pcbench.studies.quality.charts import PICTURES

ORIGIN = np.array([4e5, 5.6e6, 100.0])


@pytest.fixture
def room(tmp_path, monkeypatch):
    """Write room.ply, with a double wall 0.1 m apart, and noisy.ply without one, in the current folder."""
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(0)
    doubled = np.vstack([floor(rng, 3000, 5, 0.008), wall(rng, 4000, 5, 3, 0.008, 0.1)])
    write_cloud("room.ply", Cloud(doubled, unit="m"))
    write_cloud("noisy.ply", Cloud(np.vstack([floor(rng, 3000, 5, 0.02), wall(rng, 4000, 5, 3, 0.02)]), unit="m"))
    return tmp_path


@pytest.fixture
def survey(tmp_path, monkeypatch):
    """Write survey.laz, two strips 0.06 m apart with a gap, in the current folder."""
    import_or_skip("lazrs")
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(1)
    points = floor(rng, 8000, 90, 0.03)
    points = points[np.hypot(*(points[:, :2] - 45).T) > 9]
    strip = rng.integers(1, 3, len(points))
    points[:, 2] += 0.06 * (strip == 2)
    attributes = {"point_source_id": strip.astype(np.uint16), "classification": np.full(len(points), 2, np.uint8)}
    write_cloud("survey.laz", Cloud(points + ORIGIN, attributes=attributes, crs="EPSG:32632"))
    return tmp_path


def test_the_answer_names_noise_double_walls_and_the_json_its_numbers(room, run):
    code, out, _ = run("quality", "room.ply", "--json", "numbers.json")
    assert code == 0
    check_text(out)
    values = json.loads((room / "numbers.json").read_text())
    assert values["schema"] == "pcbench.quality/1" and values["numbers"]["double_wall_count"]["value"] == 1
    separation = values["numbers"]["double_wall_separation"]
    assert separation["low"] < separation["value"] < separation["high"] and separation["unit"] == "m"
    assert separation["value"] == pytest.approx(0.1, rel=0.1)  # the accuracy that the documentation states


def test_a_survey_has_strips_voids_maps_and_a_page(survey, run):
    import_or_skip("pyproj")
    code, out, _ = run("quality", "survey.laz", "--out", "out", "--no-figures")
    assert code == 0
    check_text(out)
    folder = survey / "out"
    values = json.loads((folder / "quality.json").read_text())
    assert values["numbers"]["strip_dz"]["value"] == pytest.approx(0.06, rel=0.1)  # likewise
    assert values["numbers"]["void_area"]["value"] == pytest.approx(np.pi * 81, rel=0.1)
    raster = read_geotiff(folder / "maps" / "survey_voids.tif")
    assert raster.bands["voids"].sum() * raster.pixel**2 == pytest.approx(values["numbers"]["void_area"]["value"])
    check_text((folder / "quality.md").read_text())
    page = (folder / "report.html").read_text()
    assert "Quality of survey" in page and "http" not in page.split("<main")[-1].split("EPSG")[0]
    code, _, _ = run("quality", "survey.laz", "--out", "out", "--no-figures")  # the folder is its own
    assert code == 0


def test_two_clouds_stand_side_by_side(room, run):
    code, out, _ = run("quality", "room.ply", "noisy.ply", "--json", "both.json")
    assert code == 0
    check_text(out)
    values = json.loads((room / "both.json").read_text())
    assert values["better"]["noise"] == 1 and values["better"]["double_wall_count"] == 2
    assert values["settings"]["radius"] > 0  # one for both


def test_pictures_are_drawn_again_by_plot(room, run):
    import_or_skip("matplotlib")
    assert run("quality", "room.ply", "--out", "out", "-q")[0] == 0
    assert PICTURES.fits(room / "out")
    assert sorted(path.name for path in (room / "out" / "figures").iterdir()) == [
        "density_room.png",
        "thickness_room.png",
    ]
    code, out, _ = run("plot", "out", "--format", "svg")
    assert code == 0 and "density_room.svg" in out


def test_unusable_clouds_and_folders_are_refused_in_one_line(room, run):
    write_cloud("degrees.ply", Cloud(np.random.default_rng(0).uniform(7, 8, (100, 3)), crs="EPSG:4326"))
    facet = "facet normal 0 0 1 outer loop vertex 0 0 0 vertex 1 0 0 vertex 0 1 0 endloop endfacet"
    (room / "mesh.stl").write_text(f"solid made {facet} endsolid made")
    (room / "other").mkdir()
    (room / "other" / "notes.txt").write_text("keep")
    for arguments in (
        ["degrees.ply"],
        ["mesh.stl"],
        ["absent.ply"],
        ["room.ply", "--strips", "swath"],
        ["room.ply", "--memory", "1MB"],
        ["room.ply", "--out", "other"],
        ["room.ply", "--json", "room.ply"],
        ["room.ply", "--radius", "0"],
    ):
        code, _, err = run("quality", *arguments)
        assert code == 2 and is_one_line(err)
        check_text(err)
    assert [path.name for path in (room / "other").iterdir()] == ["notes.txt"]


@pytest.mark.parametrize("points", [np.zeros((1, 3)), np.ones((30, 3)), np.outer(np.arange(30.0), [1, 0, 0])])
def test_small_clouds_have_an_answer(points, tmp_path, monkeypatch, run):
    monkeypatch.chdir(tmp_path)
    write_cloud("small.ply", Cloud(points))
    code, out, err = run("quality", "small.ply", "--out", "out", "--no-figures")
    assert code == 0 and not err
    assert out.startswith("The noise of small is unknown")


def test_conditions_of_two_clouds(room, run):
    code, _, err = run("quality", "room.ply", "noisy.ply", "-q", "--fail-if", "noise.value > 0.015 or points < 0")
    assert code == 3 and err.count("noisy: noise.value = ") == 1 and "room: " not in err
    code, out, err = run("quality", "room.ply", "--fail-if", "nois > 1")
    assert (code, out, is_one_line(err)) == (2, "", True)
