"""A complete bench: each run is a row, and finished runs are reused."""

import csv
import json
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest
from benches import METHODS, OWN, executed_methods, job, run_bench
from html_pages import check_page_of_study, markdown_tables
from optional import import_or_skip
from processes import has_ended
from wording import check_error, check_text

from pcbench import Cloud, write_cloud
from pcbench.errors import MissingExtra
from pcbench.io.colmap_model import write_colmap_model
from pcbench.plugins.run import Description, describe
from pcbench.studies.bench import runs
from pcbench.studies.bench.plan import Axis
from pcbench.studies.bench.results import COLUMNS, KIND
from pcbench.studies.bench.runs import BenchJob
from pcbench.studies.bench.table import notes
from pcbench.tasks import Workers


@pytest.mark.long
def test_each_run_is_a_row(bench_folder, run):
    names = ("Good", "Crash", "Garbage", "Cannot", "Elsewhere", "Missing", "Nobody")
    methods = [word for name in names for word in ("--method", f"methods.py:{name}")]
    sweeps = ("--sweep", "Good.image_scale=0.5,1", "--set", "Good.noise=1", "--seeds", "2", "--threshold", "1px,1")
    code, out, err = run("bench", "photos", "--reference", "truth.ply", *methods, *sweeps, "--out", "out")
    assert (code, err) == (0, "")
    with Path("out/bench.csv").open() as file:
        table = csv.DictReader(file)
        rows = list(table)
    assert tuple(table.fieldnames) == COLUMNS
    assert " ".join(COLUMNS) == (
        "method settings seed status wall_s cpu_s peak_rss_bytes gpu_bytes points registration accuracy_to mean_c2r"
        " mean_c2r_floor mean_r2c mean_r2c_floor d1_c2r d1_r2c chamfer hausdorff threshold pixels precision"
        " precision_floor recall recall_floor fscore recall_visible recall_visible_floor fscore_visible pareto"
        " beside_others message"
    )
    successes, failures = rows[:4], rows[4:]
    assert [(row["settings"], row["seed"]) for row in successes] == [
        (f"noise=1 image_scale={scale}", seed) for scale in ("0.5", "1") for seed in "01"
    ]
    assert {(row["status"], row["registration"], row["points"]) for row in successes} == {("ok", "none", "1000")}
    assert len({row["threshold"] for row in successes}) == 1
    for row in successes:
        assert float(row["wall_s"]) > 0 < float(row["cpu_s"])
        assert 10e6 < int(row["peak_rss_bytes"]) < 10e9
        assert row["gpu_bytes"] == ""
        assert 0 < float(row["recall_visible"]) <= 1
    assert float(successes[0]["fscore"]) > float(successes[2]["fscore"])
    assert successes[2]["d1_c2r"] != successes[3]["d1_c2r"]  # different seeds
    assert [(row["method"], row["status"]) for row in failures] == [
        ("Crash", "crashed"),
        ("Garbage", "garbage"),
        ("Cannot", "failed"),
        ("Elsewhere", "unmeasured"),
        ("Missing", "refused"),
        ("Nobody", "refused"),
    ]
    for row, expected_messages in zip(
        failures,
        ("SIGABRT", "got str", "too few features", "does not overlap", "library is not", "has Cannot"),
        strict=True,
    ):
        assert expected_messages in row["message"]
        assert (row["fscore"], row["pareto"]) == ("", "")
        assert row["message"] in out
    assert "1/10 Good noise=1 image_scale=0.5 seed 0:" in out
    doc = json.loads(Path("out/bench.json").read_text())
    assert doc["schema"] == "pcbench.bench/1"
    assert len(doc["rows"]) == 10
    assert doc["scene"]["sha256"]
    assert doc["reference"]["sha256"]
    assert {"pcbench", "numpy"} <= set(doc["provenance"]["versions"])
    first_row = doc["rows"][0]
    assert first_row["settings"] == {"noise": "1.0", "seed": "0"}
    assert first_row["comparison"]["metrics"]["d1_mse"]["candidate_to_reference"] == first_row["d1_c2r"]
    folder = Path("out") / first_row["folder"]
    assert (folder / "log.txt").read_text() == "a line of mine\n"
    assert (folder / "cloud.ply").is_file()
    assert not (folder / "plugin").exists()
    assert {p.name for p in Path("out/figures").iterdir()} == {"speed.png", "accuracy_completeness.png"}
    lines = Path("out/bench.md").read_text().splitlines()
    assert sum(line.startswith("| Good") for line in lines) == 2 + 2 * 2  # and one per threshold
    assert sum(line.endswith(("(./figures/speed.png)", "(./figures/accuracy_completeness.png)")) for line in lines) == 2
    page = check_page_of_study(Path("out/report.html").read_text(encoding="utf-8"))
    *tables, inputs = page.tables
    assert tables == markdown_tables(Path("out/bench.md").read_text())
    assert [row[0] for row in inputs] == ["input", "scene", "reference"]
    assert doc["reference"]["sha256"] in inputs[2] and len(page.values("src")) == 2
    # `compare` with the same threshold and matrix gives the same score.
    code, text, _ = run(
        "compare",
        "truth.ply",
        folder / "cloud.ply",
        "--register",
        f"matrix:{folder / 'T.txt'}",
        "--json",
        "-",
        "--thresholds",
        first_row["threshold"],
    )
    assert code == 0
    assert json.loads(text)["candidates"][0]["metrics"]["fscore"][-1]["fscore"] == first_row["fscore"]


