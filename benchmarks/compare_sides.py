"""The sides of benchmarks/compare.py: the same comparison by pcbench, a plain Open3D script, and CloudCompare.

Each side runs in a separate process: `python benchmarks/compare_sides.py SIDE FOLDER` reads `reference.ply` and the
other PLY files of the folder, compares them, and prints times, peak memory and metrics as JSON.
"""

from __future__ import annotations

import importlib.util
import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

NAMES = {"ours": "pcbench", "open3d": "Open3D", "cloudcompare": "CloudCompare"}
STEPS = ("import", "read", "index, normals", "registration", "distances, metrics", "total")
METRICS = ("d1", "d2", "hausdorff", "chamfer")

# What the sides compute in the times of the table.
SCOPE = {
    "registration": ("point-to-plane ICP, assessed", "point-to-plane ICP", "point-to-point ICP of 20,000 points"),
    "normals": ("20 neighbours", "20 neighbours", "a sphere of about 16 points"),
    "D1, Chamfer, Hausdorff": ("float64", "float64", "float32, from saved distances"),
    "D2": ("yes", "yes", "no"),
    "sampling floors, 95 % intervals": ("yes", "no", "no"),
    "area-weighted means, presets": ("yes", "no", "no"),
    "verdict on deformation": ("yes", "no", "no"),
}


Seconds = tuple[float, float]  # wall and CPU


class Clock:
    """Wall and CPU seconds of named steps; steps of one name are added.

    Args:
        cpu: returns the CPU seconds of the measured process; default: those of this process.
    """

    def __init__(self, cpu: Callable[[], float] = time.process_time) -> None:
        self.steps: dict[str, Seconds] = {}
        self.cpu = cpu
        self.last = self._now()

    def step(self, name: str) -> None:
        """Add the time since the last step to a step."""
        now = self._now()
        passed = now[0] - self.last[0], now[1] - self.last[1]
        self.steps = add_steps([*self.steps.items(), (name, passed)])
        self.last = now

    def _now(self) -> Seconds:
        return time.perf_counter(), self.cpu()


def add_steps(steps: Iterable[tuple[str, Seconds]]) -> dict[str, Seconds]:
    """Return the seconds of each name; those of one name are added."""
    sums: dict[str, Seconds] = {}
    for name, (wall, cpu) in steps:
        wall_before, cpu_before = sums.get(name, (0.0, 0.0))
        sums[name] = (wall_before + wall, cpu_before + cpu)
    return sums


def with_total(steps: dict[str, Seconds]) -> dict[str, Seconds]:
    """Return the steps and their sum."""
    return {**steps, **add_steps(("total", seconds) for seconds in steps.values())}


def peak_memory(who: int = resource.RUSAGE_SELF) -> int:
    """Return the peak memory in bytes."""
    return resource.getrusage(who).ru_maxrss * 1024


def candidate_files(folder: Path) -> dict[str, Path]:
    """Return the candidates of a folder by name."""
    return {path.stem: path for path in sorted(folder.glob("*.ply")) if path.stem != "reference"}


def run_pcbench(folder: Path) -> dict[str, Any]:
    """Run and time the comparison with pcbench, and its stages as `compare` announces them."""
    clock = Clock()
    from pcbench import compare, read_cloud
    from pcbench.report import document  # noqa: F401

    clock.step("import")
    reference = read_cloud(folder / "reference.ply")
    candidates = {name: read_cloud(path) for name, path in candidate_files(folder).items()}
    clock.step("read")
    begun = ["checks"]

    def begin(stage: str) -> None:
        clock.step(begun[-1])
        begun.append(stage)

    result = compare(reference, candidates, on_step=begin)
    clock.step(begun[-1])
    stages = {name: seconds for name, seconds in clock.steps.items() if name not in ("import", "read")}
    return {
        "steps": with_total(add_steps((_step(name), seconds) for name, seconds in clock.steps.items())),
        "stages": stages,
        "timings_s": {candidate.name: dict(candidate.timings_s) for candidate in result.candidates},
        "peak": peak_memory(),
        "values": {candidate.name: paper_metrics(candidate.metrics) for candidate in result.candidates},
    }


def _step(stage: str) -> str:
    """Return the step of the table to which a step or a stage that `compare` announces belongs."""
    if stage in STEPS:
        return stage
    if stage == "indexing the reference":
        return "index, normals"
    return "registration" if stage.endswith(": registering") else "distances, metrics"


