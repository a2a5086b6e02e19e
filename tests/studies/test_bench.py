"""The bench: what is run, how clouds are brought onto the truth, what is kept, and that no method ends it."""

import csv
import json
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import oracles
import pytest
import shapes
from processes import ends

from pcbench import Cloud, write_cloud
from pcbench.errors import InputError
from pcbench.geometry.cameras import Camera, Intrinsics, look_at
from pcbench.geometry.mesh import Mesh
from pcbench.geometry.transform import Similarity
from pcbench.io.colmap_model import write_colmap_model
from pcbench.plugins import Reconstruction
from pcbench.plugins.run import Description, describe
from pcbench.studies.bench import score as scoring
from pcbench.studies.bench.pareto import configurations, front_of, mark_front, pareto_front
from pcbench.studies.bench.plan import Axis, Method, labels, trials
from pcbench.studies.bench.runs import COLUMNS, BenchJob, bench
from pcbench.studies.bench.score import Rules, alignment, read_truth, seen_points
from pcbench.studies.bench.table import bench_markdown

K = Intrinsics(40, 30, 35, 35, 20, 15)
RIG = [
    Camera(f"{number}.png", K, look_at([20 + 30 * np.cos(a), 20 + 30 * np.sin(a), 25 + number], [20, 20, 3]))
    for number, a in enumerate(np.radians([0, 60, 130, 200, 290]))
]
TRUTH = Cloud(
    shapes.city(10_000, seed=1)[0],
    attributes={"visible": (shapes.city(10_000, seed=1)[0][:, 0] > 10).astype(np.uint8)},
    unit="m",
)
# A frame of its own: another scale, turned, far away.
OWN = Similarity(shapes.rotation([1, 2, 3], 70), np.array([100.0, -50.0, 7.0]), 0.37)

METHODS = """
import os, time
from dataclasses import dataclass
from pathlib import Path
import numpy as np
from pcbench import Cloud, read_cloud
from pcbench.errors import ReconstructionError
from pcbench.plugins import Reconstruction

HERE = Path(__file__).parent

def ran(name):
    with (HERE / "ran.txt").open("a") as file:
        file.write(name + "\\n")

@dataclass(frozen=True)
class Good:
    noise: float = 0.05
    seed: int = 0

    def reconstruct(self, scene, workspace):
        ran("Good")
        print("a line of mine")
        (workspace / "big.bin").write_bytes(bytes(1000))
        points = read_cloud(HERE / "made.ply").points
        noise = np.random.default_rng(self.seed).normal(0, self.noise * scene.image_scale, points.shape)
        return Reconstruction(Cloud(points + noise), "georeferenced", scene.cameras, ["all well"])

@dataclass(frozen=True)
class Crash:
    def reconstruct(self, scene, workspace):
        ran("Crash")
        print("last words", flush=True)
        os.abort()

@dataclass(frozen=True)
class Hang:
    def reconstruct(self, scene, workspace):
        ran("Hang")
        (HERE / "pid.txt").write_text(str(os.getpid()))
        time.sleep(600)

@dataclass(frozen=True)
class Garbage:
    def reconstruct(self, scene, workspace):
        return "a cloud"

@dataclass(frozen=True)
class Cannot:
    def reconstruct(self, scene, workspace):
        raise ReconstructionError("too few features")

@dataclass(frozen=True)
class Elsewhere:
    def reconstruct(self, scene, workspace):
        return Reconstruction(Cloud(read_cloud(HERE / "made.ply").points + 5000), "georeferenced")

@dataclass(frozen=True)
class Missing:
    @classmethod
    def missing(cls):
        return None if (HERE / "installed").exists() else "a library is not installed"

    def reconstruct(self, scene, workspace):
        return Reconstruction(read_cloud(HERE / "made.ply"), "georeferenced")
"""


@pytest.fixture
def here(tmp_path, monkeypatch):
    """A folder with photos/, truth.ply, made.ply and methods.py; the current one."""
    image = pytest.importorskip("PIL.Image")
    (tmp_path / "photos/images").mkdir(parents=True)
    for camera in RIG:
        image.new("RGB", (40, 30), (len(camera.name), 0, 0)).save(tmp_path / "photos/images" / camera.name)
    write_colmap_model(tmp_path / "photos/sparse", RIG)
    write_cloud(tmp_path / "truth.ply", TRUTH)
    write_cloud(tmp_path / "made.ply", Cloud(shapes.city(3000, seed=2)[0]))
    (tmp_path / "methods.py").write_text(METHODS)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def job(*methods, **options):
    return BenchJob(Path("photos"), Path("truth.ply"), [f"methods.py:{name}" for name in methods], **options)


