"""Small clouds: scores and comparisons beside the two-way search of other libraries: python benchmarks/small.py

--sizes 2048,10000,100000   points of each cloud
--threads 1                 number of threads
--runs 7                    runs in which the contestants alternate; medians are printed
"""

import argparse
import importlib.util
from collections.abc import Callable

from measure import alternate, limit_threads, setting


def contestants(a, b) -> dict[str, Callable[[], object]]:
    """Return functions of two clouds (N, 3), the two-way search of pcbench first."""
    from pcbench import compare, score
    from pcbench.geometry.neighbors import Index, match_both_directions

    ways = ((a, b), (b, a))
    functions: dict[str, Callable[[], object]] = {
        "two-way search": lambda: match_both_directions(Index(a), Index(b)),
        "score": lambda: score(a, b),
        "score with F-score and D2": lambda: score(a, b, metrics=("chamfer", "fscore", "d2_mse"), thresholds=(0.1,)),
        "compare, no verdict": lambda: compare(a, b, register="none", deformation=False),
        "compare": lambda: compare(a, b, register="none"),
    }
    if importlib.util.find_spec("scipy"):
        from scipy.spatial import cKDTree

        functions["scipy"] = lambda: [
            cKDTree(x, balanced_tree=False, compact_nodes=False).query(y, workers=-1) for x, y in ways
        ]
    if importlib.util.find_spec("pykdtree"):
        from pykdtree.kdtree import KDTree

        functions["pykdtree"] = lambda: [KDTree(x).query(y) for x, y in ways]
    if importlib.util.find_spec("open3d"):
        import open3d

        def open3d_distances():
            first, second = (open3d.geometry.PointCloud(open3d.utility.Vector3dVector(x)) for x in (a, b))
            return first.compute_point_cloud_distance(second), second.compute_point_cloud_distance(first)

        functions["open3d"] = open3d_distances
    return functions


def main() -> None:
    """Print milliseconds of each contestant, and their ratios to the two-way search, for each size."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", default="2048,10000,100000")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--runs", type=int, default=7)
    options = parser.parse_args()
    limit_threads(options.threads)
    import numpy as np

    from pcbench.scenes.synthetic import city

    print(f"{setting()}; threads {options.threads}, medians of {options.runs} runs")
    scene = city(3)
    for size in map(int, options.sizes.split(",")):
        a, b = (scene.sample(size, np.random.default_rng(seed))[0] for seed in (1, 2))
        seconds = alternate(contestants(a, b), options.runs)
        base = seconds["two-way search"]
        print(f"\n{size:,} points{'wall ms':>24}{'CPU ms':>10}{'ratio (CPU)':>13}")
        for name, taken in seconds.items():
            print(f"{name:26}{1e3 * taken.wall:10.2f}{1e3 * taken.cpu:10.2f}{taken.cpu / base.cpu:13.2f}")


if __name__ == "__main__":
    main()