def run_open3d(folder: Path) -> dict[str, Any]:
    """Run a typical user script: normals (k = 20), point-to-plane ICP, both distances, the paper's four metrics."""
    clock = Clock()
    import numpy as np
    import open3d as o3d

    clock.step("import")
    read_point_cloud = o3d.io.read_point_cloud
    reference = read_point_cloud(str(folder / "reference.ply"))
    candidates = {name: read_point_cloud(str(path)) for name, path in candidate_files(folder).items()}
    clock.step("read")
    reference.estimate_normals(o3d.geometry.KDTreeSearchParamKNN(20))
    clock.step("index, normals")
    registration = o3d.pipelines.registration
    normals, points = np.asarray(reference.normals), np.asarray(reference.points)
    values = {}
    for name, candidate in candidates.items():
        T = np.eye(4)
        for max_distance in (3.0, 1.0):
            T = registration.registration_icp(
                candidate, reference, max_distance, T, registration.TransformationEstimationPointToPlane()
            ).transformation
        candidate.transform(T)
        clock.step("registration")
        c2r = np.asarray(candidate.compute_point_cloud_distance(reference))
        r2c = np.asarray(reference.compute_point_cloud_distance(candidate))
        aligned = np.asarray(candidate.points)
        # D2 needs the index of the closest point; the fastest call that returns it searches again.
        index = o3d.core.nns.NearestNeighborSearch(o3d.core.Tensor(points))
        index.knn_index()
        nearest = index.knn_search(o3d.core.Tensor(aligned), 1)[0].numpy()[:, 0]
        plane_distances = np.einsum("ni,ni->n", aligned - points[nearest], normals[nearest])
        values[name] = {
            "d1": float(np.mean(c2r**2)),
            "d2": float(np.mean(plane_distances**2)),
            "hausdorff": float(max(c2r.max(), r2c.max())),
            "chamfer": float(np.mean(c2r**2) + np.mean(r2c**2)),
            "T": T.tolist(),
        }
        clock.step("distances, metrics")
    return {"steps": with_total(clock.steps), "peak": peak_memory(), "values": values}


# Lines that CloudCompare prints when a step begins.
_CLOUDCOMPARE_STEPS = {
    "[LOADING]": "read",
    "[OCTREE NORMALS CALCULATION]": "index, normals",
    "[ICP]": "registration",
    "[DISTANCE COMPUTATION]": "distances, metrics",
}


def run_cloudcompare(folder: Path) -> dict[str, Any]:
    """Run CloudCompare's command line with its defaults: normals of the reference, ICP, C2C distances both ways."""
    import numpy as np

    from pcbench import read_cloud

    reference, finished = folder / "reference.ply", Finished()
    finished.run(folder, ["-O", reference, "-OCTREE_NORMALS", "AUTO"])
    values = {}
    for name, path in candidate_files(folder).items():
        output = {direction: folder / "cloudcompare" / f"{name}-{direction}.ply" for direction in ("c2r", "r2c")}
        output["c2r"].parent.mkdir(exist_ok=True)
        # C2C compares the first cloud with the second; ICP moves the first.
        save = ["-POP_CLOUDS", "-SAVE_CLOUDS", "FILE"]
        finished.run(folder, ["-O", path, "-O", reference, "-ICP", "-C2C_DIST", *save, output["c2r"]])
        finished.run(folder, ["-O", reference, "-O", output["c2r"], "-C2C_DIST", *save, output["r2c"]])
        c2r, r2c = (
            read_cloud(output[direction]).attributes["scalar_C2C_absolute_distances"].astype(float)
            for direction in ("c2r", "r2c")
        )
        values[name] = {
            "d1": float(np.mean(c2r**2)),
            "hausdorff": float(max(c2r.max(), r2c.max())),
            "chamfer": float(np.mean(c2r**2) + np.mean(r2c**2)),
            "T": np.loadtxt(path.with_name(f"{name}_REGISTRATION_MATRIX.txt")).tolist(),
        }
    return {"steps": with_total(finished.steps), "peak": peak_memory(resource.RUSAGE_CHILDREN), "values": values}


