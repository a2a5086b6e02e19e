"""Nearest-neighbour search in both directions, both indices built, against other libraries: python
benchmarks/neighbors.py

--sizes 1e4,1e5,1e6   points of the reference; the candidate has a fifth
--threads 1,2         numbers of threads, each in a separate process
--runs 5              runs in which the libraries alternate; medians are printed, with their ratios to pcbench's
--chart FILE          log-log chart of the wall seconds with the most threads
"""

import argparse
import importlib.util
import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

from measure import alternate, limit_threads, setting

PEERS = {
    "scipy": "scipy",
    "pykdtree": "pykdtree",
    "pykdtree float32": "pykdtree",  # not exact: coordinates are rounded to float32
    "small_gicp": "small_gicp",
    "open3d": "open3d",
    "point-cloud-utils": "point_cloud_utils",
}


def contestants(reference, candidate, threads: int) -> dict[str, Callable[[], object]]:
    """Return functions that build both indices from float64 arrays and search in both directions."""
    import numpy as np

    from pcbench.geometry.neighbors import Index, match_both_directions

    def scipy(points, queries):
        from scipy.spatial import cKDTree

        cKDTree(points, balanced_tree=False, compact_nodes=False).query(queries, workers=threads)

    def pykdtree(points, queries):
        from pykdtree.kdtree import KDTree

        KDTree(points).query(queries)

    def pykdtree_float32(points, queries):
        pykdtree(points.astype(np.float32), queries.astype(np.float32))

    def small_gicp(points, queries):
        from small_gicp import KdTree

        KdTree(points, num_threads=threads).batch_nearest_neighbor_search(queries, num_threads=threads)

    def open3d(points, queries):
        from open3d import core

        search = core.nns.NearestNeighborSearch(core.Tensor(points))
        search.knn_index()
        search.knn_search(core.Tensor(queries), 1)

    def point_cloud_utils(points, queries):
        from point_cloud_utils import k_nearest_neighbors

        k_nearest_neighbors(queries, points, 1, num_threads=threads)

    one_way = {
        "scipy": scipy,
        "pykdtree": pykdtree,
        "pykdtree float32": pykdtree_float32,
        "small_gicp": small_gicp,
        "open3d": open3d,
        "point-cloud-utils": point_cloud_utils,
    }
    searches: dict[str, Callable[[], object]] = {
        "pcbench": lambda: match_both_directions(Index(reference), Index(candidate))
    }
    for name, search in one_way.items():
        if importlib.util.find_spec(PEERS[name]):
            searches[name] = lambda search=search: (search(reference, candidate), search(candidate, reference))
    return searches


def measure(density: str, size: int, threads: int, runs: int) -> None:
    """Print the medians as JSON, in the child process."""
    limit_threads(threads)
    from clouds import pair

    searches = contestants(*pair(density, size), threads)
    alternate(searches, 1)  # imports and warm-up
    print(json.dumps(alternate(searches, runs)))


def draw(rows: list[dict], threads: int, file: str) -> None:
    """Draw wall seconds by the number of points."""
    import matplotlib.pyplot as plt

    densities = list(dict.fromkeys(row["density"] for row in rows))
    figure, axes = plt.subplots(1, len(densities), figsize=(4.5 * len(densities), 4), sharey=True, squeeze=False)
    for axis, density in zip(axes[0], densities, strict=True):
        density_rows = [row for row in rows if row["density"] == density and row["threads"] == threads]
        for name in dict.fromkeys(name for row in density_rows for name in row["seconds"]):
            line = [(row["size"], row["seconds"][name][0]) for row in density_rows if name in row["seconds"]]
            axis.loglog(*zip(*line, strict=True), marker="o", label=name, linewidth=2.5 if name == "pcbench" else 1)
        axis.set(title=density, xlabel="reference points")
        axis.grid(True, which="both", alpha=0.3)
    axes[0, 0].set_ylabel(f"seconds, both ways, {threads} threads")
    axes[0, 0].legend(fontsize=8)
    figure.tight_layout()
    figure.savefig(file, dpi=150)


def main() -> None:
    from clouds import DENSITIES

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", default="1e4,1e5,1e6")
    parser.add_argument("--densities", default=",".join(DENSITIES))
    parser.add_argument("--threads", default="1,2")
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--chart")
    parser.add_argument("--child", nargs=4, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.child:
        density, *numbers = options.child
        measure(density, *map(int, numbers))
        return
    missing_peers = [name for name, module in PEERS.items() if not importlib.util.find_spec(module)]
    print(
        f"{setting()}; median of {options.runs} alternating runs"
        + (f"; missing: {missing_peers}" if missing_peers else "")
    )
    print(f"{'':56}{'ratio':>16}")
    print(
        f"{'density':14}{'points':>10}{'threads':>8}  {'library':18}"
        + f"{'wall s':>9}{'CPU s':>9}{'wall':>7}{'CPU':>7}"
    )
    rows = []
    for density in options.densities.split(","):
        for size in (round(float(text)) for text in options.sizes.split(",")):
            for threads in map(int, options.threads.split(",")):
                child_arguments = [density, str(size), str(threads), str(options.runs)]
                process = subprocess.run(
                    [sys.executable, Path(__file__), "--child", *child_arguments],
                    check=True,
                    stdout=subprocess.PIPE,
                    text=True,
                )
                seconds = json.loads(process.stdout)
                rows.append({"density": density, "size": size, "threads": threads, "seconds": seconds})
                for name, (wall, cpu) in seconds.items():
                    ours = seconds["pcbench"]
                    row = f"{density:14}{size:10}{threads:8}  {name:18}{wall:9.4f}{cpu:9.4f}"
                    print(f"{row}{wall / ours[0]:7.1f}{cpu / ours[1]:7.1f}", flush=True)
    if options.chart:
        draw(rows, max(map(int, options.threads.split(","))), options.chart)


if __name__ == "__main__":
    main()
