"""The command line as a user meets it: outputs, one-line errors, exit codes, and nothing half-written."""

import csv
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import shapes

from pcbench import Cloud, read_cloud, write_cloud
from pcbench.geometry.transform import read_matrix

REPORT = {"comparison.json", "metrics.csv", "table.md", "settings.json"}


@pytest.fixture
def files(tmp_path, monkeypatch):
    """ref.ply, a.ply and b.ply in the current folder."""
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(0)
    reference = shapes.city(4000, noise=0.01, seed=1)[0]
    write_cloud("ref.ply", Cloud(reference, unit="m"))
    for name, count, noise in (("a", 1500, 0.02), ("b", 700, 0.05)):
        points = shapes.city(count, seed=count)[0]
        write_cloud(f"{name}.ply", Cloud(points + rng.normal(0, noise, points.shape) + [0.05, 0.02, 0]))
    return tmp_path


def doc(folder):
    return json.loads((Path(folder) / "comparison.json").read_text())


def without_the_clock(values):
    values["provenance"] = None
    for candidate in values["candidates"]:
        candidate["timings_s"] = candidate["peak_rss_bytes"] = None
    return values


def one_line(err):
    return err.startswith("error: ") and err.count("\n") == 1 and "Traceback" not in err


def test_compare_prints_a_table_and_leaves_a_folder(files, run):
    code, out, err = run("compare", "ref.ply", "a.ply", "b.ply", "--out", "report")
    assert code == 0
    assert not err
    assert "D1 MSE" in out
    assert "sampling floor" in out
    fields = {f"{name}_deformation.{kind}" for name in "ab" for kind in ("csv", "ply")}
    expected = REPORT | fields | {"a_deviation.ply", "a_T.txt", "b_deviation.ply", "b_T.txt"}
    assert {p.name for p in Path("report").iterdir()} - {"figures"} == expected
    values = doc("report")
    assert [c["name"] for c in values["candidates"]] == ["a", "b"]
    assert values["reference"]["sha256"]
    assert "NaN" not in (files / "report/comparison.json").read_text()
    deviation = read_cloud("report/a_deviation.ply")
    assert len(deviation) == 1500
    m = values["candidates"][0]["metrics"]
    # The scalar is float32 in the file.
    assert deviation.attributes["distance"].max() == pytest.approx(m["hausdorff"]["candidate_to_reference"], rel=1e-6)
    matrix = read_matrix("report/a_T.txt").matrix
    np.testing.assert_array_equal(matrix, values["candidates"][0]["registration"]["T_reference_candidate"])
    rows = list(csv.DictReader((files / "report/metrics.csv").open()))
    assert list(rows[0]) == ["candidate", "metric", "direction", "definition", "value", "unit", "ci_low", "ci_high"]
    row = next(r for r in rows if r["metric"] == "d1_mse" and r["direction"] == "candidate_to_reference")
    assert float(row["value"]) == m["d1_mse"]["candidate_to_reference"]
    assert row["unit"] == "m^2"
    assert "| D1 MSE |" in (files / "report/table.md").read_text()


def test_settings_reproduce_the_numbers_bit_for_bit(files, run):
    options = ("--crop", "quantile:0.9", "--register", "similarity", "--thresholds", "0.1,0.3", "--preset", "open3d")
    assert run("compare", "ref.ply", "a.ply", "b.ply", *options, "--seed", 5, "--out", "one")[0] == 0
    assert run("compare", "--settings", "one/settings.json", "--out", "two")[0] == 0
    one, two = without_the_clock(doc("one")), without_the_clock(doc("two"))
    for values in (one, two):
        for entry in (values["reference"], *values["candidates"]):
            entry["path"] = Path(entry["path"]).name
    assert one == two
    code, _, err = run("compare", "--settings", "one/settings.json", "--crop", "none")
    assert code == 2
    assert "--settings already names" in err


def test_settings_notice_a_changed_file(files, run):
    run("compare", "ref.ply", "a.ply", "--out", "one", "-q")
    write_cloud("a.ply", read_cloud("b.ply"))
    code, out, _ = run("compare", "--settings", "one/settings.json")
    assert code == 0
    assert "has changed since" in out