def test_whatever_methods_do_is_a_row(here, run):
    names = ("Good", "Crash", "Hang", "Garbage", "Cannot", "Elsewhere", "Missing", "Nobody")
    methods = [word for name in names for word in ("--method", f"methods.py:{name}")]
    sweeps = ("--sweep", "Good.image_scale=0.5,1", "--set", "Good.noise=1", "--seeds", "2", "--time-limit", "6")
    code, out, err = run("bench", "photos", "--reference", "truth.ply", *methods, *sweeps, "--out", "out")
    assert (code, err) == (0, "")
    with Path("out/bench.csv").open() as file:
        table = csv.DictReader(file)
        rows = list(table)
    assert tuple(table.fieldnames) == COLUMNS
    assert " ".join(COLUMNS) == (
        "method settings seed status wall_s cpu_s peak_rss_bytes gpu_bytes points registration d1_c2r d1_r2c chamfer"
        " hausdorff threshold precision recall fscore recall_visible pareto message"
    )
    good, bad = rows[:4], rows[4:]
    assert [(row["settings"], row["seed"]) for row in good] == [
        (f"noise=1 image_scale={scale}", seed) for scale in ("0.5", "1") for seed in "01"
    ]
    assert {(row["status"], row["registration"], row["points"]) for row in good} == {("ok", "none", "3000")}
    assert len({row["threshold"] for row in good}) == 1
    for row in good:
        assert float(row["wall_s"]) > 0 < float(row["cpu_s"])
        assert 10e6 < int(row["peak_rss_bytes"]) < 10e9
        assert row["gpu_bytes"] == ""
        assert 0 < float(row["recall_visible"]) <= 1
    assert float(good[0]["fscore"]) > float(good[2]["fscore"])
    assert good[2]["d1_c2r"] != good[3]["d1_c2r"]  # of another seed
    assert [(row["method"], row["status"]) for row in bad] == [
        ("Crash", "crashed"),
        ("Hang", "timeout"),
        ("Garbage", "garbage"),
        ("Cannot", "failed"),
        ("Elsewhere", "unmeasured"),
        ("Missing", "refused"),
        ("Nobody", "refused"),
    ]
    for row, words in zip(
        bad,
        ("SIGABRT", "limit of 6 s", "got str", "too few features", "does not overlap", "library is not", "has Cannot"),
        strict=True,
    ):
        assert words in row["message"]
        assert (row["fscore"], row["pareto"]) == ("", "")
        assert words in out
    for line in ("1/11 Good noise=1 image_scale=0.5 seed 0:", "Hang has no setting 'seed': one run instead of 2"):
        assert line in out
    doc = json.loads(Path("out/bench.json").read_text())
    assert doc["schema"] == "pcbench.bench/1"
    assert len(doc["rows"]) == 11
    assert doc["scene"]["sha256"]
    assert doc["reference"]["sha256"]
    assert {"pcbench", "numpy"} <= set(doc["provenance"]["versions"])
    first = doc["rows"][0]
    assert first["settings"] == {"noise": "1.0", "seed": "0"}
    assert first["comparison"]["metrics"]["d1_mse"]["candidate_to_reference"] == first["d1_c2r"]
    folder = Path("out") / first["folder"]
    assert (folder / "log.txt").read_text() == "a line of mine\n"
    assert (folder / "cloud.ply").is_file()
    assert not (folder / "plugin").exists()
    assert {p.name for p in Path("out/figures").iterdir()} == {"speed.png", "accuracy_completeness.png"}
    with Path("out/bench.md").open() as file:
        assert sum(line.startswith("| Good") for line in file) == 2
    # The same threshold, registration and matrix by the other command.
    code, text, _ = run(
        "compare", "truth.ply", folder / "cloud.ply", "--register", f"matrix:{folder / 'T.txt'}", "--json", "-"
    )
    assert code == 0
    assert json.loads(text)["candidates"][0]["metrics"]["fscore"][-1]["fscore"] == first["fscore"]


def counted():
    path = Path("ran.txt")
    return path.read_text().split() if path.exists() else []