def test_finished_runs_are_reused(bench_folder, run, in_process):
    command = ("bench", "photos", "--reference", "truth.ply", "--no-figures", "--out", "out")
    command += ("--method", "methods.py:Good", "--method", "methods.py:Cannot", "--sweep")
    assert run(*command, "noise=0.02,1")[0] == 0
    assert executed_methods() == ["Good", "Good", "Cannot"]
    first_table = Path("out/bench.csv").read_text()
    code, out, _ = run(*command, "noise=0.02,1")
    assert code == 0
    assert out.count("(from an earlier bench)") == 3
    assert len(executed_methods()) == 3
    assert Path("out/bench.csv").read_text() == first_table
    # Runs of other settings are not in the tables, and a note says so.
    _, out, _ = run(*command, "noise=1")
    assert len(executed_methods()) == 3
    check_text(next(line for line in out.splitlines() if "out/runs" in line))
    assert len(Path("out/bench.csv").read_text().splitlines()) == 3
    # A new threshold measures again without new runs.
    run(*command, "noise=1", "--threshold", "0.5")
    assert len(executed_methods()) == 3
    with Path("out/bench.csv").open() as file:
        assert [row["threshold"] for row in csv.DictReader(file)] == ["0.5", ""]
    # A changed reconstructor and a changed image need new runs.
    Path("methods.py").write_text(METHODS + "\n# changed\n")
    run(*command, "noise=1")
    assert len(executed_methods()) == 5
    with Path("photos/images/0.png").open("ab") as file:
        file.write(b"\0")
    run(*command, "noise=1")
    assert len(executed_methods()) == 7


@pytest.mark.parametrize("name", ["outcome.json", "cloud.ply", "run.json", "score.json"])
def test_damaged_run_is_repeated(bench_folder, in_process, name):
    first_row = run_bench(job("Good"))["rows"][0]
    for content in (None, "{}") if name == "cloud.ply" else ("[]", "{}"):
        (file,) = Path("out").glob(f"runs/*/{name}")
        file.unlink()
        if content is not None:
            file.write_text(content)
        repeated_row = run_bench(job("Good"))["rows"][0]
        assert (repeated_row["status"], repeated_row["fscore"]) == ("ok", first_row["fscore"])


@pytest.mark.long
def test_method_that_damages_its_folder_is_a_row(bench_folder, monkeypatch):
    actions = (
        "(workspace.parent / 'outcome.json').write_text('{}'); os._exit(0)",
        "(workspace.parent / 'outcome.json').write_text('[]'); os._exit(0)",
        "(workspace.parent / 'outcome.json').write_text('{\"status\": \"ok\"}'); os._exit(0)",
        "(workspace.parent / 'outcome.json').mkdir(); os._exit(0)",
        "shutil.rmtree(workspace.parent); os._exit(0)",
    )
    names = [f"Vandal{number}" for number in range(len(actions))]
    classes = [
        f"@dataclass(frozen=True)\nclass {name}:\n    def reconstruct(self, scene, workspace):\n        {action}\n"
        for name, action in zip(names, actions, strict=True)
    ]
    Path("methods.py").write_text("\n".join(["import shutil", METHODS, *classes]))
    monkeypatch.setattr(runs, "describe", lambda *_: Description())  # importing them is harmless
    rows = run_bench(job(*names, "Good"))["rows"]
    assert [row["status"] for row in rows] == ["crashed"] * len(actions) + ["ok"]


