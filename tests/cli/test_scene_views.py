"""`--scene` of compare, plot and view: recorded, repeated, redrawn without the scene, and refused in one line."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import shapes
from camera_rigs import random_rotation, rotated, walk
from children_here import drawing_here
from command_line import is_one_line
from optional import import_or_skip
from scene_folders import picture
from wording import check_text

import pcbench
from pcbench import Cloud, write_cloud
from pcbench.geometry.transform import Similarity
from pcbench.io.colmap_model import write_colmap_model
from pcbench.report.viewing import ViewingCameras

TURN = random_rotation(8)


@pytest.fixture
def facade(tmp_path, monkeypatch):
    """Write a facade as wall.ply and shifted.ply in a turned frame, and photos/ with cameras in that frame."""
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(0)
    wall = np.column_stack([rng.uniform(-10, 10, 1500), np.zeros(1500), rng.uniform(-2, 8, 1500)])
    bay = np.column_stack([rng.uniform(1, 5, 750), np.full(750, -2.0), rng.uniform(-2, 3, 750)])
    floor = np.column_stack([rng.uniform(-10, 10, 750), rng.uniform(-5, 0, 750), np.full(750, -2.0)])
    points = np.concatenate([wall, bay, floor]) @ TURN.T
    write_cloud("wall.ply", Cloud(points))
    write_cloud("shifted.ply", Cloud(points[::2] + rng.normal(0, 0.02, points[::2].shape) + [0.02, 0.03, 0]))
    cameras = rotated(walk(), TURN)
    for camera in cameras:
        picture(Path("photos/images") / camera.name, (64, 48))
    write_colmap_model(Path("photos/sparse"), cameras)
    write_colmap_model(Path("elsewhere"), cameras)
    return tmp_path


def up_of(folder):
    return np.array(json.loads(Path(folder, "cameras.json").read_text())["up"])


def test_the_cameras_are_recorded_listed_and_repeated(facade, run):
    assert run("compare", "wall.ply", "shifted.ply", "--scene", "photos", "--out", "one", "--no-figures", "-q")[0] == 0
    np.testing.assert_allclose(up_of("one"), TURN @ [0, 0, 1], atol=1e-6)
    assert "cameras.json" in json.loads(Path("one/manifest.json").read_text())["files"]
    scene = json.loads(Path("one/settings.json").read_text())["scene"]
    assert scene == {"path": str(facade / "photos"), "cameras": "auto"}
    assert run("compare", "--settings", "one/settings.json", "--out", "two", "--no-figures", "-q")[0] == 0
    assert Path("two/cameras.json").read_bytes() == Path("one/cameras.json").read_bytes()
    # With other cameras, which are recorded too.
    again = ("--settings", "one/settings.json", "--scene", "photos", "--cameras", "elsewhere")
    assert run("compare", *again, "--out", "three", "--no-figures", "-q")[0] == 0
    scene = json.loads(Path("three/settings.json").read_text())["scene"]
    assert scene == {"path": str(facade / "photos"), "cameras": str(facade / "elsewhere")}
    # A new report without a scene leaves no cameras.
    assert run("compare", "wall.ply", "shifted.ply", "--out", "one", "--no-figures", "-q")[0] == 0
    assert not Path("one/cameras.json").exists()
    assert "scene" not in json.loads(Path("one/settings.json").read_text())


def test_a_comparison_is_repeated_with_the_recorded_cameras_if_the_scene_is_gone(facade, run):
    assert run("compare", "wall.ply", "shifted.ply", "--scene", "photos", "--out", "one", "--no-figures", "-q")[0] == 0
    Path("photos").rename("moved")
    code, _, err = run("compare", "--settings", "one/settings.json", "--out", "two", "--no-figures")
    assert code == 0
    assert Path("two/cameras.json").read_bytes() == Path("one/cameras.json").read_bytes()
    warnings = json.loads(Path("two/comparison.json").read_text())["reference"]["warnings"]
    assert "the scene no longer exists" in check_text("\n".join(warnings))
    assert "scene" not in json.loads(Path("two/settings.json").read_text())
    Path("one/cameras.json").unlink()
    code, _, err = run("compare", "--settings", "one/settings.json", "--out", "three")
    assert code == 2 and "photos" in err


def test_changed_cameras_are_noticed_when_a_comparison_is_repeated(facade, run):
    assert run("compare", "wall.ply", "shifted.ply", "--scene", "photos", "--out", "one", "--no-figures", "-q")[0] == 0
    settings = json.loads(Path("one/settings.json").read_text())
    settings["scene"]["cameras"] = str(facade / "fewer")
    Path("one/settings.json").write_text(json.dumps(settings))
    write_colmap_model(Path("fewer"), rotated(walk(), TURN)[1:])

    def warnings(*options):
        code, out, _ = run("compare", "--settings", "one/settings.json", "--json", "-", *options)
        return code, "\n".join(json.loads(out)["reference"]["warnings"])

    code, text = warnings()
    assert code == 0 and "the cameras of the scene have changed" in check_text(text)
    code, text = warnings("--scene", "photos", "--cameras", "fewer")  # others on purpose
    assert code == 0 and "changed" not in text


def test_no_metric_depends_on_the_cameras(facade, run):
    for name, options in (("with", ("--scene", "photos")), ("without", ())):
        assert run("compare", "wall.ply", "shifted.ply", *options, "--out", name, "--no-figures", "-q")[0] == 0
    documents = [json.loads(Path(name, "comparison.json").read_text()) for name in ("with", "without")]
    for document in documents:
        del document["provenance"], document["candidates"][0]["timings_s"], document["candidates"][0]["peak_rss_bytes"]
    assert documents[0] == documents[1]


@pytest.mark.parametrize(
    "options",
    [
        (),
        ("--crop", "sphere:0,0,0,6"),
        pytest.param(("--register", "global", "--crop", "none"), marks=pytest.mark.long),
    ],
)
def test_the_cameras_stay_in_the_frame_of_the_reference(facade, run, options):
    """Registration moves the candidate, and a crop selects points: neither moves the cameras."""
    turned = pcbench.read_cloud("shifted.ply").transformed(Similarity(random_rotation(3), np.array([1.0, 2, 3])))
    candidate = "shifted.ply"
    if "global" in options:
        import_or_skip("kiss_matcher")
        write_cloud("turned.ply", turned)
        candidate = "turned.ply"
    code, _, err = run(
        "compare", "wall.ply", candidate, "--scene", "photos", *options, "--out", "one", "--no-figures", "-q"
    )
    assert code == 0, err
    cameras = ViewingCameras.read(Path("one/cameras.json"))
    expected = ViewingCameras.of(rotated(walk(), TURN))
    np.testing.assert_allclose(cameras.centers, expected.centers, atol=1e-9)
    np.testing.assert_allclose(cameras.directions, expected.directions, atol=1e-9)


def test_plot_redraws_a_report_without_its_scene(facade, run):
    import_or_skip("matplotlib")
    assert run("compare", "wall.ply", "shifted.ply", "--scene", "photos", "--out", "one", "--no-figures", "-q")[0] == 0
    shutil.rmtree("photos")
    with drawing_here():
        code, _, err = run("plot", "one", "reference.svg", "shifted_section.svg", "shifted_distance.svg")
    assert code == 0, err
    for name in ("reference", "shifted_distance"):
        text = Path(f"one/figures/{name}.svg").read_text()
        for title in ("front", "from the left", "from the right"):
            assert f">{title}<" in text
    assert "z = " in Path("one/figures/shifted_section.svg").read_text()
    Path("one/cameras.json").write_text('{"up": 1}')
    with drawing_here():
        code, out, err = run("plot", "one", "reference")
    assert (code, out, is_one_line(err)) == (2, "", True)
    check_text(err)


def test_compare_in_python_takes_a_scene_or_its_folder(facade):
    scene = pcbench.read_scene("photos", cameras="elsewhere")
    clouds = pcbench.read_cloud("wall.ply"), pcbench.read_cloud("shifted.ply")
    for given in (Path("photos"), scene):
        found = pcbench.compare(*clouds, scene=given)
        np.testing.assert_allclose(found.cameras.up, TURN @ [0, 0, 1], atol=1e-6)
    assert pcbench.compare(*clouds).cameras is None
    with pytest.raises(pcbench.PcbenchError, match="expected a scene"):
        pcbench.compare(*clouds, scene=3)
    utm = Cloud(clouds[0].points, crs="EPSG:32632")
    assert pcbench.compare(utm, clouds[1], scene=scene).cameras.up.tolist() == [0, 0, 1]


@pytest.mark.parametrize(
    "arguments",
    [
        ("compare", "wall.ply", "shifted.ply", "--cameras", "elsewhere"),
        ("compare", "wall.ply", "shifted.ply", "--scene", "nowhere"),
        ("compare", "wall.ply", "shifted.ply", "--scene", "photos", "--cameras", "none"),
        ("compare", "wall.ply", "shifted.ply", "--scene", "photos", "--cameras", "nowhere"),
        ("compare", "far.ply", "shifted.ply", "--scene", "photos"),
        ("plot", "far.ply", "--scene", "photos"),
        ("plot", "wall.ply", "--cameras", "elsewhere"),
    ],
)
def test_useless_scenes_are_refused_in_one_line(facade, run, arguments):
    write_cloud("far.ply", Cloud(pcbench.read_cloud("wall.ply").points + [5e6, 4e5, 0]))
    before = sorted(Path().iterdir())
    code, out, err = run(*arguments)
    assert (code, out, is_one_line(err)) == (2, "", True)
    check_text(err)
    assert sorted(Path().iterdir()) == before


def test_a_damaged_scene_in_settings_is_refused(facade, run):
    assert run("compare", "wall.ply", "shifted.ply", "--scene", "photos", "--out", "one", "--no-figures", "-q")[0] == 0
    settings = json.loads(Path("one/settings.json").read_text())
    for scene in (3, {"path": 3, "cameras": "auto"}, {"path": "photos"}):
        Path("changed.json").write_text(json.dumps(settings | {"scene": scene}))
        code, out, err = run("compare", "--settings", "changed.json")
        assert (code, out, is_one_line(err)) == (2, "", True)
        check_text(err)


def test_inputs_are_not_replaced(facade, run):
    code, _, err = run("compare", "wall.ply", "shifted.ply", "--scene", "photos", "--out", ".")
    assert (code, is_one_line(err)) == (2, True)
    code, _, err = run("plot", "wall.ply", "--scene", "photos", "--out", "photos/images/0.png")
    assert (code, is_one_line(err)) == (2, True)
    check_text(err)


@pytest.mark.long
def test_plot_draws_clouds_and_meshes(facade, run):
    import_or_skip("matplotlib")
    assert run("plot", "wall.ply", "--scene", "photos") == (0, "wall.png\n", "")
    assert run("plot", "wall.ply", "-q") == (0, "", "")  # its own picture is replaced
    assert run("plot", "wall.ply", "--format", "svg", "--background", "white") == (0, "wall.svg\n", "")
    assert ">from +x<" in Path("wall.svg").read_text()
    assert run("plot", "wall.ply", "--scene", "photos", "--out", "a.pdf")[0] == 0
    points = shapes.city(500, seed=3)[0]
    write_cloud("scan.las", Cloud(points, attributes={"intensity": np.arange(500, dtype=np.uint16)}))
    assert run("plot", "scan.las", "--scalar", "intensity", "--range", "400", "--out", "b.svg")[0] == 0
    assert ">intensity<" in Path("b.svg").read_text()
    Path("mesh.off").write_text("OFF\n4 4 0\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n3 0 2 1\n3 0 1 3\n3 1 2 3\n3 0 3 2\n")
    assert run("plot", "mesh.off") == (0, "mesh.png\n", "")
    write_colmap_model(Path("model"), walk(), Cloud(points))
    assert run("plot", "model") == (0, "model.png\n", "")


@pytest.mark.parametrize(
    "arguments",
    [
        ("wall.ply", "reference"),
        ("wall.ply", "--range", "2"),
        ("wall.ply", "--scalar", "height"),
        ("wall.ply", "--out", "wall.ply"),
        ("wall.ply", "--out", "photo.png"),
        ("wall.ply", "--out", "a.gif"),
        ("wall.ply", "--out", "nowhere/a.png"),
        ("wall.ply", "--out", "a.svg", "--format", "png"),
        ("wall.ply", "--format", "gif"),
        ("photo.ply",),  # photo.png is a photograph
        ("mesh.off", "--scalar", "height"),
        ("nowhere.ply",),
        ("nothing.ply",),
        ("text.docx",),
        ("empty",),
        ("report", "--out", "a.png"),
        ("report", "--scalar", "distance"),
        ("report", "--scene", "photos"),
    ],
)
def test_what_plot_cannot_draw_is_refused_in_one_line(facade, run, arguments):
    picture(Path("photo.png"))
    shutil.copy("wall.ply", "photo.ply")
    Path("mesh.off").write_text("OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 2 1\n")
    Path("nothing.ply").touch()
    Path("text.docx").touch()
    Path("empty").mkdir()
    Path("report").mkdir()
    Path("report/comparison.json").write_text("{}")
    before = {path: path.stat().st_mtime_ns for path in Path().iterdir()}
    code, out, err = run("plot", *arguments)
    assert (code, out, is_one_line(err)) == (2, "", True)
    check_text(err)
    assert {path: path.stat().st_mtime_ns for path in Path().iterdir()} == before