def test_json_on_standard_output(files, run):
    code, out, _ = run("compare", "ref.ply", "a.ply", "--json", "-")
    assert code == 0
    assert json.loads(out)["schema"] == "pcbench.comparison/1"
    assert run("compare", "ref.ply", "a.ply", "--quiet")[1] == ""


def test_equal_stems_get_numbers(files, run):
    (files / "sub").mkdir()
    write_cloud("sub/a.ply", read_cloud("b.ply"))
    write_cloud("reference.ply", read_cloud("b.ply"))
    code, _, _ = run("compare", "ref.ply", "a.ply", "sub/a.ply", "reference.ply", "--out", "report")
    assert code == 0
    assert [c["name"] for c in doc("report")["candidates"]] == ["a", "a_2", "reference_2"]


def test_one_bad_candidate_leaves_nothing(files, run):
    (files / "bad.ply").write_bytes((files / "a.ply").read_bytes()[:-5])
    code, _, err = run("compare", "ref.ply", "a.ply", "bad.ply", "--out", "new/report")
    assert code == 2
    assert one_line(err)
    assert "bad.ply" in err
    assert not (files / "new").exists()


def test_an_existing_report_survives_a_failed_run_and_is_replaced_by_a_good_one(files, run):
    assert run("compare", "ref.ply", "a.ply", "b.ply", "--out", "report")[0] == 0
    (files / "report/notes.txt").write_text("mine")
    before = {p.name: p.read_bytes() for p in (files / "report").iterdir() if p.is_file()}
    assert run("compare", "ref.ply", "a.ply", "--crop", "sphere:900,0,0,1", "--out", "report")[0] == 2
    assert {p.name: p.read_bytes() for p in (files / "report").iterdir() if p.is_file()} == before
    assert run("compare", "ref.ply", "a.ply", "--out", "report")[0] == 0
    left = {p.name for p in (files / "report").iterdir()} - {"figures"}
    fields = {"a_deformation.csv", "a_deformation.ply"}
    assert left == REPORT | fields | {"a_deviation.ply", "a_T.txt", "notes.txt"}
    assert not [p for p in files.iterdir() if p.name.startswith(".")]


def test_a_folder_of_something_else_is_left_alone(files, run):
    (files / "thesis").mkdir()
    (files / "thesis/chapter.tex").write_text("years of work")
    code, _, err = run("compare", "ref.ply", "a.ply", "--out", "thesis")
    assert code == 2
    assert "not empty and holds no report" in err
    code, _, err = run("compare", "ref.ply", "b.ply", "--out", "a.ply")
    assert code == 2
    assert "expected a folder" in err