def test_done_rows_are_kept(here, run):
    command = ("bench", "photos", "--reference", "truth.ply", "--no-figures", "--out", "out")
    command += ("--method", "methods.py:Good", "--method", "methods.py:Crash", "--sweep")
    assert run(*command, "noise=0.02,1")[0] == 0
    assert counted() == ["Good", "Good", "Crash"]
    before = Path("out/bench.csv").read_text()
    code, out, _ = run(*command, "noise=0.02,1")
    assert code == 0
    assert out.count("(done before)") == 3
    assert len(counted()) == 3
    assert Path("out/bench.csv").read_text() == before
    # Fewer rows: the others are not in the tables, which is said.
    _, out, _ = run(*command, "noise=1")
    assert len(counted()) == 3
    assert "1 runs in out/runs are of other settings" in out
    assert len(Path("out/bench.csv").read_text().splitlines()) == 3
    # Another threshold measures again, and runs nothing.
    run(*command, "noise=1", "--threshold", "0.5")
    assert len(counted()) == 3
    with Path("out/bench.csv").open() as file:
        assert [row["threshold"] for row in csv.DictReader(file)] == ["0.5", ""]
    # Another reconstructor under the same name, and another image.
    Path("methods.py").write_text(METHODS + "\n# changed\n")
    run(*command, "noise=1")
    assert len(counted()) == 5
    with Path("photos/images/0.png").open("ab") as file:
        file.write(b"\0")
    run(*command, "noise=1")
    assert len(counted()) == 7


@pytest.mark.parametrize("name", ["outcome.json", "cloud.ply", "run.json", "score.json"])
@pytest.mark.parametrize("content", [None, "[]", "{}"])
def test_a_damaged_run_is_made_again(here, name, content):
    whole = BenchJob(Path("photos"), Path("truth.ply"), ["methods.py:Good"])
    first = bench(whole, Path("out"))["rows"][0]
    (file,) = Path("out").glob(f"runs/*/{name}")
    file.unlink()
    if content is not None:
        file.write_text(content)
    again = bench(whole, Path("out"))["rows"][0]
    assert (again["status"], again["fscore"]) == ("ok", first["fscore"])


@pytest.mark.parametrize(
    "deed",
    [
        "(workspace.parent / 'outcome.json').write_text('{}'); os._exit(0)",
        "(workspace.parent / 'outcome.json').write_text('[]'); os._exit(0)",
        "(workspace.parent / 'outcome.json').write_text('{\"status\": \"ok\"}'); os._exit(0)",
        "(workspace.parent / 'outcome.json').mkdir(); os._exit(0)",
        "shutil.rmtree(workspace.parent); os._exit(0)",
    ],
)
def test_a_method_that_breaks_its_folder_is_a_row(here, deed):
    Path("vandal.py").write_text(
        METHODS
        + f"""
import os, shutil
@dataclass(frozen=True)
class Vandal:
    def reconstruct(self, scene, workspace):
        {deed}
"""
    )
    whole = BenchJob(Path("photos"), Path("truth.ply"), ["vandal.py:Vandal", "methods.py:Good"])
    assert [row["status"] for row in bench(whole, Path("out"))["rows"]] == ["crashed", "ok"]


def test_an_interrupted_bench_goes_on(here):
    class Stop(Exception):
        pass

    def stop(done):
        if done.number == 2:
            raise Stop

    whole = job("Good", axes=[Axis.sweep("noise=0.02,0.1,1")])
    with pytest.raises(Stop):
        bench(whole, Path("out"), on_row=stop)
    assert len(json.loads(Path("out/bench.json").read_text())["rows"]) == 2
    kept = []
    doc = bench(whole, Path("out"), on_row=lambda done: kept.append(done.kept))
    assert kept == [True, True, False]
    assert counted() == ["Good"] * 3
    assert len(doc["rows"]) == 3
    shutil.rmtree(Path("out") / doc["rows"][1]["folder"])
    bench(whole, Path("out"))
    assert counted() == ["Good"] * 4
    # A half-written record is none.
    (Path("out") / doc["rows"][0]["folder"] / "run.json").write_text('{"key"')
    bench(whole, Path("out"))
    assert counted() == ["Good"] * 5