@pytest.mark.long
def test_workers_give_the_same_rows_and_say_that_their_times_differ(bench_folder):
    bench_job = job("Good", "Crash", "Cannot", axes=[Axis.sweep("Good.noise=0.05,1")], seeds=2)
    steps = []
    shared = run_bench(bench_job, Path("shared"), workers=Workers(2), on_step=steps.append)
    assert any(step.startswith("done: ") for step in steps)
    assert sorted(executed_methods()) == ["Cannot", "Crash", *["Good"] * 4]
    alone = run_bench(bench_job, Path("alone"))

    def without_times(row):
        times = (
            "id",
            "wall_s",
            "cpu_s",
            "timings_s",
            "peak_rss_bytes",
            "beside_others",
            "pareto",
            "folder",
            "comparison",
        )
        comparison = row.get("comparison") or {}
        return [{key: value for key, value in of.items() if key not in times} for of in (row, comparison)]

    assert [without_times(row) for row in shared["rows"]] == [without_times(row) for row in alone["rows"]]
    assert {row["beside_others"] for row in shared["rows"]} == {True}
    assert {row["beside_others"] for row in alone["rows"]} == {False}
    (timed,) = set(notes(KIND.read(Path("shared")))) - set(notes(KIND.read(Path("alone"))))
    check_text(timed)
    assert timed in Path("shared/bench.md").read_text()
    # Stored runs are used again without workers.
    again = run_bench(bench_job, Path("shared"))
    assert [row["id"] for row in again["rows"] if row["status"] == "ok"] == [
        row["id"] for row in shared["rows"] if row["status"] == "ok"
    ]


def test_interrupted_bench_is_resumed(bench_folder, in_process):
    class Stop(Exception):
        pass

    def stop(progress):
        if progress.number == 2:
            raise Stop

    bench_job = job("Good", axes=[Axis.sweep("noise=0.02,0.1,1")])
    with pytest.raises(Stop):
        run_bench(bench_job, on_row=stop)
    assert len(json.loads(Path("out/bench.json").read_text())["rows"]) == 2
    reused = []
    doc = run_bench(bench_job, on_row=lambda progress: reused.append(progress.kept))
    assert reused == [True, True, False]
    assert executed_methods() == ["Good"] * 3
    assert len(doc["rows"]) == 3
    shutil.rmtree(Path("out") / doc["rows"][1]["folder"])
    run_bench(bench_job)
    assert executed_methods() == ["Good"] * 4
    # A truncated record is ignored.
    (Path("out") / doc["rows"][0]["folder"] / "run.json").write_text('{"key"')
    run_bench(bench_job)
    assert executed_methods() == ["Good"] * 5


def test_timeout_is_reused_for_shorter_limits(bench_folder, monkeypatch):
    monkeypatch.setattr(runs, "describe", lambda *_: Description())  # importing it may exceed the limit
    first_row = run_bench(job("Hang", time_limit_s=0.2))["rows"][0]
    assert (first_row["status"], first_row["message"]) == ("timeout", "it exceeded the time limit of 0.2 s")
    assert run_bench(job("Hang", time_limit_s=0.1))["rows"][0]["time_limit_s"] == 0.2
    assert run_bench(job("Hang", time_limit_s=0.3))["rows"][0]["time_limit_s"] == 0.3


def test_refused_run_is_repeated(bench_folder, in_process):
    assert run_bench(job("Missing"))["rows"][0]["status"] == "refused"
    Path("installed").touch()
    assert run_bench(job("Missing"))["rows"][0]["status"] == "ok"


