"""A complete comparison at the paper's sizes, next to a plain Open3D script for the same job.

    python tests/bench/compare.py [--points 1270820] [--runs 3]

Each side runs in a separate process, alternating; prints medians of wall and CPU seconds per step, and peak memory.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

STEPS = ("import", "read", "index, normals", "registration", "distances, metrics", "total")


def run_pcbench(folder: Path) -> dict:
    """Run and time the comparison with pcbench."""
    clock = Clock()
    from pcbench import compare, read_cloud
    from pcbench.report import document  # noqa: F401

    clock.step("import")
    reference, candidates = (
        read_cloud(folder / "reference.ply"),
        {name: read_cloud(folder / f"{name}.ply") for name in ("sparse", "densified")},
    )
    clock.step("read")
    result = compare(reference, candidates)
    clock.step("compare")
    values = {candidate.name: paper_metrics(candidate.metrics) for candidate in result.candidates}
    inner_s = {
        "registration": sum(c.timings_s["registration"] for c in result.candidates),
        "index, normals": result.candidates[0].timings_s["reference"],
    }
    clock.steps["registration"] = (inner_s["registration"], None)
    clock.steps["index, normals"] = (inner_s["index, normals"], None)
    compare_s, _ = clock.steps.pop("compare")
    clock.steps["distances, metrics"] = (compare_s - sum(inner_s.values()), None)
    return clock.result(values)


def run_open3d(folder: Path) -> dict:
    """Run a typical user script: normals (k = 20), point-to-plane ICP, both distances, the paper's four metrics."""
    clock = Clock()
    import numpy as np
    import open3d as o3d

    clock.step("import")
    read_point_cloud = o3d.io.read_point_cloud
    reference = read_point_cloud(str(folder / "reference.ply"))
    candidates = {name: read_point_cloud(str(folder / f"{name}.ply")) for name in ("sparse", "densified")}
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
    return clock.result(values)


def metrics_at_transform(reference, candidate, T: list) -> dict:
    """Return our metrics with the registration of another tool."""
    import numpy as np

    from pcbench import Settings, compare

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "T.txt"
        path.write_text("\n".join(" ".join(repr(v) for v in row) for row in np.array(T).tolist()))
        return paper_metrics(compare(reference, candidate, Settings(register=f"matrix:{path}")).candidates[0].metrics)


def paper_metrics(m: dict) -> dict:
    """Return the paper's four metrics from all metrics."""
    return {
        "d1": m["d1_mse"]["candidate_to_reference"],
        "d2": m["d2_mse"]["candidate_to_reference"],
        "hausdorff": m["hausdorff"]["symmetric_max"],
        "chamfer": m["chamfer"]["sum_squared"],
    }


class Clock:
    """Wall and CPU seconds of named steps; steps of one name are added."""

    def __init__(self) -> None:
        self.steps: dict[str, tuple[float, float | None]] = {}
        self.start = self.last = self._now()

    def step(self, name: str) -> None:
        """Add the time since the last step to a step."""
        stamp = self._now()
        wall, cpu = self.steps.get(name, (0.0, 0.0))
        self.steps[name] = (wall + stamp[0] - self.last[0], (cpu or 0.0) + stamp[1] - self.last[1])
        self.last = stamp

    def result(self, values: dict) -> dict:
        """Return the times of all steps, peak memory and the values."""
        stamp = self._now()
        self.steps["total"] = (stamp[0] - self.start[0], stamp[1] - self.start[1])
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
        return {"steps": self.steps, "peak": peak, "values": values}

    @staticmethod
    def _now() -> tuple[float, float]:
        usage = resource.getrusage(resource.RUSAGE_SELF)
        return time.perf_counter(), usage.ru_utime + usage.ru_stime


def run(side: str, folder: Path) -> dict:
    """Run one side in a child process."""
    command = [sys.executable, __file__, "--side", side, "--folder", str(folder)]
    return json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout.splitlines()[-1])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--points", type=int, default=1_270_820)
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--side", choices=("ours", "open3d"), help=argparse.SUPPRESS)
    parser.add_argument("--folder", type=Path, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.side:
        print(json.dumps({"ours": run_pcbench, "open3d": run_open3d}[arguments.side](arguments.folder)))
        return

    from pcbench import write_cloud
    from pcbench.scenes.synthetic import demo

    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        scene = demo(arguments.points)
        for cloud_name, cloud in {"reference": scene.reference, **scene.candidates}.items():
            write_cloud(folder / f"{cloud_name}.ply", cloud)
        runs: dict[str, list[dict]] = {"ours": [], "open3d": []}
        for number in range(arguments.runs):
            for side in ("ours", "open3d") if number % 2 == 0 else ("open3d", "ours"):
                runs[side].append(run(side, folder))
    commit = subprocess.run(["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True).stdout.strip()
    sizes = ", ".join(f"{len(cloud):,}" for cloud in scene.candidates.values())
    print(f"{sizes} against {arguments.points:,} points; {arguments.runs} alternating runs, medians")
    print(f"commit {commit}, {platform.machine()}, {len(os.sched_getaffinity(0))} cores\n")
    print(f"{'wall seconds':22}{'pcbench':>10}{'Open3D':>10}{'ratio':>8}")
    for step in STEPS:
        a, b = (statistics.median(r["steps"][step][0] for r in runs[side]) for side in ("ours", "open3d"))
        print(f"{step:22}{a:10.2f}{b:10.2f}{b / a:8.1f}")
    a, b = (statistics.median(r["steps"]["total"][1] for r in runs[side]) for side in ("ours", "open3d"))
    print(f"{'total, CPU seconds':22}{a:10.2f}{b:10.2f}{b / a:8.1f}")
    a, b = (statistics.median(r["peak"] for r in runs[side]) / 2**20 for side in ("ours", "open3d"))
    print(f"{'peak memory, MiB':22}{a:10.0f}{b:10.0f}{b / a:8.1f}\n")
    print(f"{'':22}{'pcbench':>14}{'Open3D':>14}{'at its transform':>20}")
    for candidate, values in runs["ours"][0]["values"].items():
        open3d_values = runs["open3d"][0]["values"][candidate]
        pcbench_values = metrics_at_transform(scene.reference, scene.candidates[candidate], open3d_values["T"])
        for metric, value in values.items():
            print(
                f"{candidate + ' ' + metric:22}{value:14.9g}{open3d_values[metric]:14.9g}{pcbench_values[metric]:20.9g}"
            )
    print("\nlast column: pcbench's metrics with Open3D's registration, which separates search from registration")


if __name__ == "__main__":
    main()