BAD = {
    "missing file": ("compare ref.ply no.ply", "no.ply"),
    "a directory": ("compare ref.ply .", "folder"),
    "empty file": ("compare ref.ply empty.ply", "empty"),
    "wrong magic": ("compare ref.ply magic.ply", "magic.ply"),
    "truncated": ("compare ref.ply cut.ply", "of 1500 vert"),
    "negative count": ("compare ref.ply negative.ply", "negative.ply"),
    "absurd count": ("compare ref.ply absurd.ply", "absurd.ply"),
    "unknown extension": ("compare ref.ply a.docx", ".ply"),
    "no points": ("compare ref.ply none.ply", "none.ply"),
    "all NaN": ("compare ref.ply nan.ply", "NaN"),
    "no matrix": ("compare ref.ply a.ply --register matrix:empty.ply", "empty.ply"),
    "no such matrix": ("compare ref.ply a.ply --register matrix:no.txt", "no.txt"),
    "no such method": ("compare ref.ply a.ply --register magic", "unknown registration"),
    "no such crop": ("compare ref.ply a.ply --crop circle:1", "circle"),
    "empty crop": ("compare ref.ply a.ply --crop sphere:999,0,0,1", "leaves none"),
    "no overlap": ("compare ref.ply far.ply", "does not overlap"),
    "no overlap as it is": ("compare ref.ply far.ply --register none", "does not overlap"),
    "bad thresholds": ("compare ref.ply a.ply --thresholds a,b", "--thresholds"),
    "negative threshold": ("compare ref.ply a.ply --thresholds=-1", "positive thresholds"),
    "unknown preset": ("compare ref.ply a.ply --preset x", "unknown preset"),
    "no settings": ("compare --settings no.json", "no.json"),
    "not settings": ("compare --settings ref.ply", "ref.ply"),
    "crop keeps nothing": ("crop a.ply out.ply --crop box:900,900,900,901,901,901", "leaves none"),
    "register far": ("register ref.ply far.ply --out out.ply", "does not overlap"),
    "info of nothing": ("info no.ply", "no.ply"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_input_is_one_line(files, run, name):
    header = b"ply\nformat binary_little_endian 1.0\nelement vertex %s\n"
    body = b"property float x\nproperty float y\nproperty float z\nend_header\n"
    (files / "empty.ply").touch()
    (files / "magic.ply").write_bytes(b"PK\x03\x04 not a cloud")
    (files / "cut.ply").write_bytes((files / "a.ply").read_bytes()[:-40])
    (files / "negative.ply").write_bytes(header % b"-5" + body)
    (files / "absurd.ply").write_bytes(header % b"99999999999999" + body + b"\0" * 12)
    (files / "none.ply").write_bytes(header % b"0" + body)
    (files / "nan.ply").write_bytes(header % b"2" + body + np.full(6, np.nan, "<f4").tobytes())
    (files / "a.docx").write_bytes(b"x")
    write_cloud("far.ply", Cloud(read_cloud("a.ply").points + 1e5))
    before = sorted(p.name for p in files.iterdir())
    arguments, expected = BAD[name]
    out = ("--out", "report") if arguments.startswith("compare") else ()
    code, stdout, err = run(*arguments.split(), *out)
    assert code == 2
    assert one_line(err), err
    assert expected in err
    assert not stdout
    assert sorted(p.name for p in files.iterdir()) == before


def test_usage_errors(run):
    for arguments in (
        ("compare",),
        ("compare", "ref.ply"),
        ("crop", "ref.ply"),
        ("frobnicate",),
        ("compare", "--nonsense"),
    ):
        code, _, err = run(*arguments)
        assert code == 2
        assert "Traceback" not in err


def test_nan_points_are_dropped_and_counted(files, run):
    points = read_cloud("a.ply").points.copy()
    points[:7] = np.nan
    np.save("holes.npy", points)
    code, out, _ = run("compare", "ref.ply", "holes.npy", "--out", "report")
    assert code == 0
    assert "7 of 1500" in out
    assert "7 of 1500" in doc("report")["candidates"][0]["warnings"][0]
    assert doc("report")["candidates"][0]["points"] == 1493


def test_suspected_units_are_warned_about(files, run):
    points = read_cloud("ref.ply").points
    write_cloud("mm.ply", Cloud(1000 * (points - points.mean(axis=0)) + points.mean(axis=0)))
    code, out, _ = run("compare", "ref.ply", "mm.ply", "--register", "none")
    assert code == 0
    assert "millimetres against metres" in out


def test_disk_full_leaves_nothing(files):
    script = (
        "import resource, sys; resource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096))\n"
        "sys.argv = 'pcbench compare ref.ply a.ply --out report --no-figures'.split()\n"
        "from pcbench.cli import main; main()"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert done.returncode == 2
    assert one_line(done.stderr), done.stderr
    assert {p.name for p in files.iterdir()} == {"ref.ply", "a.ply", "b.ply"}


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_a_folder_that_cannot_be_written(files, run):
    (files / "locked").mkdir(mode=0o555)
    code, _, err = run("compare", "ref.ply", "a.ply", "--out", "locked/report")
    assert code == 2
    assert one_line(err)


def test_out_below_a_file(files, run):
    code, _, err = run("compare", "ref.ply", "a.ply", "--out", "a.ply/report")
    assert code == 2
    assert one_line(err)


def test_crop_register_and_info(files, run):
    code, out, _ = run("crop", "a.ply", "cut.ply", "--crop", "box:0,0,-1,10,10,30")
    assert code == 0
    assert "1,500 points" in out
    assert (read_cloud("cut.ply").points[:, 0] <= 10).all()
    code, out, _ = run("register", "ref.ply", "a.ply", "--out", "aligned.ply", "--matrix", "T.txt")
    assert code == 0
    assert "converged" in out
    moved = read_matrix("T.txt").apply(read_cloud("a.ply").points)
    np.testing.assert_allclose(read_cloud("aligned.ply").points, moved, atol=1e-12)
    code, out, _ = run("compare", "ref.ply", "a.ply", "--register", "matrix:T.txt", "--json", "-")
    assert json.loads(out)["candidates"][0]["registration"]["method"] == f"matrix:{files / 'T.txt'}"
    code, out, _ = run("info", "ref.ply", "a.ply")
    assert code == 0
    assert "4,000 points" in out
    assert "1,500 points" in out


def test_demo_at_a_small_size(tmp_path, run):
    code, out, _ = run("demo", "--points", 20_000, "--out", tmp_path / "demo", "--no-figures", "--no-bench")
    assert code == 0
    assert "was registered to" in out
    assert {p.name for p in (tmp_path / "demo/report").iterdir()} >= REPORT
    # The command that it prints works.
    again = out.strip().splitlines()[-1].partition("again: pcbench ")[2].replace("REPORT", str(tmp_path / "again"))
    assert run(*again.split())[0] == 0


def test_the_demo_writes_into_no_folder_of_others(tmp_path, run):
    (tmp_path / "clouds").mkdir()
    mine = tmp_path / "clouds" / "reference.ply"
    mine.write_text("mine")
    code, _, err = run("demo", "--points", 20_000, "--out", tmp_path)
    assert code == 2
    assert "holds no demo" in err
    assert mine.read_text() == "mine"
    assert list(tmp_path.iterdir()) == [tmp_path / "clouds"]


def test_interrupt_leaves_nothing(files, run, monkeypatch):
    def interrupt(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("pcbench.measure.comparison.register", interrupt)
    code, _, err = run("compare", "ref.ply", "a.ply", "--out", "report")
    assert code == 130
    assert err.strip() == "interrupted"
    assert {p.name for p in files.iterdir()} == {"ref.ply", "a.ply", "b.ply"}


def test_outputs_never_replace_inputs(files, run):
    before = {p.name: p.read_bytes() for p in files.iterdir()}
    for arguments in (
        ("compare", "ref.ply", "a.ply", "--json", "ref.ply"),
        ("compare", "ref.ply", "a.ply", "--out", "."),
        ("register", "ref.ply", "a.ply", "--out", "a.ply"),
    ):
        code, _, err = run(*arguments)
        assert code == 2
        assert one_line(err)
    assert {p.name: p.read_bytes() for p in files.iterdir()} == before
    run("compare", "ref.ply", "a.ply", "--out", "report", "-q")
    code, _, err = run("compare", "ref.ply", "report/a_deviation.ply", "--out", "report")
    assert code == 2
    assert "would replace its own input" in err


def test_an_output_that_cannot_be_written_is_noticed_first(files, run):
    code, _, err = run("compare", "ref.ply", "a.ply", "--out", "report", "--json", "no/x.json")
    assert code == 2
    assert one_line(err)
    assert not (files / "report").exists()
    assert run("register", "ref.ply", "a.ply", "--out", "b2.ply", "--matrix", "no/m.txt")[0] == 2
    assert not (files / "b2.ply").exists()


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("reference", 5),
        ("reference", {"sha256": "x"}),
        ("reference", {"path": 5, "sha256": "x"}),
        ("candidates", []),
        ("candidates", [{"name": "../x", "path": "a.ply", "sha256": ""}]),
        ("candidates", [{"name": "", "path": "a.ply", "sha256": ""}]),
        ("candidates", [{"name": None, "path": "a.ply", "sha256": ""}]),
        ("candidates", 2 * [{"name": "a", "path": "a.ply", "sha256": ""}]),
        ("settings", {"seed": -1}),
        ("settings", {"seed": "x"}),
        ("settings", {"register": None}),
        ("settings", {"crop": 5}),
        ("settings", {"thresholds": "123"}),
        ("settings", {"thresholds": [1e400]}),
        ("settings", {"normal_neighbors": 2500000000}),
        ("settings", {"nonsense": 1}),
        ("settings", None),
    ],
)
def test_damaged_settings_are_one_line(files, run, key, value):
    run("compare", "ref.ply", "a.ply", "--out", "one", "-q")
    values = json.loads((files / "one/settings.json").read_text())
    values[key] = {**values[key], **value} if key == "settings" and value else value
    (files / "bad.json").write_text(json.dumps(values))
    code, _, err = run("compare", "--settings", "bad.json", "--out", "two")
    assert code == 2
    assert one_line(err), err
    assert not (files / "two").exists()


def test_a_report_with_evil_names_deletes_nothing_elsewhere(files, run):
    (files / "evil/figures").mkdir(parents=True)
    (files / "p_T.txt").write_text("mine")
    name = "figures/../../p"
    (files / "evil/comparison.json").write_text(json.dumps({"candidates": [{"name": name}]}))
    run("compare", "ref.ply", "a.ply", "--out", "evil")
    assert (files / "p_T.txt").read_text() == "mine"


def test_names_are_data_not_markup(files, run):
    for name in ("[bold]x", ":smile:", "[/x]"):
        (files / f"{name.replace('/', '')}.ply").write_bytes((files / "a.ply").read_bytes())
    code, out, _ = run("compare", "ref.ply", "[bold]x.ply", ":smile:.ply", "[x].ply")
    assert code == 0
    for name in ("[bold]x", ":smile:", "[x]"):
        assert name in out


def test_files_that_settings_name_are_absolute_and_hashed(files, run, monkeypatch):
    run("register", "ref.ply", "a.ply", "--matrix", "T.txt", "-q")
    assert run("compare", "ref.ply", "a.ply", "--register", "matrix:T.txt", "--out", "one")[0] == 0
    (files / "elsewhere").mkdir()
    monkeypatch.chdir(files / "elsewhere")
    assert run("compare", "--settings", "../one/settings.json", "--out", "two")[0] == 0
    assert doc("two")["candidates"][0]["metrics"] == doc("../one")["candidates"][0]["metrics"]
    (files / "T.txt").write_text((files / "T.txt").read_text() + "# touched\n")
    assert "T.txt: the file has changed" in run("compare", "--settings", "../one/settings.json")[1]


def test_a_poor_terminal_and_a_terminated_run(files):
    command = [sys.executable, "-m", "pcbench.cli", "compare", "ref.ply", "a.ply", "--no-figures"]
    poor = {**os.environ, "PYTHONIOENCODING": "ascii", "COLUMNS": "20", "TERM": "dumb"}
    done = subprocess.run(command, env=poor, capture_output=True, check=True)
    assert b"D1 MSE" in done.stdout
    stop = (
        "import os, signal, sys, pcbench.measure.comparison\n"
        "pcbench.measure.comparison.register = lambda *_, **__: os.kill(os.getpid(), signal.SIGTERM)\n"
        "sys.argv = 'pcbench compare ref.ply a.ply --out report'.split()\n"
        "from pcbench.cli import main; main()"
    )
    assert subprocess.run([sys.executable, "-c", stop], capture_output=True, check=False).returncode == 143
    assert {p.name for p in files.iterdir()} == {"ref.ply", "a.ply", "b.ply"}


def test_usage_errors_are_one_line_too(files, run):
    for arguments in (("compare", "ref.ply"), ("compare", "--seed", "x"), ("demo", "--points", "5"), ("nonsense",)):
        code, _, err = run(*arguments)
        assert code == 2
        assert one_line(err), err
    assert run("compare", "ref.ply", "a.ply", "--seed", "-1")[0] == 2


def test_convert(files, run):
    write_cloud("c.ply", Cloud(read_cloud("a.ply").points, attributes={"quality": np.arange(1500.0)}))
    for name in ("c.xyz", "c.npz", "c.las", "c.laz", "c.pcd"):
        if name.endswith("laz"):
            pytest.importorskip("lazrs")
        code, out, err = run("convert", "c.ply", name)
        assert code == 0, err
        assert "1,500 points" in out
        np.testing.assert_allclose(read_cloud(name).points, read_cloud("c.ply").points, atol=1e-4)
    code, _, err = run("convert", "c.ply", "c.xyz", "--classes", "2")
    assert code == 2
    assert one_line(err)


def test_las_in_las_out(files, run):
    pytest.importorskip("lazrs")
    run("convert", "a.ply", "a.laz", "-q")
    assert run("compare", "ref.ply", "a.laz", "--out", "report")[0] == 0
    cloud = read_cloud("report/a_deviation.laz")
    assert cloud.colors is not None
    found = doc("report")["candidates"][0]["metrics"]["hausdorff"]["candidate_to_reference"]
    assert cloud.attributes["distance"].max() == pytest.approx(found, rel=1e-6)


def test_figures_come_with_the_report(files, run):
    code, _, err = run("compare", "ref.ply", "a.ply", "--out", "report", figures=True)
    assert code == 0
    if "no pictures" not in err:
        assert (files / "report/figures/a_distance.png").is_file()
        code, out, _ = run("plot", "report", "distribution")
        assert code == 0
        assert out == "report/figures/distribution.png\n"


def test_classes_filter_las_inputs_only(files, run):
    points = read_cloud("ref.ply").points
    classes = np.where(points[:, 2] > 1, 6, 2).astype(np.uint8)
    write_cloud("ref.las", Cloud(points, attributes={"classification": classes}))
    code, _, err = run("compare", "ref.las", "a.ply", "--classes", "2", "--out", "report")
    assert code == 0, err
    assert doc("report")["reference"]["points"] == int((classes == 2).sum())
    code, _, err = run("compare", "ref.ply", "a.ply", "--classes", "2")
    assert code == 2
    assert "none of the clouds is one" in err
    code, _, err = run("compare", "ref.las", "a.ply", "--classes", "9")
    assert code == 2
    assert one_line(err)


def test_a_mesh_file_as_the_reference(files, run):
    (files / "square.obj").write_text("v 0 0 0\nv 20 0 0\nv 20 20 0\nv 0 20 0\nf 1 2 3 4\n")
    rng = np.random.default_rng(0)
    write_cloud("low.ply", Cloud(np.column_stack([rng.uniform(1, 19, (500, 2)), np.full(500, 0.1)])))
    code, _, err = run("compare", "square.obj", "low.ply", "--register", "none", "--out", "report")
    assert code == 0, err
    values = doc("report")
    assert values["reference"]["faces"] == 2
    assert values["candidates"][0]["deviation"]["maps"]["mesh_distance"]["rms"] == pytest.approx(0.1)
    assert "mesh_distance" in read_cloud("report/low_deviation.ply").attributes


def test_scene_says_what_is_there_and_converts_cameras(tmp_path, monkeypatch, run):
    from pcbench.geometry.cameras import Camera, Intrinsics, look_at
    from pcbench.io.colmap_model import write_colmap_model

    image = pytest.importorskip("PIL.Image")
    monkeypatch.chdir(tmp_path)
    Path("photos/images").mkdir(parents=True)
    cameras = []
    for number in range(3):
        image.new("RGB", (40, 30)).save(f"photos/images/{number}.png")
        cameras.append(Camera(f"{number}.png", Intrinsics(40, 30, 35, 35, 20, 15), look_at([number, 0, 5], [1, 1, 0])))
    write_colmap_model(Path("photos/sparse"), cameras)
    code, out, err = run("scene", "photos", "--write-cameras", "photos/transforms.json", "--figure", "cameras.png")
    assert (code, err) == (0, "")
    assert "3 images of 40 x 30" in out
    assert "cameras 3, GPS 0, masks 0" in out
    assert Path("cameras.png").stat().st_size
    code, out, err = run("scene", "photos", "--cameras", "photos/transforms.json", "--image-scale", "0.5")
    assert (code, err) == (0, "")
    assert "3 images of 20 x 15" in out
    Path("photos/images/1.png").write_bytes(b"")
    for arguments in (("photos",), ("nowhere",), ("photos", "--image-scale", "2")):
        code, out, err = run("scene", *arguments, "--figure", "other.png")
        assert (code, out) == (2, "")
        assert one_line(err)
    assert not Path("other.png").exists()


def test_reconstruct_and_plugins(tmp_path, monkeypatch, run):
    from pcbench.geometry.cameras import Camera, Intrinsics, look_at
    from pcbench.io.colmap_model import write_colmap_model

    image = pytest.importorskip("PIL.Image")
    monkeypatch.chdir(tmp_path)
    Path("photos").mkdir()
    image.new("RGB", (40, 30)).save("photos/0.png")
    camera = Camera("0.png", Intrinsics(40, 30, 35, 35, 20, 15), look_at([0, 0, 5], [1, 1, 0]))
    write_colmap_model(Path("photos/sparse"), [camera], Cloud(np.arange(12.0).reshape(4, 3)))
    Path("mine.py").write_text(
        "from dataclasses import dataclass\n"
        "from pcbench.plugins import Reconstruction\n"
        "@dataclass(frozen=True)\n"
        "class Mine:\n"
        '    """Returns what it got."""\n'
        "    points: int = 4\n"
        "    @classmethod\n"
        "    def missing(cls): return None\n"
        "    def reconstruct(self, scene, workspace):\n"
        "        return Reconstruction(scene.points.select(slice(self.points)), 'georeferenced', scene.cameras)\n"
    )
    code, out, err = run("plugins", "mine.py:Mine")
    assert (code, err) == (0, "")
    assert "sfm (pcbench " in run("plugins")[1]
    assert "min_views: points that fewer images show" not in run("plugins")[1]
    assert "min_views: points that fewer images show" in run("plugins", "sfm")[1]
    assert "mine.py:Mine (mine.py): Returns what it got.\n  can run here\n  --set points=int  (default 4)\n" in out
    arguments = ("reconstruct", "mine.py:Mine", "photos", "-o", "cloud.ply")
    code, out, err = run(*arguments, "--set", "points=3", "--write-cameras", "cameras.json")
    assert (code, err) == (0, "")
    assert "cloud.ply: 3 points, georeferenced, 1 cameras" in out
    assert len(read_cloud("cloud.ply")) == 3
    assert json.loads(Path("cameras.json").read_text())["frames"][0]["file_path"] == "photos/0.png"
    Path("cloud.ply").unlink()
    for wrong in (("--set", "points=x"), ("--set", "points"), ("--cameras", "none"), ("--set", "other=1")):
        code, out, err = run(*arguments, *wrong)
        assert (code, out) == (2, "")
        assert one_line(err)
    # Where results cannot be written is said before anything is computed.
    for wrong in (
        ("-o", "cloud.pts"),
        ("-o", "no/cloud.ply"),
        ("--write-cameras", "no/c.json"),
        ("--write-cameras", "mine.py"),
    ):
        code, out, err = run(*arguments, "--workspace", "untouched", *wrong)
        assert (code, out) == (2, "")
        assert one_line(err)
    assert not Path("untouched").exists()
    assert not Path("cloud.ply").exists()
    Path("mine.py").write_text(Path("mine.py").read_text().replace("return None", "return 'no such chip'"))
    assert "cannot run here: no such chip" in run("plugins", "mine.py:Mine")[1]
    assert "mine.py:Mine cannot run here: no such chip" in run(*arguments)[2]
    code, out, err = run("plugins", "mine.py:Yours")
    assert code == 2
    assert one_line(err)