def test_a_timeout_stands_for_shorter_limits_and_a_refusal_for_none(here):
    assert bench(job("Hang", time_limit_s=1.5), Path("out"))["rows"][0]["status"] == "timeout"
    assert bench(job("Hang", time_limit_s=1), Path("out"))["rows"][0]["time_limit_s"] == 1.5
    assert bench(job("Hang", time_limit_s=2), Path("out"))["rows"][0]["time_limit_s"] == 2
    assert bench(job("Missing"), Path("other"))["rows"][0]["status"] == "refused"
    Path("installed").touch()
    assert bench(job("Missing"), Path("other"))["rows"][0]["status"] == "ok"


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGKILL])
def test_a_stopped_bench_leaves_what_is_done_and_nothing_running(here, how):
    command = [sys.executable, "-m", "pcbench.cli", "bench", "photos", "--reference", "truth.ply", "--out", "out"]
    command += ["--method", "methods.py:Good", "--method", "methods.py:Hang"]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    try:
        for _ in range(600):
            if Path("pid.txt").exists() and Path("pid.txt").read_text():
                break
            time.sleep(0.1)
        child = int(Path("pid.txt").read_text())
        process.send_signal(how)
        _, err = process.communicate(timeout=60)
    finally:
        process.kill()
    if how == signal.SIGINT:
        assert (process.returncode, err.strip()) == (130, "interrupted")
    assert len(Path("out/bench.csv").read_text().splitlines()) == 2
    assert ends(child)


def test_one_bench_a_folder(here):
    inside = []

    def again(_):
        with pytest.raises(InputError, match="another bench is at work"):
            bench(job("Good"), Path("out"))
        inside.append(True)

    bench(job("Good"), Path("out"), on_row=again)
    assert inside
    with pytest.raises(InputError, match="not empty and holds no bench"):
        bench(job("Good"), Path("photos"))
    with pytest.raises(InputError, match="got a file"):
        bench(job("Good"), Path("truth.ply"))


@pytest.mark.parametrize(
    "arguments, message",
    [
        (("--sweep", "image_scale"), "expected --sweep [METHOD.]KEY=VALUE,VALUE,..., got 'image_scale'"),
        (("--sweep", "image_scale=0.5,"), "expected --sweep"),
        (("--sweep", "=1"), "expected --sweep"),
        (("--sweep", "image_scale=0.5,two"), "expected image scales above 0 and up to 1, got 'two'"),
        (("--sweep", "image_scale=2"), "got '2'"),
        (("--sweep", "noise=1,1"), "a value is there twice"),
        (("--sweep", "noise=1", "--set", "noise=2"), "noise is given twice"),
        (("--sweep", "seed=1,2"), "seeds are 0 to N-1 by --seeds N"),
        (("--set", "noise"), "expected --set [METHOD.]KEY=VALUE"),
        (("--sweep", "size=1,2"), "no method has the setting 'size': Good has noise, seed; the scene has image_scale"),
        (("--sweep", "Bad.noise=1"), "there is no method 'Bad' in this bench: there are Good"),
        (("--method", "methods.py:Good"), "is there twice"),
        (("--register", "nonsense"), "unknown registration 'nonsense': expected gauge, icp,"),
        (("--register", "matrix:nowhere.txt"), "nowhere.txt: cannot read a matrix"),
        (("--register", "points:nowhere.txt"), "nowhere.txt"),
        (("--crop", "box:1,2"), "box"),
        (("--crop", "box:900,900,900,901,901,901"), "leaves none of the reference's 10000 points"),
        (("--seeds", "0"), "0 is not in the range"),
        (("--sweep", f"noise={','.join(map(str, range(101)))}", "--seeds", "100"), "10,100 runs are asked for"),
        (("--threshold", "nan"), "nan is not a finite number"),
        (("--time-limit", "inf"), "inf is not a finite number"),
        (("--reference", "nowhere.ply"), "nowhere.ply"),
    ],
)
def test_mistakes_are_said_before_anything_runs(here, run, arguments, message):
    command = ("bench", "photos", "--reference", "truth.ply", "--method", "methods.py:Good", "--out", "out")
    code, out, err = run(*command, *arguments)
    assert (code, out) == (2, "")
    assert err.count("\n") == 1
    assert message in err
    assert counted() == []


def test_no_method_is_a_mistake(here, run):
    assert "at least one --method" in run("bench", "photos", "--reference", "truth.ply", "--out", "out")[2]


def method(label, *settings, problem=None):
    return Method(label, f"x.py:{label}", Description(settings, problem=problem))