@pytest.mark.parametrize("error", [MissingExtra("open3d", "open3d"), MemoryError()])
def test_temporary_measurement_failure_is_retried(bench_folder, in_process, monkeypatch, error):
    original = runs.score
    monkeypatch.setattr(runs, "score", Mock(side_effect=error))
    assert run_bench(job("Good"))["rows"][0]["status"] == "unmeasured"
    monkeypatch.setattr(runs, "score", original)
    assert run_bench(job("Good"))["rows"][0]["status"] == "ok"
    assert executed_methods() == ["Good"]


@pytest.mark.parametrize(
    ("body", "status"),
    [
        ("raise OSError(28, 'No space left on device')", "crashed"),
        ("from pcbench.errors import MissingExtra; raise MissingExtra('x', 'y')", "refused"),
    ],
)
def test_temporary_run_failure_is_retried(bench_folder, in_process, body, status):
    Path("passing.py").write_text(
        METHODS
        + f"""
@dataclass(frozen=True)
class Passing:
    def reconstruct(self, scene, workspace):
        if (HERE / "repaired").exists():
            return Reconstruction(read_cloud(HERE / "made.ply"), "georeferenced")
        {body}
"""
    )
    bench_job = BenchJob(Path("photos"), Path("truth.ply"), ["passing.py:Passing"])
    assert run_bench(bench_job)["rows"][0]["status"] == status
    Path("repaired").touch()
    assert run_bench(bench_job)["rows"][0]["status"] == "ok"


@pytest.mark.parametrize("stop_signal", [signal.SIGINT, pytest.param(signal.SIGKILL, marks=pytest.mark.long)])
def test_stopped_bench_keeps_finished_rows_and_no_process(bench_folder, stop_signal):
    command = [sys.executable, "-m", "pcbench.cli", "bench", "photos", "--reference", "truth.ply", "--out", "out"]
    command += ["--method", "methods.py:Good", "--method", "methods.py:Hang"]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    try:
        pid_file = Path("pid.txt")
        while process.poll() is None and not (pid_file.exists() and pid_file.read_text()):
            time.sleep(0.05)
        child = int(pid_file.read_text())
        process.send_signal(stop_signal)
        _, err = process.communicate()
    finally:
        process.kill()
    if stop_signal == signal.SIGINT:
        # A busy machine also prints progress.
        assert (process.returncode, err.split()[-1]) == (130, "interrupted")
    assert len(Path("out/bench.csv").read_text().splitlines()) == 2
    assert has_ended(child)


def test_bench_without_a_measured_row_is_an_error(bench_folder, run, in_process):
    command = ("bench", "photos", "--reference", "truth.ply", "--no-figures", "--out", "out", "--method")
    for method in ("Cannot", "Elsewhere"):  # a failed run, and a cloud that cannot be measured
        code, out, err = run(*command, f"methods.py:{method}")
        assert code == 2
        check_text(err)
        assert out.splitlines()[-1].startswith("bench: out/ has report.html")
    assert run(*command, "methods.py:Cannot", "--method", "methods.py:Good")[0] == 0


def test_folder_is_locked_by_one_bench(bench_folder, in_process):
    refused = []

    def start_second_bench(step):
        if "seed" in step or "page" in step:  # while a method runs, and while the page is written
            with check_error():
                run_bench(job("Good"))
            refused.append(str(step))

    run_bench(job("Good"), on_step=start_second_bench)
    assert len(refused) == 2
    with check_error():
        run_bench(job("Good"), Path("photos"))
    with check_error():
        run_bench(job("Good"), Path("truth.ply"))


@pytest.mark.parametrize(
    ("body", "limit"), [("import os; os._exit(3)", None), ("import time; time.sleep(600)", 0.5), ("1 / 0", None)]
)
def test_method_that_cannot_be_described_is_a_row(bench_folder, body, limit):
    Path("bad.py").write_text(body)
    description = describe("bad.py:A", limit or 120)
    assert description.problem
    assert description.settings == ()
    bench_job = BenchJob(Path("photos"), Path("truth.ply"), ["bad.py:A"], time_limit_s=limit)
    assert run_bench(bench_job)["rows"][0]["status"] in ("crashed", "timeout", "refused")


