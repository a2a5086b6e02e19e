"""Options of a comparison in tiles, and what the command prints and leaves; a fake computes in memory."""

import hashlib
import json
import os
from pathlib import Path
from types import SimpleNamespace

import pytest
import tiled_fake
from children_here import drawing_here
from command_line import is_one_line, read_comparison, without_timings
from optional import import_or_skip
from trajectories import circle, scene_folder
from wording import check_text

from pcbench import Cloud, read_cloud, write_cloud
from pcbench.comparison import workspace
from pcbench.errors import InputError


@pytest.fixture(autouse=True)
def tiles(files, monkeypatch):
    """Compute tiles by the fake, and keep default workspaces in the folder of the test."""
    tiled_fake.install(monkeypatch)
    monkeypatch.setattr(workspace, "tempfile", SimpleNamespace(gettempdir=lambda: str(files / "temporary")))
    (files / "temporary").mkdir()


def hidden(folder):
    return {path.name for path in Path(folder).iterdir() if path.name.startswith((".", "pcbench-"))}


@pytest.mark.with_deformation
def test_a_tiled_report_has_the_numbers_of_memory_and_files_of_all_points(files, run):
    import_or_skip("lazrs")
    assert run("compare", "ref.ply", "a.ply", "--out", "memory", "-q")[0] == 0
    code, out, err = run("compare", "ref.ply", "a.ply", "--tiles", "2k", "--out", "report")
    assert code == 0
    assert not err
    check_text("\n".join(line for line in out.splitlines() if line.startswith(("Computed", "Maps", "report:"))))
    tiled, memory = without_timings(read_comparison("report")), without_timings(read_comparison("memory"))
    assert tiled["tiling"] == {
        "tile_points": 2000,
        "tiles": 7,
        "sampled_points": 1000,
        "max_distance": None,
        "left_out": [],
        "map_files": True,
    }
    assert memory["tiling"] is None
    assert memory["candidates"][0]["map_samples"] == {}
    assert tiled["candidates"][0]["map_samples"] == {
        "candidate_to_reference": {"points": 429, "even": 375, "sampled_from": 1500},
        "reference_to_candidate": {"points": 1142, "even": 1000, "sampled_from": 4000},
    }
    del memory["candidates"][0]["metrics"]["presets"]["mpeg"]
    assert tiled["candidates"][0]["metrics"] == memory["candidates"][0]["metrics"]
    assert tiled["candidates"][0]["deviation"] == memory["candidates"][0]["deviation"]
    assert len(read_cloud("report/a_deviation.ply")) == 429
    parts = [read_cloud(path) for path in sorted(Path("report/maps/a_distance").iterdir())]
    assert sum(map(len, parts)) == 1500
    largest = max(part.attributes["distance"].max() for part in parts)
    hausdorff = tiled["candidates"][0]["metrics"]["hausdorff"]["candidate_to_reference"]
    assert largest == pytest.approx(hausdorff, rel=1e-6)  # 32 bits
    listed = json.loads(Path("report/manifest.json").read_text())["files"]
    assert {"maps/a_distance.tif", "maps/a_distance/tile_0000.laz"} <= set(listed)
    assert not hidden(files)


def test_the_next_report_replaces_the_map_files(files, run):
    for candidate in ("a.ply", "b.ply"):
        assert run("compare", "b.ply", candidate, "--tiles", "2k", "--out", "report", "-q")[0] == 0
    (files / "report/maps/notes.txt").write_text("mine")
    assert run("compare", "b.ply", "a.ply", "--out", "report", "-q")[0] == 0
    rasters = ["a_completeness.tif", "a_distance.tif"]
    assert sorted(path.name for path in Path("report/maps").iterdir()) == [*rasters, "notes.txt"]


@pytest.mark.long
def test_pictures_show_all_points_from_above(files, run):
    import_or_skip("matplotlib")
    with drawing_here():
        code, _, err = run("compare", "ref.ply", "a.ply", "--tiles", "2k", "--out", "report", "-q", figures=True)
    assert (code, err) == (0, "")
    names = {path.name for path in Path("report/figures").iterdir()}
    assert {"a_distance_overview.png", "a_completeness_overview.png"} <= names
    assert "a_colors.png" not in names  # the file may be too large to read
    with drawing_here():
        code, _, err = run("plot", "report", "reference")
    assert code == 2
    check_text(err)