def test_the_product_of_sweeps():
    a, b, unknown = method("A", "n", "seed"), method("B", "n", "m"), method("C", problem="it cannot be imported")
    axes = [Axis.sweep("image_scale=0.5,1"), Axis.sweep("n=1,2"), Axis.sweep("B.m=x,y"), Axis.fixed("A.n=7,8")]
    found, notes = trials([a, b, unknown], axes, 2)
    said = [trial.words for trial in found]
    assert said[:4] == [f"A image_scale={s} n=7,8 seed {k}" for s in ("0.5", "1") for k in (0, 1)]
    assert said[4:12] == [f"B image_scale={s} n={n} m={m}" for s in ("0.5", "1") for n in "12" for m in "xy"]
    assert said[12:] == ["C image_scale=0.5", "C image_scale=1"]
    assert found[1].settings == {"n": "7,8", "seed": "1"}
    assert found[1].image_scale == 0.5
    assert found[4].settings == {"n": "1", "m": "x"}
    assert "B has no setting 'seed': one run instead of 2" in notes
    assert "C has no setting 'n': its runs do not vary with it" in notes
    assert labels(["sfm", "a/one.py:M", "two.py:M"]) == ["sfm", "a/one.py:M", "two.py:M"]
    assert labels(["sfm", "a/one.py:M"]) == ["sfm", "M"]


@pytest.mark.parametrize("body", ["import os; os._exit(3)", "import time; time.sleep(60)", "1 / 0"])
def test_a_method_that_cannot_be_looked_at_is_a_row(here, body):
    Path("bad.py").write_text(body)
    described = describe("bad.py:A", 5)
    assert described.problem
    assert described.settings == ()
    whole = BenchJob(Path("photos"), Path("truth.ply"), ["bad.py:A"], time_limit_s=2)
    assert bench(whole, Path("out"))["rows"][0]["status"] in ("crashed", "timeout", "refused")


def test_gpu_memory_is_what_torch_held(here):
    """There need be no GPU: a torch of our own says what it held."""
    Path("gpu.py").write_text(
        METHODS
        + """
import sys, types
class cuda:
    is_available = is_initialized = staticmethod(lambda: True)
    device_count = staticmethod(lambda: 2)
    max_memory_reserved = staticmethod(lambda device: 1000 + device)
sys.modules["torch"] = types.SimpleNamespace(cuda=cuda)
"""
    )
    whole = BenchJob(Path("photos"), Path("truth.ply"), ["gpu.py:Good"])
    assert bench(whole, Path("out"))["rows"][0]["gpu_bytes"] == 2001


# ---- the Pareto front ----


@pytest.mark.parametrize("seed", range(5))
def test_the_front_is_what_nothing_beats(seed):
    costs = np.random.default_rng(seed).integers(0, 6, (40, 2)).astype(float)  # with ties and duplicates
    expected = []
    for a in costs:
        beaten = False
        for b in costs:
            if b[0] <= a[0] and b[1] <= a[1] and (b[0] < a[0] or b[1] < a[1]):
                beaten = True
        expected.append(not beaten)
    assert pareto_front(costs).tolist() == expected


def row(method, wall_s, fscore, status="ok", seed=0, **more):
    scored = {"fscore": fscore, "chamfer": 1 - (fscore or 0)} if status == "ok" else {}
    return {"method": method, "choices": {}, "seed": seed, "status": status, "wall_s": wall_s, **scored, **more}


def test_the_front_is_of_medians_over_seeds():
    rows = [
        *(row("slow", 10.0, f, seed=k) for k, f in enumerate((0.8, 0.9, 0.1))),  # median 0.8
        *(row("fast", t, 0.5, seed=k) for k, t in enumerate((1.0, 2.0, 90.0))),  # median 2
        row("worse", 3.0, 0.4),
        row("lucky", 11.0, 0.79),
        row("dead", 0.1, None, "crashed"),
    ]
    mark_front(rows)
    assert [r["pareto"] for r in rows] == [True] * 6 + [False, False, None]
    found = configurations(rows)
    assert [c.method for c in found] == ["slow", "fast", "worse", "lucky", "dead"]
    assert [c.method for c in front_of(found, "chamfer", high=False)] == ["fast", "slow"]
    assert front_of(found[-1:], "fscore", high=True) == []


def test_what_one_of_three_seeds_scores_is_no_choice():
    rows = [row("sure", 2.0, 0.5), row("lucky", 1.0, 0.9), row("lucky", 1.0, None, "failed", seed=1)]
    mark_front(rows)
    assert [r["pareto"] for r in rows] == [True, False, None]


