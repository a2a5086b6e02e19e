"""Hostile inputs and machines: one line with a reason, and no lost files."""

import json
import os
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import scene_folders
from children_here import drawing_here
from command_line import is_one_line, without_progress
from optional import import_or_skip
from wording import check_error, check_text

from pcbench import Cloud, read_cloud, write_cloud
from pcbench.io.colmap_model import write_colmap_model
from pcbench.report.figures import Figures
from pcbench.report.names import names_of
from pcbench.report.plot import REPORT, worker
from pcbench.studies.bench.charts import CHARTS

DEEP_JSON = "[" * 100_000 + "]" * 100_000
PLUGIN_SOURCE = """
import time
from dataclasses import dataclass
from pcbench.plugins import Reconstruction
@dataclass(frozen=True)
class Mine:
    seconds: float = 0
    def reconstruct(self, scene, workspace):
        print("at work", flush=True)
        time.sleep(self.seconds)
        return Reconstruction(scene.points, "georeferenced", scene.cameras)
"""


@pytest.fixture
def scene(tmp_path, monkeypatch):
    """Create photos/ with cameras, points and a ground truth, and mine.py, in the current folder."""
    monkeypatch.chdir(tmp_path)
    folder = scene_folders.ten_images_folder(Path("photos"))
    points = Cloud(np.random.default_rng(0).normal(size=(30, 3)))
    write_colmap_model(folder / "sparse", scene_folders.orbit(scene_folders.NAMES), points)
    (folder / "truth").mkdir()
    write_cloud(folder / "truth" / "cloud.ply", points)
    Path("control.txt").write_text("a 0 0 0 0.png 1 1\n")
    Path("mine.py").write_text(PLUGIN_SOURCE)
    return folder


def read_all_files():
    return {path: path.read_bytes() for path in Path().rglob("*") if path.is_file()}


@pytest.mark.parametrize(
    "command",
    [
        "scene photos --figure photos/images/1.png",
        "scene photos --figure photos/sparse/cameras.txt",
        "scene photos --figure control.txt",
        "scene photos --figure elsewhere.png",
        "scene photos --figure new.bmp",
        "scene photos --write-cameras photos/sparse",
        "scene photos --write-cameras photos/transforms.json",
        "scene photos --cameras other.json --write-cameras other.json",
        "reconstruct mine.py:Mine photos -o photos/truth/cloud.ply",
        "reconstruct sfm photos -o control.txt --set control=control.txt",
        "reconstruct mine.py:Mine photos -o model/cameras.txt --write-cameras model",
        "reconstruct mine.py:Mine photos -o c.ply --cameras other.json --write-cameras other.json",
        "register photos/truth/cloud.ply photos/truth/cloud.ply --out x.txt --matrix ./x.txt",
        "convert photos/sparse photos/sparse/points3D.txt",
    ],
)
def test_inputs_are_never_overwritten(scene, run, command):
    import_or_skip("matplotlib")
    Path("elsewhere.png").write_bytes(Path("photos/images/2.png").read_bytes())
    Path("model").mkdir()
    Path("photos/transforms.json").write_text("{}")
    assert run("scene", "photos", "--write-cameras", "other.json", "-q")[0] == 0
    before = read_all_files()
    code, _, err = run(*command.split())
    assert code == 2
    assert is_one_line(err), err
    check_text(err)
    assert read_all_files() == before


def test_a_cloud_in_the_scene_is_replaced_only_if_pcbench_wrote_it(scene, run):
    command = ("reconstruct", "mine.py:Mine", "photos", "-q", "-o", "photos/new.ply")
    for _ in range(2):
        assert run(*command)[0] == 0
    write_cloud("photos/new.ply", Cloud(np.eye(3)))  # now a file of the user
    code, _, err = run(*command)
    assert (code, is_one_line(err)) == (2, True)
    check_text(err)


def test_json_goes_beside_a_report_not_into_it(report, run):
    before = read_all_files()
    code, _, err = run("compare", "ref.ply", "b.ply", "--out", "report", "--json", "report/a_T.txt")
    assert (code, is_one_line(err)) == (2, True)
    check_text(err)
    assert read_all_files() == before


def test_one_run_per_output(scene, run):
    """The next run removes what a killed one left."""
    command = [sys.executable, "-m", "pcbench.cli", "reconstruct", "mine.py:Mine", "photos", "-o", "cloud.ply"]
    process = subprocess.Popen([*command, "--set", "seconds=600"])
    try:
        log = Path("cloud.work/log.txt")
        while process.poll() is None and not (log.exists() and log.read_text()):
            time.sleep(0.05)
        reconstruct = ("reconstruct", "mine.py:Mine", "photos", "-q")
        for arguments in (("-o", "cloud.ply", "--workspace", "w"), ("-o", "c.ply", "--workspace", "cloud.work")):
            code, _, err = run(*reconstruct, *arguments)
            assert (code, is_one_line(err)) == (2, True)
            check_text(err)
        assert list(Path().glob(".pcbench-*"))
        process.send_signal(signal.SIGKILL)
        process.wait()
    finally:
        process.kill()
    assert run(*reconstruct, "-o", "cloud.ply")[0] == 0
    assert len(read_cloud("cloud.ply")) == 30
    assert not list(Path().glob(".pcbench-*"))