def test_settings_repeat_a_tiled_comparison(run):
    options = ("--tiles", "2k", "--max-distance", "0.5", "-q")
    assert run("compare", "ref.ply", "a.ply", *options, "--out", "one")[0] == 0
    recorded = json.loads(Path("one/settings.json").read_text())
    assert recorded["tiling"] == {"tile_points": 2000, "max_distance": 0.5, "skip_bad": False}
    assert recorded["reference"]["sha256"] == hashlib.sha256(Path("ref.ply").read_bytes()).hexdigest()
    assert run("compare", "--settings", "one/settings.json", "--workers", 2, "--out", "two")[0] == 0
    one, two = without_timings(read_comparison("one")), without_timings(read_comparison("two"))
    for values in (one, two):
        for entry in (values["reference"], *values["candidates"]):
            entry["path"] = Path(entry["path"]).name
    assert one == two
    code, _, err = run("compare", "--settings", "one/settings.json", "--max-distance", 3)
    assert code == 2
    check_text(err.partition(" (see ")[0])


@pytest.mark.parametrize("damage", [[], {"tile_points": "many"}, {"skip_bad": 1}, {"max_distance": -1}, {"other": 1}])
def test_damaged_records_of_tiles_are_refused(damage, report, run):
    recorded = json.loads((report / "settings.json").read_text())
    Path("one").mkdir()
    Path("one/settings.json").write_text(json.dumps({**recorded, "tiling": damage}))
    code, _, err = run("compare", "--settings", "one/settings.json")
    assert code == 2
    assert is_one_line(err)
    check_text(err)


def test_auto_computes_in_tiles_what_does_not_fit(run, monkeypatch):
    code, out, err = run("compare", "ref.ply", "a.ply", "--tiles", "auto")
    assert (code, err) == (0, "")
    assert "Computed in" not in out
    for options in ((), ("--tiles", "auto")):
        code, out, err = run("compare", "ref.ply", "a.ply", *options, "--memory", "50MB")
        assert code == 0
        assert "Computed in 7 tiles" in out
        check_text(err)


def test_what_tiles_do_not_support_stays_in_memory_unless_they_are_requested(run):
    options = ("--preset", "tnt", "--memory", "50MB")
    code, out, err = run("compare", "ref.ply", "a.ply", *options)
    assert code == 0
    assert "Computed in" not in out
    check_text(err)
    code, _, err = run("compare", "ref.ply", "a.ply", *options, "--tiles", "auto")
    assert code == 2
    check_text(err)


@pytest.mark.parametrize(
    "options",
    [
        ("--map", "m3c2"),
        ("--map", "poisson"),
        ("--preset", "tnt"),
        ("--preset", "mpeg"),
        ("--mpeg-peak", "1023"),
        ("--tolerance", "1%"),
        ("--min-opacity", "0.5"),
        ("--max-axis", "0.5"),
    ],
    ids=" ".join,
)
def test_unsupported_options_are_refused(options, run):
    code, _, err = run("compare", "ref.ply", "a.ply", "--tiles", "1e4", *options, "--out", "report")
    assert code == 2
    assert is_one_line(err)
    check_text(err)
    assert not Path("report").exists()


def test_the_registration_of_tanks_and_temples_is_refused(run, tmp_path):
    volume = (0.0, 0.0, -9.0, 9.0, 9.0, 9.0)
    scene = scene_folder(tmp_path / "Barn", "Barn", circle(), circle(), volume)
    options = ("--register", f"tnt:{scene / 'Barn_COLMAP_SfM.log'},{scene}", "--out", "report")
    code, _, err = run("compare", "ref.ply", "a.ply", "--tiles", "1e4", *options)
    assert code == 2
    check_text(err)