def test_best_and_second_are_marked():
    rows = [row("a", 1.0, 0.5), row("b", 2.0, 0.9), row("c", 3.0, 0.7), row("d", 0.1, None, "failed", message="no")]
    for r in rows:
        r |= {"registration": "none", "points": 10, "threshold": 0.1}
    mark_front(rows)
    doc = {
        "scene": {"path": "s"},
        "reference": {"path": "r", "unit": "m", "visible_share": None, "visibility": ""},
        "rows": rows,
        "notes": ["a note"],
    }
    lines = {line.split("|")[1].strip(): line for line in bench_markdown(doc).splitlines() if line.startswith("|")}
    assert "**1**" in lines["a"]
    assert "_2_" in lines["b"]
    assert "**0.9**" in lines["b"]
    assert "_0.7_" in lines["c"]
    assert "*" not in lines["c"].replace("_0.7_", "")
    assert "0 of 1 ok, failed" in lines["d"]
    assert "d, seed 0: failed: no" in bench_markdown(doc)


# ---- gauges ----


def made_of(points, gauge, frame=None, cameras=RIG):
    """A reconstruction whose world is `frame` of the true one."""
    frame = frame or Similarity.identity()
    moved = {}
    for camera in cameras:
        rotation = camera.cam_from_world.rotation @ frame.rotation.T
        position = frame.apply(camera.position[None])[0]
        moved[camera.name] = Camera(camera.name, K, Similarity(rotation, -rotation @ position))
    return Reconstruction(Cloud(frame.apply(points)), gauge, moved)


@pytest.fixture
def truth(here):
    return read_truth(here / "truth.ply", None, {camera.name: camera for camera in RIG}, print)


POINTS = shapes.city(3000, seed=2)[0]


def test_an_arbitrary_gauge_is_registered_by_cameras(truth, tmp_path):
    straight = scoring.score(truth, made_of(POINTS, "georeferenced"), Rules(), tmp_path)
    values = scoring.score(truth, made_of(POINTS, "arbitrary", OWN), Rules(), tmp_path)
    assert values["registration"] == "cameras"
    for key in ("d1_c2r", "d1_r2c", "fscore", "recall_visible", "chamfer"):
        assert values[key] == pytest.approx(straight[key], rel=1e-6)
    T = np.array([[float(w) for w in line.split()] for line in (tmp_path / "T.txt").read_text().splitlines()])
    np.testing.assert_allclose(T, OWN.inverse().matrix, atol=1e-9 * 300)
    # A camera that is wrong does not pull.
    wrong = made_of(POINTS, "arbitrary", OWN)
    cameras = dict(wrong.cameras)
    camera = cameras["2.png"].cam_from_world
    cameras["2.png"] = Camera("2.png", K, Similarity(camera.rotation, camera.translation + 5))
    found = alignment(Reconstruction(wrong.cloud, "arbitrary", cameras), truth.cameras)
    moved = found.transform.apply(wrong.cloud.points)
    assert np.linalg.norm(moved - POINTS, axis=1).max() < 0.2  # least squares would be off by metres


def test_errors_of_a_georeferenced_cloud_are_not_fitted_away(truth, tmp_path):
    made = made_of(POINTS + [0, 0, 1.5], "georeferenced")
    values = scoring.score(truth, made, Rules(), tmp_path)
    assert values["registration"] == "none"
    distances = oracles.nearest(made.cloud.points, TRUTH.points)[0]
    assert values["d1_c2r"] == pytest.approx(np.mean(distances**2), rel=1e-9)
    assert values["d1_c2r"] > 0.2
    fitted = scoring.score(truth, made, Rules(register="icp"), tmp_path)
    assert fitted["registration"] == "icp"
    assert fitted["d1_c2r"] < 0.2 * values["d1_c2r"]


def test_a_metric_cloud_gets_no_scale(truth, tmp_path):
    rigid = Similarity(OWN.rotation, OWN.translation)
    exact = scoring.score(truth, made_of(POINTS, "metric", rigid), Rules(), tmp_path)
    centre = POINTS.mean(axis=0)
    larger = made_of(POINTS, "metric", Similarity(np.eye(3), -0.05 * centre, 1.05))
    values = scoring.score(truth, larger, Rules(), tmp_path)
    assert (exact["registration"], values["registration"]) == ("cameras", "cameras")
    assert exact["comparison"]["registration"]["scale"] == pytest.approx(1, abs=1e-9)
    assert values["comparison"]["registration"]["scale"] == 1
    assert values["d1_c2r"] > 2 * exact["d1_c2r"]