def test_two_simultaneous_comparisons_into_one_report_are_refused(files, run, monkeypatch):
    results = []

    def run_again(*_, **__):
        results.append(run("compare", "ref.ply", "b.ply", "--out", "report"))
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("pcbench.measure.pair.register", run_again)
        run("compare", "ref.ply", "a.ply", "--out", "report")
    ((code, _, err),) = results
    assert (code, is_one_line(err)) == (2, True)
    check_text(err)
    assert run("compare", "ref.ply", "b.ply", "--out", "report", "-q")[0] == 0


@pytest.mark.parametrize("size", [1024, 20_000])
@pytest.mark.parametrize(
    ("command", "output"),
    [
        ("convert a.ply x.ply", "x.ply"),
        ("compare ref.ply a.ply --out report --no-figures", "report"),
        ("register ref.ply a.ply --out x.xyz", "x.xyz"),
    ],
)
def test_a_limit_of_file_sizes_names_the_file(files, run, command, output, size):
    before = read_all_files()
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        code, _, err = run(*command.split())
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert code == 2
    assert is_one_line(err), err
    assert err.startswith(f"error: {output}")
    assert "ulimit -f" in err
    assert read_all_files() == before


def test_a_full_standard_output_is_one_line(files):
    command = [sys.executable, "-m", "pcbench.cli", "compare", "ref.ply", "a.ply"]
    with Path("/dev/full").open("w") as device:
        process = subprocess.run(command, stdout=device, stderr=subprocess.PIPE, text=True, check=False)
    assert process.returncode == 2
    assert without_progress(process.stderr) == "error: standard output: No space left on device\n"


@pytest.mark.parametrize(
    "text",
    [
        DEEP_JSON,
        '{"a":' * 100_000 + "1" + "}" * 100_000,
        f'{{"frames": {DEEP_JSON}}}',
        f'{{"cameraFrames": {DEEP_JSON}}}',
    ],
)
def test_too_deeply_nested_json_is_refused(scene, run, text):
    Path("deep.json").write_text(text)
    Path("photos/images/export.json").write_text(text)
    commands = [("scene", "photos", "--cameras", "deep.json")]
    if "cameraFrames" in text:
        commands += [("scene", "photos/images")]
    for command in commands:
        code, out, err = run(*command)
        assert (code, out) == (2, "")
        assert is_one_line(err), err
        check_text(err)


def test_too_many_threads_are_refused(files):
    command = [sys.executable, "-m", "pcbench.cli", "compare", "ref.ply", "a.ply", "-q"]
    environment = {**os.environ, "OMP_NUM_THREADS": "100000"}
    process = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert process.returncode == 2
    assert is_one_line(process.stderr), process.stderr
    assert "OMP_NUM_THREADS=100000" in process.stderr
    process = subprocess.run(
        [sys.executable, "-c", "import pcbench; pcbench.Index"], env=environment, capture_output=True
    )
    assert b"InputError: OMP_NUM_THREADS=100000" in process.stderr


@pytest.mark.long
def test_compare_runs_in_one_gibibyte_of_address_space(files):
    """More threads are requested than fit into the address space; too little memory gives one line."""
    script = "import resource, sys\nresource.setrlimit(resource.RLIMIT_AS, (int(sys.argv[1]) << 20,) * 2)\n"
    script += "sys.argv = 'pcbench compare ref.ply a.ply -q'.split()\nfrom pcbench.cli import main\nmain()\n"
    environment = {**os.environ, "OMP_NUM_THREADS": "64", "OPENBLAS_NUM_THREADS": "64"}
    for mebibytes, code in ((1024, 0), (180, 2)):
        command = [sys.executable, "-c", script, str(mebibytes)]
        process = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
        assert process.returncode == code, process.stderr
        assert code == 0 or is_one_line(process.stderr), process.stderr


