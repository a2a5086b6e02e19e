"""A small scene for benches, reconstructors that work or fail in different ways, and helpers."""

from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import shapes

from pcbench import Cloud
from pcbench.geometry.cameras import Camera, Intrinsics, look_at
from pcbench.geometry.transform import Similarity
from pcbench.plugins import Reconstruction
from pcbench.studies.bench.pareto import with_front
from pcbench.studies.bench.results import KIND, Bench, BenchInput, BenchReference, BenchRow, RunRecord, Score
from pcbench.studies.bench.runs import BenchJob, bench

K = Intrinsics(40, 30, 35, 35, 20, 15)
RIG = [
    Camera(f"{number}.png", K, look_at([20 + 30 * np.cos(a), 20 + 30 * np.sin(a), 25 + number], [20, 20, 3]))
    for number, a in enumerate(np.radians([0, 60, 130, 200, 290]))
]
TRUTH = Cloud(
    shapes.city(4_000, seed=1)[0],
    attributes={"visible": (shapes.city(4_000, seed=1)[0][:, 0] > 10).astype(np.uint8)},
    unit="m",
)
# Another coordinate frame: scaled, rotated and far away.
OWN = Similarity(shapes.rotation([1, 2, 3], 70), np.array([100.0, -50.0, 7.0]), 0.37)

# Reconstructors that succeed, fail or hang.
METHODS = """
import os, time
from dataclasses import dataclass
from dataclasses import fields, replace
from pathlib import Path
import numpy as np
from pcbench import Cloud, read_cloud
from pcbench.errors import ReconstructionError
from pcbench.plugins import Reconstruction

HERE = Path(__file__).parent

def record_run(name):
    with (HERE / "ran.txt").open("a") as file:
        file.write(name + "\\n")

@dataclass(frozen=True)
class Good:
    noise: float = 0.05
    seed: int = 0

    def reconstruct(self, scene, workspace):
        record_run("Good")
        print("a line of mine")
        (workspace / "big.bin").write_bytes(bytes(1000))
        points = read_cloud(HERE / "made.ply").points
        noise = np.random.default_rng(self.seed).normal(0, self.noise * scene.image_scale, points.shape)
        return Reconstruction(Cloud(points + noise), "georeferenced", scene.cameras, ["all well"])

@dataclass(frozen=True)
class Crash:
    def reconstruct(self, scene, workspace):
        record_run("Crash")
        print("last words", flush=True)
        os.abort()

@dataclass(frozen=True)
class Hang:
    def reconstruct(self, scene, workspace):
        record_run("Hang")
        (HERE / "pid.txt").write_text(str(os.getpid()))
        time.sleep(600)

@dataclass(frozen=True)
class Garbage:
    def reconstruct(self, scene, workspace):
        return "a cloud"

@dataclass(frozen=True)
class Cannot:
    def reconstruct(self, scene, workspace):
        record_run("Cannot")
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
POINTS = shapes.city(2000, seed=2)[0]


def job(*methods, **options):
    """Bench job for the current folder of the fixture `bench_folder`."""
    return BenchJob(Path("photos"), Path("truth.ply"), [f"methods.py:{name}" for name in methods], **options)


def run_bench(bench_job, out=Path("out"), **options):
    """Run a bench without charts, and return its document."""
    return KIND.values(bench(bench_job, out, figures=False, **options).study)


def executed_methods():
    """Names of the methods that have run, in order."""
    path = Path("ran.txt")
    return path.read_text().split() if path.exists() else []


def row(method, wall_s, fscore, status="ok", seed=0, **entries):
    """Row of a bench with the entries that tables and fronts use; others are None or empty."""
    values = {
        "id": "",
        "settings": {},
        "reconstruction_notes": (),
        "beside_others": False,
        "accuracy_to": "",
        "comparison": {},
    }
    values |= {"chamfer": 1 - (fscore or 0), "thresholds": (), "notes": (), "message": "", "registration": "none"}
    values |= {"status": status, "wall_s": wall_s, "fscore": fscore, **entries}
    record, score = (kind(**{item.name: values.get(item.name) for item in fields(kind)}) for kind in (RunRecord, Score))
    return BenchRow(method, entries.get("choices", {}), seed, record, "", score if status == "ok" else None)


def study(rows, name="r", scene="s", **changes):
    """Bench of rows."""
    reference = BenchReference(name, "b" * 64, 100, "m", None, None, "", None, None, None)
    return replace(Bench(BenchInput(scene, "a" * 64), reference, (), {}, {}, (), with_front(rows)), **changes)


def reconstruction_in(points, gauge, frame=None, cameras=RIG):
    """Reconstruction in a frame that `frame` maps the true one to."""
    frame = frame or Similarity.identity()
    moved_cameras = {}
    for camera in cameras:
        rotation = camera.cam_from_world.rotation @ frame.rotation.T
        position = frame.apply(camera.position[None])[0]
        moved_cameras[camera.name] = Camera(camera.name, K, Similarity(rotation, -rotation @ position))
    return Reconstruction(Cloud(frame.apply(points)), gauge, moved_cameras)