def test_without_cameras_the_surfaces_decide(truth, tmp_path, monkeypatch):
    cloud = Reconstruction(Cloud(POINTS), "arbitrary")
    assert alignment(cloud, truth.cameras).how in ("global-similarity", "similarity")
    monkeypatch.setattr(scoring, "find_spec", lambda name: None)
    assert alignment(Reconstruction(Cloud(POINTS), "metric"), truth.cameras).how == "icp"
    found = alignment(cloud, truth.cameras)
    assert found.how == "similarity"
    assert "kiss-matcher is not installed" in found.notes[0]
    near = Similarity(shapes.rotation([0, 0, 1], 1.0), np.array([0.1, 0.2, 0.0]), 1.02)
    values = scoring.score(truth, made_of(POINTS, "arbitrary", near, cameras=()), Rules(), tmp_path)
    assert values["registration"] == "similarity"
    assert values["comparison"]["registration"]["scale"] == pytest.approx(1 / 1.02, rel=2e-3)
    # Two cameras, or cameras on one line, fix no similarity: said, and the surfaces decide.
    two = alignment(made_of(POINTS, "arbitrary", OWN, cameras=RIG[:2]), truth.cameras)
    assert two.how == "similarity"
    assert "not registered by cameras: expected at least 3 pairs" in two.notes[0]


def test_with_cameras_withheld_they_still_register(here):
    """--cameras none is what methods get; the truth is what the scene has."""
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
    whole = BenchJob(Path("photos"), Path("truth.ply"), ["own.py:Own", "methods.py:Good"], [Axis.fixed("noise=0")])
    whole = BenchJob(**{**whole.__dict__, "cameras": "none"})
    own, good = bench(whole, Path("out"))["rows"]
    assert (own["status"], own["registration"], good["registration"]) == ("ok", "cameras", "none")
    assert own["d1_c2r"] == pytest.approx(good["d1_c2r"], rel=1e-4)  # printed with eight digits


# ---- what the cameras saw ----


def test_recall_of_the_visible_part(truth, tmp_path):
    part = POINTS[POINTS[:, 0] > 15]
    rules = Rules(threshold=0.7, crop="box:5,5,-5,35,35,50")
    values = scoring.score(truth, made_of(part, "georeferenced"), rules, tmp_path)
    near = oracles.nearest(TRUTH.points, part)[0] <= 0.7
    inside = ((TRUTH.points >= [5, 5, -5]) & (TRUTH.points <= [35, 35, 50])).all(axis=1)
    visible = TRUTH.attributes["visible"] != 0
    assert values["recall"] == pytest.approx(near[inside].mean(), abs=1e-12)
    assert values["recall_visible"] == pytest.approx(near[inside & visible].mean(), abs=1e-12)
    assert values["recall_visible"] > values["recall"] + 0.05


def wall_and_ground():
    """A ground of 40 m and a wall across it that hides a part of it from each side."""
    vertices = np.array(
        [[0, 0, 0], [40, 0, 0], [40, 40, 0], [0, 40, 0], [20, 5, 0], [20, 35, 0], [20, 35, 9], [20, 5, 9]], float
    )
    return Mesh(vertices, np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]]))


def test_visibility_by_rays_is_that_of_brute_force():
    mesh = wall_and_ground()
    sample = mesh.sample(500, seed=3)
    cameras = {camera.name: camera for camera in RIG}
    found = seen_points(Cloud(sample.points + 0.001 * sample.normals), mesh, cameras)
    counts = np.zeros(len(sample), dtype=int)
    for camera in RIG:
        pixels, depths = camera.project(sample.points)
        framed = (depths > 0) & (pixels >= 0).all(axis=1) & (pixels < [K.width, K.height]).all(axis=1)
        lines = camera.position - sample.points
        facing = (lines * sample.normals).sum(axis=1) > 0
        distances = oracles.first_hits(sample.points + 1e-5 * sample.normals, lines, mesh.vertices, mesh.faces)
        counts += framed & facing & ~(distances < 1)
    np.testing.assert_array_equal(found, counts >= 3)
    assert 0.1 < found.mean() < 0.9