def test_a_damaged_report_is_one_line(report, run, monkeypatch, capsys):
    import_or_skip("matplotlib")
    document = Path("report/comparison.json").read_text()
    damaged_documents = [
        document[:100],
        "[]",
        DEEP_JSON,
        document.replace('"percentiles"', '"x"'),
        document.replace('"name": "a"', '"name": 3'),
    ]
    damaged_files = {
        "report/comparison.json": damaged_documents,
        "bench/bench.json": ["[", "[]", '{"schema": 3}', '{"rows": [{}]}', DEEP_JSON],
    }
    Path("bench").mkdir()
    for (path, documents), drawer in zip(damaged_files.items(), (REPORT, CHARTS), strict=True):
        for text in documents:
            Path(path).write_text(text)
            # Call the drawing process's function here, without starting a process.
            monkeypatch.setattr(sys, "argv", ["worker", str(Path(path).parent), drawer.function, "{}"])
            assert worker.main() == 2
            output = capsys.readouterr().out
            assert output.count("\n") == 1
            assert str(Path(path).parent) in output
    with drawing_here():
        code, _, err = run("plot", "bench")
    assert (code, is_one_line(err)) == (2, True)
    check_text(err)


def test_line_breaks_in_names_are_replaced(files, run):
    for name, path in (("ref", "a.ply"), ("a", "b.ply")):
        Path(path).rename(f"{name}\nb|c.ply")
    assert names_of([Path("a\nb.ply"), Path("a_b.ply")]) == ["a_b", "a_b_2"]
    code, out, err = run("compare", "ref\nb|c.ply", "a\nb|c.ply", "--out", "report")
    assert (code, err) == (0, "")
    assert "a_b|c" in out
    table = Path("report/table.md").read_text().splitlines()
    assert "ref?b|c.ply" in table[0]
    header = next(line for line in table if line.startswith("|"))
    assert header.count("|") == 6  # four bars of three columns, and two escaped ones
    assert Path("report/a_b|c_T.txt").is_file()
    assert json.loads(Path("report/comparison.json").read_text())["candidates"][0]["name"] == "a_b|c"


def test_an_endless_import_of_a_plugin_is_stopped(tmp_path, run):
    (tmp_path / "loop.py").write_text("while True:\n    pass\n")
    code, _, err = run("plugins", f"{tmp_path}/loop.py:X", "--time-limit", "1")
    assert code == 2
    assert is_one_line(err)
    assert " 1 s" in check_text(err)


def test_pictures_replace_links_and_leave_their_targets(report, run):
    """A folder from somebody else must not write into the files of its user."""
    import_or_skip("matplotlib")
    Path("report/figures").mkdir(exist_ok=True)
    Path("mine").write_text("mine")
    Path("report/figures/distribution.png").symlink_to(Path("mine").absolute())
    with drawing_here():
        assert run("plot", "report", "distribution")[0] == 0
    assert Path("mine").read_text() == "mine"
    picture = Path("report/figures/distribution.png")
    assert picture.read_bytes().startswith(b"\x89PNG") and not picture.is_symlink()


def test_a_figures_folder_that_is_a_link_is_refused(tmp_path):
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "figures").symlink_to(tmp_path / "elsewhere")
    with check_error():
        worker.draw(tmp_path, CHARTS.function, Figures())


def test_messages_cannot_control_the_terminal(tmp_path, monkeypatch, run):
    monkeypatch.chdir(tmp_path)
    code, _, err = run("info", "no\x1b[31msuch\u202e.ply")
    assert code == 2 and is_one_line(err)
    assert "\x1b" not in err and "\u202e" not in err
    Path("c.csv").write_text("x,y,z,a\x1b[31mred\n0,0,0,1\n1,0,0,2\n0,1,0,3\n")
    code, out, _ = run("info", "c.csv")
    assert code == 0 and "a?[31mred" in out


def test_an_empty_crop_is_reported_with_the_extent_in_the_coordinates_of_the_file(tmp_path, monkeypatch, run):
    monkeypatch.chdir(tmp_path)
    corners = np.array([[0, 0, 0], [10, 10, 2.0]])
    write_cloud("ref.ply", Cloud(np.concatenate([corners, np.random.default_rng(0).uniform(*corners, (500, 3))])))
    for command in ("compare", "deform"):
        code, _, err = run(command, "ref.ply", "ref.ply", "--crop", "sphere:100,100,100,1")
        assert code == 2
        assert "x 0 to 10, y 0 to 10, z 0 to 2" in check_text(err, masked=False)


@pytest.mark.parametrize(
    "changed",
    [
        {"reference": 3},
        {"candidates": ["x"]},
        {"files": 3},
        {"scene": {"path": "a\0b", "cameras": "auto"}},
        {"candidates": [{"name": "a", "path": 3, "sha256": ""}]},
    ],
)
def test_damaged_settings_name_what_is_wrong(changed, report, run):
    settings = json.loads(Path("report/settings.json").read_text())
    Path("changed.json").write_text(json.dumps(settings | changed))
    code, _, err = run("compare", "--settings", "changed.json")
    assert code == 2 and is_one_line(err)
    check_text(err)