def test_a_mesh_as_the_reference_is_refused(run):
    Path("mesh.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    code, _, err = run("compare", "mesh.obj", "a.ply", "--skip-bad")
    assert code == 2
    check_text(err)


@pytest.mark.parametrize(
    "options",
    [
        ("--tiles", "many"),
        ("--tiles", "0"),
        ("--tiles", "1.5"),
        ("--tiles", "10"),
        ("--memory", "lots"),
        ("--memory", "0"),
        ("--memory", "4"),
        ("--workers", "0"),
        ("--max-distance", "0"),
        ("--max-distance", "nan"),
        ("--cluster", "here"),
        ("--workspace", "ref.ply", "--tiles", "1e4"),
        ("--workspace", ".", "--tiles", "1e4"),
        ("--workspace", "others", "--tiles", "1e4"),
        ("--workspace", "work", "--tiles", "1e4", "--out", "work/report"),
        ("--workspace", "report/work", "--tiles", "1e4", "--out", "report"),
        ("--workspace", "others", "--tiles", "1e4", "--json", "others/a.json"),
    ],
    ids=" ".join,
)
def test_wrong_values_are_refused(options, run):
    Path("others").mkdir()
    Path("others/notes.txt").write_text("mine")
    code, _, err = run("compare", "ref.ply", "a.ply", *options)
    assert code == 2
    assert "Traceback" not in err
    check_text(err.splitlines()[-1])
    assert Path("others/notes.txt").read_text() == "mine"


@pytest.mark.parametrize(
    ("text", "points"), [("1e6", 1_000_000), ("500k", 500_000), ("2M", 2_000_000), ("0.5G", 500_000_000), ("700", 700)]
)
def test_numbers_of_points(text, points):
    from pcbench.measure.tiled.settings import parse_points

    assert parse_points("--tiles", text) == points


def test_a_failed_run_keeps_its_workspace_and_the_same_command_continues(files, run, monkeypatch):
    seen = []

    def compare_in_tiles(*arguments, workspace, **others):
        seen.append(sorted(path.name for path in workspace.iterdir()))
        if len(seen) == 1:
            (workspace / "tile_1").write_text("finished")
            raise InputError("tiles/b.laz: truncated: copy the file again")
        return tiled_fake.compare_in_tiles(*arguments, workspace=workspace, **others)

    tiled_fake.install(monkeypatch, compare_in_tiles)
    arguments = ("compare", "ref.ply", "a.ply", "--tiles", "2k", "--out", "new/report")
    code, _, err = run(*arguments)
    assert code == 2
    check_text(err)
    assert not Path("new/report").exists()
    assert hidden("new") == {".report.pcbench-tiles"}
    code, _, err = run(*arguments)
    assert code == 0
    check_text(err)
    assert seen[1] == ["tile_1", "workspace.json"]
    assert hidden("new") == set()
    assert Path("new/report/report.html").is_file()


def test_other_settings_or_files_start_again(files, run, monkeypatch):
    calls = []

    def compare_in_tiles(*arguments, workspace, **others):
        calls.append((workspace / "tile_1").exists())
        (workspace / "tile_1").write_text("finished")
        raise OSError(28, "No space left on device", str(workspace / "tile_2"))

    tiled_fake.install(monkeypatch, compare_in_tiles)
    arguments = ("compare", "ref.ply", "a.ply", "--tiles", "2k", "--workers", 1, "--out", "report")
    assert run(*arguments)[0] == 2
    code, _, err = run(*arguments, "--seed", 3)
    assert code == 2
    check_text(err)
    data = bytearray(Path("a.ply").read_bytes())
    data[-1] ^= 1
    Path("a.ply").write_bytes(data)
    assert run(*arguments, "--seed", 3)[0] == 2
    os.utime("a.ply", ns=(1, 1))  # the same content at another time
    assert run(*arguments, "--seed", 3)[0] == 2
    assert run(*arguments, "--seed", 3, "--workers", 2)[0] == 2
    assert calls == [False, False, False, True, True]


def test_a_run_that_met_a_damaged_file_continues_without_it(run, monkeypatch):
    calls = []

    def compare_in_tiles(*arguments, workspace, **others):
        calls.append((workspace / "tile_1").exists())
        (workspace / "tile_1").write_text("finished")
        raise InputError("tiles/b.laz: damaged")

    tiled_fake.install(monkeypatch, compare_in_tiles)
    arguments = ("compare", "ref.ply", "a.ply", "--tiles", "2k", "--out", "report")
    assert run(*arguments)[0] == 2
    assert run(*arguments, "--skip-bad")[0] == 2
    assert calls == [False, True]


def test_a_run_that_finished_nothing_leaves_no_workspace(run, monkeypatch):
    def compare_in_tiles(*arguments, workspace, **others):
        (workspace / "results/read").mkdir(parents=True)
        raise InputError("expected the address of a running Dask scheduler")

    tiled_fake.install(monkeypatch, compare_in_tiles)
    code, _, err = run("compare", "ref.ply", "a.ply", "--tiles", "2k", "--out", "report")
    assert code == 2
    assert is_one_line(err)
    assert not hidden(".")


@pytest.mark.parametrize(
    "options", [("--out",), ("--tiles", "2k", "--out"), ("--tiles", "2k", "--workspace")], ids=" ".join
)
def test_a_pattern_may_not_match_files_of_the_report_or_the_workspace(options, run):
    Path("area/report").mkdir(parents=True)
    for name in ("area/a.ply", "area/report/a_deviation.ply"):
        write_cloud(name, read_cloud("a.ply"))
    code, _, err = run("compare", "ref.ply", "area/**/*.ply", *options, "area/report")
    assert code == 2
    check_text(err)
    assert [path.name for path in Path("area/report").iterdir()] == ["a_deviation.ply"]


def test_without_a_report_the_workspace_is_temporary(files, run, monkeypatch):
    used = []

    def compare_in_tiles(*arguments, workspace, maps, **others):
        used.append((workspace.parent, maps))
        return tiled_fake.compare_in_tiles(*arguments, workspace=workspace, maps=maps, **others)

    tiled_fake.install(monkeypatch, compare_in_tiles)
    assert run("compare", "ref.ply", "a.ply", "--tiles", "2k", "-q")[0] == 0
    assert run("compare", "ref.ply", "a.ply", "--tiles", "2k", "-q", "--workspace", "mine/work")[0] == 0
    assert used == [(files / "temporary", None), (Path("mine"), None)]
    assert not hidden("temporary")
    assert not Path("mine").exists()


def test_an_empty_folder_of_the_user_stays(run):
    Path("work").mkdir()
    assert run("compare", "ref.ply", "a.ply", "--tiles", "2k", "-q", "--workspace", "work")[0] == 0
    assert Path("work").is_dir()
    assert not any(Path("work").iterdir())


def test_two_runs_do_not_share_a_workspace(run, monkeypatch):
    codes = []

    def compare_in_tiles(*arguments, **others):
        if not codes:
            codes.append(None)
            codes[0] = run("compare", "ref.ply", "a.ply", "--tiles", "2k", "--workspace", "work")
        return tiled_fake.compare_in_tiles(*arguments, **others)

    tiled_fake.install(monkeypatch, compare_in_tiles)
    assert run("compare", "ref.ply", "a.ply", "--tiles", "2k", "--workspace", "work", "-q")[0] == 0
    code, _, err = codes[0]
    assert code == 2
    check_text(err)


@pytest.mark.parametrize("kind", ["folder", "pattern"])
def test_candidates_in_several_files_are_named_after_their_folder(kind, run):
    points = read_cloud("a.ply").points
    Path("flight.2").mkdir()
    for k in (0, 1):
        write_cloud(f"flight.2/part_{k}.ply", Cloud(points[k::2]))
    path = "flight.2" if kind == "folder" else "flight.2/*.ply"
    assert run("compare", "ref.ply", path, "--tiles", "2k", "--out", "report", "-q")[0] == 0
    (candidate,) = read_comparison("report")["candidates"]
    assert (candidate["name"], candidate["points"]) == ("flight.2", 1500)
    assert candidate["sha256"].startswith("files:")