def test_where_visibility_comes_from(here):
    cameras = {camera.name: camera for camera in RIG}
    by_attribute = read_truth(Path("truth.ply"), None, cameras, print)
    np.testing.assert_array_equal(by_attribute.visible, TRUTH.attributes["visible"] != 0)
    mesh = wall_and_ground()
    sample = mesh.sample(800)
    write_cloud("bare.ply", Cloud(sample.points))
    assert read_truth(Path("bare.ply"), None, cameras, print).visible is None
    lines = [" ".join(map(str, v)) for v in mesh.vertices] + [f"3 {a} {b} {c}" for a, b, c in mesh.faces]
    Path("wall.off").write_text(f"OFF\n{len(mesh.vertices)} {len(mesh)} 0\n" + "\n".join(lines) + "\n")
    by_rays = read_truth(Path("bare.ply"), Path("wall.off"), cameras, print)
    np.testing.assert_array_equal(by_rays.visible, seen_points(Cloud(sample.points), mesh, cameras))
    assert "rays against wall.off" in by_rays.visibility
    of_mesh = read_truth(Path("wall.off"), None, cameras, print)
    assert of_mesh.visible.mean() == pytest.approx(by_rays.visible.mean(), abs=0.06)
    assert read_truth(Path("wall.off"), None, {}, print).visible is None
    write_cloud("dark.ply", Cloud(sample.points, attributes={"visible": np.zeros(800, np.uint8)}))
    dark = read_truth(Path("dark.ply"), None, cameras, print)
    assert dark.visible is None
    assert "none of its points is visible" in dark.visibility


# ---- whole ----


def test_sfm_on_photographs_whose_truth_is_known(tmp_path, run):
    pytest.importorskip("pycolmap")
    import textured_corner as corner
    from PIL import Image

    lens = corner.standard_intrinsics(320, 240)
    cameras = corner.cameras(5, lens)
    (tmp_path / "photos/images").mkdir(parents=True)
    for camera in cameras:
        Image.fromarray(corner.photograph(camera)).save(tmp_path / "photos/images" / camera.name)
    write_colmap_model(tmp_path / "photos/sparse", cameras)
    rng = np.random.default_rng(0)
    planes = rng.uniform(0, corner.SIDE, (30_000, 3))
    planes[np.arange(30_000), np.arange(30_000) % 3] = 0
    write_cloud(tmp_path / "truth.ply", Cloud(planes, unit="m"))
    command = ("bench", tmp_path / "photos", "--reference", tmp_path / "truth.ply", "--method", "sfm")
    code, _, err = run(
        *command, "--set", "upsample=false", "--sweep", "image_scale=0.5,1", "--threshold", "0.05", "--no-figures",
        "--out", tmp_path / "out",
    )  # fmt: skip
    assert (code, err) == (0, "")
    half, full = json.loads((tmp_path / "out/bench.json").read_text())["rows"]
    assert (half["status"], full["status"]) == ("ok", "ok")
    assert half["wall_s"] > 0
    assert half["points"] < full["points"]
    assert half["fscore"] < full["fscore"]
    assert full["precision"] > 0.9


def test_the_demo_says_why_it_has_no_bench(monkeypatch):
    from pcbench.studies.bench import demo

    monkeypatch.setattr(demo, "find_spec", lambda name: None)
    assert demo.why_not() == "pycolmap is needed for the bench: pip install 'pcbench[plot,sfm]'"


def test_the_demo_removes_nothing_but_its_own(tmp_path):
    from pcbench.studies.bench.demo import demo_job

    (tmp_path / "city").mkdir()
    mine = tmp_path / "city" / "mine.txt"
    mine.write_text("mine")
    with pytest.raises(InputError, match="empty"):
        demo_job(tmp_path / "city", 0, lambda _: None)
    assert mine.read_text() == "mine"


@pytest.mark.slow
def test_the_demo_ends_with_a_bench(tmp_path, run):
    pytest.importorskip("pycolmap")
    code, out, _ = run("demo", "--points", 20_000, "--out", tmp_path / "demo")
    assert code == 0
    rows = json.loads((tmp_path / "demo/bench/bench.json").read_text())["rows"]
    assert [r["status"] for r in rows] == ["ok"] * 4
    assert rows[3]["fscore"] > 0.5
    assert (tmp_path / "demo/bench/figures/speed.png").is_file()
    code, out, _ = run("demo", "--points", 20_000, "--out", tmp_path / "demo", "--no-figures")
    assert out.count("(done before)") == 4  # the same city, byte for byte
