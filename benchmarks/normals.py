"""Normals from k nearest neighbours, index included, against Open3D: python benchmarks/normals.py [--sizes 1e5,1e6]"""

import argparse
import importlib.util
import json
import subprocess
import sys
from pathlib import Path

from measure import alternate, limit_threads, setting


def measure(size: int, k: int, threads: int, runs: int) -> None:
    """Print the medians as JSON, in the child process."""
    limit_threads(threads)
    import numpy as np
    from clouds import pair

    from pcbench.geometry.neighbors import Index

    points = pair("uniform city", size)[0]
    points += np.random.default_rng(1).normal(0, 0.02, points.shape)
    estimators = {"pcbench": lambda: Index(points).local_planes(k)}
    if importlib.util.find_spec("open3d"):
        import open3d

        cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
        search = open3d.geometry.KDTreeSearchParamKNN(k)
        estimators["open3d, fast"] = lambda: cloud.estimate_normals(search, fast_normal_computation=True)
        estimators["open3d, accurate"] = lambda: cloud.estimate_normals(search, fast_normal_computation=False)
    print(json.dumps(alternate(estimators, runs)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sizes", default="1e4,1e5,1e6")
    parser.add_argument("-k", type=int, default=20)
    parser.add_argument("--threads", default="1,2")
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--child", nargs=4, type=int, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.child:
        return measure(*options.child)
    missing_note = "" if importlib.util.find_spec("open3d") else "; missing: open3d"
    print(f"{setting()}; k = {options.k}; median of {options.runs} alternating runs{missing_note}")
    print(f"{'points':>10}{'threads':>8}  {'library':18}{'wall s':>9}{'CPU s':>9}{'ratio':>7}")
    for size in (round(float(text)) for text in options.sizes.split(",")):
        for threads in map(int, options.threads.split(",")):
            child_arguments = map(str, [size, options.k, threads, options.runs])
            process = subprocess.run(
                [sys.executable, Path(__file__), "--child", *child_arguments],
                check=True,
                stdout=subprocess.PIPE,
                text=True,
            )
            seconds = json.loads(process.stdout)
            for name, (wall, cpu) in seconds.items():
                ratio = wall / seconds["pcbench"][0]
                print(f"{size:10}{threads:8}  {name:18}{wall:9.4f}{cpu:9.4f}{ratio:7.1f}", flush=True)


if __name__ == "__main__":
    main()
