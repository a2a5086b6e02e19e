"""Point-to-mesh distances next to Open3D's RaycastingScene and trimesh, in one process, with the same queries.

    python benchmarks/mesh.py [--faces 1000000] [--queries 1000000] [--runs 3]

The mesh is a rough height field; queries are close to it, in its box, and far away. CPU seconds are the sum over all
threads, which does not depend on the load. Open3D and trimesh are left out if they cannot be imported; trimesh, which
takes milliseconds per query, gets a hundredth of the queries, and its time is scaled up.
"""

from __future__ import annotations

import argparse
import os
import platform
import statistics
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from mesh_shapes import height_field

from pcbench.geometry.mesh import Mesh, MeshIndex


def build_pcbench(vertices, faces):
    """Build our index and return its query."""
    index = MeshIndex(Mesh(vertices, faces))
    return lambda points: index.query(points).distances


def build_open3d(vertices, faces):
    """Build Open3D's scene and return its query."""
    import open3d as o3d

    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(vertices.astype(np.float32), faces.astype(np.uint32))
    scene.compute_closest_points(vertices[:1].astype(np.float32))  # builds
    return lambda points: np.linalg.norm(
        points - scene.compute_closest_points(points.astype(np.float32))["points"].numpy(), axis=1
    )


def build_trimesh(vertices, faces):
    """Build trimesh's index and return its query."""
    import trimesh as tm

    mesh = tm.Trimesh(vertices, faces, process=False)
    tm.proximity.closest_point(mesh, vertices[:1])  # builds
    return lambda points: tm.proximity.closest_point(mesh, points)[1]


def measure_time(call):
    """Return the result of a call with its wall and CPU seconds."""
    wall, cpu = time.perf_counter(), time.process_time()
    result = call()
    return result, (time.perf_counter() - wall, time.process_time() - cpu)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--faces", type=int, default=1_000_000)
    parser.add_argument("--queries", type=int, default=1_000_000)
    parser.add_argument("--runs", type=int, default=3)
    arguments = parser.parse_args()

    vertices, faces = height_field(round((arguments.faces / 2) ** 0.5) + 1)
    rng = np.random.default_rng(0)
    surface_points = Mesh(vertices, faces).sample(arguments.queries).points
    queries = {
        "within 0.2 % of the size": surface_points + rng.normal(0, 0.002, surface_points.shape),
        "in its box, twice as high": rng.uniform(
            vertices.min(axis=0) * 2, vertices.max(axis=0) * 2, surface_points.shape
        ),
        "off by a third": surface_points + rng.normal(0, 0.3, surface_points.shape),
    }
    commit = subprocess.run(["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True).stdout.strip()
    print(f"{len(faces):,} faces, {arguments.queries:,} queries, {arguments.runs} runs, medians")
    print(f"commit {commit}, {platform.machine()}, {len(os.sched_getaffinity(0))} cores\n")
    print(f"{'':28}{'':10}{'wall s':>10}{'CPU s':>10}{'ratio':>8}{'largest difference':>22}")

    builders = {"pcbench": build_pcbench, "Open3D": build_open3d, "trimesh": build_trimesh}
    engines, builds = {}, {}
    for name, build in builders.items():
        try:
            engines[name], builds[name] = measure_time(lambda build=build: build(vertices, faces))
        except ImportError as error:
            print(f"{name} left out: {error}")
    for name, (wall, cpu) in builds.items():
        print(f"{'build':28}{name:10}{wall:10.2f}{cpu:10.2f}{cpu / builds['pcbench'][1]:8.1f}")
    for query_label, points in queries.items():
        results = {}
        for name, query in engines.items():
            sample = points[::100] if name == "trimesh" else points
            times = []
            for _ in range(1 if name == "trimesh" else arguments.runs):
                distances, seconds = measure_time(lambda query=query, sample=sample: query(sample))
                times.append(np.array(seconds) * len(points) / len(sample))
            wall, cpu = (statistics.median(t[k] for t in times) for k in range(2))
            results[name] = distances, cpu
            pcbench_distances, pcbench_cpu = results["pcbench"]
            max_difference = np.abs(distances - pcbench_distances[:: len(points) // len(sample)]).max()
            print(f"{query_label:28}{name:10}{wall:10.2f}{cpu:10.2f}{cpu / pcbench_cpu:8.1f}{max_difference:22.1e}")


if __name__ == "__main__":
    main()