class Finished:
    """Wall and CPU seconds per step of all finished runs of CloudCompare."""

    def __init__(self) -> None:
        self.steps: dict[str, Seconds] = {}

    def run(self, folder: Path, arguments: list[Any]) -> None:
        """Run CloudCompare without a screen, and add the times of its steps."""
        formats = ["-C_EXPORT_FMT", "PLY", "-PLY_EXPORT_FMT", "BINARY_LE"]
        # Lines must arrive when they are printed: their times separate the steps.
        command = ["stdbuf", "-oL", "CloudCompare", "-SILENT", "-NO_TIMESTAMP", "-AUTO_SAVE", "OFF", *formats]
        environment = {
            **os.environ,
            "QT_QPA_PLATFORM": "offscreen",
            "HOME": str(folder),
            "XDG_RUNTIME_DIR": str(folder),
        }
        before = _children_cpu()
        with subprocess.Popen(
            [*command, *map(str, arguments)],
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        ) as process:
            clock, name, lines = Clock(lambda: _cpu(process.pid, before)), "import", []
            for line in process.stdout:
                lines.append(line)
                if next_name := _CLOUDCOMPARE_STEPS.get(line.strip()):
                    clock.step(name)
                    name = next_name
        if process.returncode:
            sys.exit(f"CloudCompare ended with code {process.returncode}: {lines[-1] if lines else ''}")
        clock.step(name)
        self.steps = add_steps([*self.steps.items(), *clock.steps.items()])


def _children_cpu() -> float:
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def _cpu(pid: int, children_before: float) -> float:
    """Return the CPU seconds of a child process, which runs or is the last that has ended."""
    if (ended := _children_cpu()) > children_before:
        return ended - children_before
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return sum(map(int, fields[11:13])) / os.sysconf("SC_CLK_TCK")


def paper_metrics(metrics: Any) -> dict[str, float]:
    """Return the paper's four metrics from all metrics."""
    return {
        "d1": metrics.d1_mse.accuracy.value,
        "d2": metrics.d2_mse.accuracy.value,
        "hausdorff": metrics.hausdorff.symmetric_max,
        "chamfer": metrics.chamfer.sum_squared.value,
    }


def metrics_at_transform(reference: Any, candidate: Any, T: list[list[float]]) -> dict[str, float]:
    """Return pcbench's metrics with the registration of another tool."""
    from pcbench import Settings, compare

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "T.txt"
        path.write_text("\n".join(" ".join(map(repr, row)) for row in T))
        return paper_metrics(compare(reference, candidate, Settings(register=f"matrix:{path}")).candidates[0].metrics)


SIDES = {"ours": run_pcbench, "open3d": run_open3d, "cloudcompare": run_cloudcompare}


def missing_sides() -> dict[str, str]:
    """Return the peers that cannot run here, and why."""
    missing = {}
    if importlib.util.find_spec("open3d") is None:
        missing["open3d"] = "Open3D is not measured: pip install 'pcbench[open3d]'"
    if shutil.which("CloudCompare") is None or shutil.which("stdbuf") is None:
        missing["cloudcompare"] = "CloudCompare is not measured: no command CloudCompare (Debian: cloudcompare)"
    return missing


def run_side(side: str, folder: Path, *, limit_s: float = 3600.0, limit_bytes: float = float("inf")) -> dict | str:
    """Run one side in a child process within limits of wall time and of memory.

    Returns:
        Its times, peak memory and metrics; or the reason why there are none, such as "> 300 s".
    """
    command = [sys.executable, __file__, side, str(folder)]
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
    )
    end = time.monotonic() + limit_s
    reason = None
    while process.poll() is None and reason is None:
        try:
            process.wait(0.1)
        except subprocess.TimeoutExpired:
            if time.monotonic() > end:
                reason = f"> {limit_s:g} s"
            elif memory_of_session(process.pid) > limit_bytes:
                reason = f"> {limit_bytes / 2**30:.3g} GiB"
    if reason:
        os.killpg(process.pid, signal.SIGKILL)
    output, errors = process.communicate()
    if reason or process.returncode:
        return reason or f"failed: {(errors.strip().splitlines() or [f'code {process.returncode}'])[-1]}"
    return json.loads(output.splitlines()[-1])


def memory_of_session(session: int) -> int:
    """Return the resident memory of all processes of a session, in bytes."""
    total = 0
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = stat.read_text().rpartition(")")[2].split()
        except OSError:  # it has ended
            continue
        total += int(fields[21]) if int(fields[3]) == session else 0
    return total * resource.getpagesize()


if __name__ == "__main__":
    print(json.dumps(SIDES[sys.argv[1]](Path(sys.argv[2]))))