def test_gpu_memory_is_that_of_torch(bench_folder, in_process, monkeypatch):
    """A replacement of torch reports its memory, so that no GPU is needed."""

    def return_true():
        return True

    cuda = SimpleNamespace(
        is_available=return_true,
        is_initialized=return_true,
        device_count=lambda: 2,
        max_memory_reserved=lambda device: 1000 + device,
    )
    monkeypatch.setitem(sys.modules, "torch", SimpleNamespace(cuda=cuda))
    assert run_bench(job("Good"))["rows"][0]["gpu_bytes"] == 2001


def test_withheld_cameras_still_register_clouds(bench_folder, in_process):
    """`--cameras none` withholds the cameras from methods; the scene's cameras still register their clouds."""
    frame = np.array2string(OWN.matrix, separator=",")
    Path("own.py").write_text(
        METHODS
        + f"""
from pcbench.geometry.transform import Similarity
from pcbench.geometry.cameras import Camera
from pcbench.scenes import read_scene
@dataclass(frozen=True)
class Own:
    def reconstruct(self, scene, workspace):
        assert not scene.cameras
        frame = Similarity.from_matrix(np.array({frame}))
        found = {{}}
        for name, camera in read_scene(scene.folder.parent).cameras.items():
            rotation = camera.cam_from_world.rotation @ frame.rotation.T
            position = frame.apply(camera.position[None])[0]
            found[name] = Camera(name, camera.intrinsics, Similarity(rotation, -rotation @ position))
        return Reconstruction(Cloud(frame.apply(read_cloud(HERE / "made.ply").points)), "arbitrary", found)
"""
    )
    bench_job = BenchJob(
        Path("photos"), Path("truth.ply"), ["own.py:Own", "methods.py:Good"], [Axis.setting("noise=0")]
    )
    bench_job = replace(bench_job, cameras="none")
    own_row, good_row = run_bench(bench_job)["rows"]
    assert (own_row["status"], own_row["registration"], good_row["registration"]) == ("ok", "cameras", "none")
    assert own_row["d1_c2r"] == pytest.approx(good_row["d1_c2r"], rel=1e-4)  # the matrix is printed with eight digits


@pytest.mark.long
def test_sfm_on_photographs_with_known_truth(tmp_path, run):
    import_or_skip("pycolmap")
    import textured_corner as corner
    from PIL import Image

    intrinsics = corner.standard_intrinsics(320, 240)
    cameras = corner.cameras(5, intrinsics)
    (tmp_path / "photos/images").mkdir(parents=True)
    for camera in cameras:
        Image.fromarray(corner.photograph(camera)).save(tmp_path / "photos/images" / camera.name)
    write_colmap_model(tmp_path / "photos/sparse", cameras)
    rng = np.random.default_rng(0)
    surface_points = rng.uniform(0, corner.SIDE, (30_000, 3))
    surface_points[np.arange(30_000), np.arange(30_000) % 3] = 0
    write_cloud(tmp_path / "truth.ply", Cloud(surface_points, unit="m"))
    command = ("bench", tmp_path / "photos", "--reference", tmp_path / "truth.ply", "--method", "sfm")
    code, _, err = run(
        *command, "--set", "upsample=false", "--sweep", "image_scale=0.5,1", "--threshold", "0.05", "--no-figures",
        "--out", tmp_path / "out",
    )  # fmt: skip
    assert (code, err) == (0, "")
    half_scale, full_scale = json.loads((tmp_path / "out/bench.json").read_text())["rows"]
    assert (half_scale["status"], full_scale["status"]) == ("ok", "ok")
    assert half_scale["wall_s"] > 0
    assert half_scale["points"] < full_scale["points"]
    assert half_scale["fscore"] < full_scale["fscore"]
    assert full_scale["precision"] > 0.9


def test_json_on_standard_output_is_only_the_document(bench_folder, run):
    command = ("bench", "photos", "--reference", "truth.ply", "--method", "methods.py:Good", "--no-figures")
    code, out, err = run(*command, "--out", "out", "--json", "-")
    assert code == 0
    assert out == Path("out/bench.json").read_text()
    assert [row["status"] for row in json.loads(out)["rows"]] == ["ok"]
    assert err.startswith("1/1 ")  # progress
