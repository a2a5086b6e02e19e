"""Where registrations succeed, fail and say so, against other libraries: python tests/bench/registration.py

--seeds 3      scenes a case
--quick        one scene, few cases
--only a,b     only these sweeps, or `speed`
--rows FILE    keep the outcomes; where the file is there already, they are read from it
--chart FILE   draw them

Two independent samples of one city with 2 cm noise; the truth is exact. An error is the root mean square distance
between where the found and the true transform put the reference's points; up to 5 cm (2.5 sigma) is a success.
A failure is *said* where the method raises or warns; of a peer, where it reports no convergence or matches less than
30 % of the candidate (KISS-Matcher: less than 5 inliers, its example's rule). Any other failure is *confidently wrong*.
Peers run coarse to fine, with maximum correspondence distances of 20, 6 and 2 m, on voxels of 0.5 m (features: 2 m).
"""

import argparse
import importlib.util
import json
import os
import resource
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from measure import alternate, setting

from pcbench import register
from pcbench.errors import RegistrationError
from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.neighbors import Index
from pcbench.geometry.normals import Surface
from pcbench.geometry.transform import Similarity
from pcbench.registration import Target, local_origin
from pcbench.scenes.synthetic import city, demo

LIMIT = 0.05  # metres
MAX_DISTANCES = (20.0, 6.0, 2.0)
VOXEL, FEATURE_VOXEL = 0.5, 2.0
ENOUGH = 0.3  # share of the candidate that a peer has to match


class Answer(NamedTuple):
    """What a method returns: a transform candidate -> reference, and whether it vouches for it."""

    transform: Similarity | None
    sure: bool


Method = Callable[[FloatArray, FloatArray], Answer]


# ---- methods ----


def ours(method: str) -> Method:
    def run(reference: FloatArray, candidate: FloatArray) -> Answer:
        try:
            result = register(reference, candidate, method)
        except RegistrationError:
            return Answer(None, False)
        return Answer(result.T_reference_candidate, result.converged is True and not result.warnings)

    return run


def with_open3d(kind: str) -> Method:
    from open3d import geometry, utility
    from open3d.pipelines import registration as o3d

    def run(reference: FloatArray, candidate: FloatArray) -> Answer:
        clouds = []
        for points in (reference, candidate):
            cloud = geometry.PointCloud(utility.Vector3dVector(points)).voxel_down_sample(VOXEL)
            cloud.estimate_normals(geometry.KDTreeSearchParamKNN(20))
            clouds.append(cloud)
        T, fitness = np.eye(4), 0.0
        for max_distance in MAX_DISTANCES:
            criteria = o3d.ICPConvergenceCriteria(max_iteration=60)
            if kind == "GICP":
                estimator = o3d.TransformationEstimationForGeneralizedICP()
                found = o3d.registration_generalized_icp(clouds[1], clouds[0], max_distance, T, estimator, criteria)
            else:
                # A robust kernel from the start keeps only what fits already: it comes with the last distance.
                robust = kind == "Tukey" and max_distance == MAX_DISTANCES[-1]
                estimator = o3d.TransformationEstimationPointToPlane(*([o3d.TukeyLoss(0.3)] if robust else []))
                found = o3d.registration_icp(clouds[1], clouds[0], max_distance, T, estimator, criteria)
            T, fitness = found.transformation, found.fitness
        return Answer(_rigid(T), fitness >= ENOUGH)

    return run


def with_small_gicp(kind: str) -> Method:
    import small_gicp

    def run(reference: FloatArray, candidate: FloatArray) -> Answer:
        threads = len(os.sched_getaffinity(0))
        target, tree = small_gicp.preprocess_points(reference, VOXEL, num_threads=threads)
        source, _ = small_gicp.preprocess_points(candidate, VOXEL, num_threads=threads)
        T, done = np.eye(4), None
        for max_distance in MAX_DISTANCES:
            how = {"init_T_target_source": T, "max_correspondence_distance": max_distance, "num_threads": threads}
            if kind == "VGICP":
                voxels = small_gicp.GaussianVoxelMap(max_distance / 2)
                voxels.insert(target)
                done = small_gicp.align(voxels, source, init_T_target_source=T, num_threads=threads)
            else:
                done = small_gicp.align(target, source, tree, registration_type=kind, max_iterations=60, **how)
            T = done.T_target_source
        return Answer(_rigid(T), bool(done.converged) and done.num_inliers >= ENOUGH * source.size())

    return run


def with_kiss(reference: FloatArray, candidate: FloatArray) -> Answer:
    """KISS-Matcher as it comes, then our ICP."""
    import kiss_matcher

    matcher = kiss_matcher.KISSMatcher(kiss_matcher.KISSMatcherConfig(FEATURE_VOXEL))
    with _no_output():
        found = matcher.estimate([*candidate.astype(np.float32)], [*reference.astype(np.float32)])
    if matcher.get_num_final_inliers() < 5:
        return Answer(None, False)
    first = _rigid(_matrix(found.rotation, found.translation))
    answer = ours("icp")(reference, first.apply(candidate))
    return Answer(None if answer.transform is None else answer.transform @ first, answer.sure)


def with_features(solver: str) -> Method:
    """Open3D's FPFH with RANSAC or FGR and the parameters of its tutorial, then its point-to-plane ICP."""
    from open3d import geometry, utility
    from open3d.pipelines import registration as o3d

    def run(reference: FloatArray, candidate: FloatArray) -> Answer:
        utility.random.seed(0)
        v, clouds, features = FEATURE_VOXEL, [], []
        for points in (candidate, reference):
            cloud = geometry.PointCloud(utility.Vector3dVector(points)).voxel_down_sample(v)
            cloud.estimate_normals(geometry.KDTreeSearchParamHybrid(2 * v, 30))
            clouds.append(cloud)
            features.append(o3d.compute_fpfh_feature(cloud, geometry.KDTreeSearchParamHybrid(5 * v, 100)))
        if solver == "FGR":
            option = o3d.FastGlobalRegistrationOption(maximum_correspondence_distance=0.5 * v)
            found = o3d.registration_fgr_based_on_feature_matching(*clouds, *features, option)
        else:
            checks = [
                o3d.CorrespondenceCheckerBasedOnEdgeLength(0.9),
                o3d.CorrespondenceCheckerBasedOnDistance(1.5 * v),
            ]
            found = o3d.registration_ransac_based_on_feature_matching(
                *clouds,
                *features,
                True,
                1.5 * v,
                o3d.TransformationEstimationPointToPoint(False),
                3,
                checks,
                o3d.RANSACConvergenceCriteria(100_000, 0.999),
            )
        fine = []
        for points in (candidate, reference):
            cloud = geometry.PointCloud(utility.Vector3dVector(points)).voxel_down_sample(VOXEL)
            cloud.estimate_normals(geometry.KDTreeSearchParamKNN(20))
            fine.append(cloud)
        plane = o3d.TransformationEstimationPointToPlane()
        found = o3d.registration_icp(*fine, MAX_DISTANCES[-1], found.transformation, plane)
        return Answer(_rigid(found.transformation), found.fitness >= ENOUGH)

    return run


def refinements() -> dict[str, Method]:
    methods = {name: ours(name) for name in ("icp", "icp-point", "similarity")}
    if importlib.util.find_spec("open3d"):
        methods |= {
            "Open3D plane": with_open3d("plane"),
            "Open3D plane, Tukey": with_open3d("Tukey"),
            "Open3D GICP": with_open3d("GICP"),
        }
    if importlib.util.find_spec("small_gicp"):
        methods |= {
            "small_gicp plane": with_small_gicp("PLANE_ICP"),
            "small_gicp GICP": with_small_gicp("GICP"),
            "small_gicp VGICP": with_small_gicp("VGICP"),
        }
    return methods


def from_nothing() -> dict[str, Method]:
    methods = {name: ours(name) for name in ("global", "global-similarity")}
    if importlib.util.find_spec("kiss_matcher"):
        methods["KISS-Matcher, our ICP"] = with_kiss
    if importlib.util.find_spec("open3d"):
        methods |= {"Open3D FPFH, RANSAC": with_features("RANSAC"), "Open3D FPFH, FGR": with_features("FGR")}
    return methods


# ---- cases ----


class Case(NamedTuple):
    """Two clouds, 2 degrees and half a metre apart where nothing else is said."""

    angle_deg: float = 2.0
    offset: float = 0.5  # metres
    overlap: float = 1.0  # share of either window that is in the other
    outliers: float = 0.0  # share of the candidate
    scale: float = 1.0
    density: float = 2.0  # reference points a candidate point
    shape: str = "city"


class Sweep(NamedTuple):
    title: str
    unit: str
    values: tuple[float | str, ...]
    case: Callable[[float | str], Case]
    quick: tuple[float | str, ...]
    everyone: bool  # or only what needs no start


SWEEPS = {
    "rotation": Sweep("Start off by", "degrees", (5, 10, 20, 30, 45, 60), lambda v: Case(angle_deg=v), (10, 45), False),
    "offset": Sweep("Start off by", "metres", (1, 5, 10, 20, 40), lambda v: Case(offset=v), (5, 20), False),
    "overlap": Sweep("Overlap", "%", (100, 70, 40, 20, 10), lambda v: Case(overlap=v / 100), (40, 10), False),
    "outliers": Sweep("Outliers", "%", (10, 30, 50), lambda v: Case(outliers=v / 100), (50,), False),
    "scale": Sweep("Scale", "factor", (1.002, 1.03, 1.2), lambda v: Case(scale=v), (1.03,), False),
    "density": Sweep("Density", "to 1", (1, 8, 33), lambda v: Case(density=v), (33,), False),
    "degenerate": Sweep("Degenerate", "", ("plane", "tunnel"), lambda v: Case(shape=v), ("plane",), False),
    "nothing": Sweep(
        "Overlap, any pose", "%", (100, 40, 20), lambda v: Case(angle_deg=-1, overlap=v / 100), (40,), True
    ),
}
# Our own global methods take part there too.
ALSO_GLOBAL = {
    "overlap": ("global",),
    "outliers": ("global",),
    "scale": ("global-similarity",),
    "degenerate": ("global", "global-similarity"),
}


def clouds(case: Case, seed: int) -> tuple[FloatArray, FloatArray, Similarity]:
    """Reference, candidate and the true transform. The scene is 200 m x 200 m (or a 40 m plane, a 40 m tunnel)."""
    rng = np.random.default_rng(seed)
    count = 80_000
    if case.shape == "city":
        town = city(seed)
        width = 200 / (2 - case.overlap)
        sizes = (count, count / case.density)
        first, second = (town.sample(int(4.4 * n), rng)[0] for n in sizes)
        first, second = (p[np.abs(p[:, :2]).max(axis=1) < 100] for p in (first, second))
        first, second = first[first[:, 0] < width - 100], second[second[:, 0] > 100 - width]
    else:
        first, second = (_degenerate(case.shape, int(n), rng) for n in (count, count / case.density))
    first, second = (p + rng.normal(0, 0.02, p.shape) for p in (first, second))
    strays = round(len(second) * case.outliers / (1 - case.outliers))
    second = np.concatenate([second, rng.uniform(second.min(0), second.max(0), (strays, 3))])
    angle = rng.uniform(45, 180) if case.angle_deg < 0 else case.angle_deg
    axis, heading = rng.normal(size=3), rng.uniform(0, 2 * np.pi)
    shift = case.offset * np.array([np.cos(heading), np.sin(heading), 0.0])
    R, center = _rotation(axis / np.linalg.norm(axis), np.radians(angle)), second.mean(axis=0)
    true = Similarity(R, center + shift - case.scale * R @ center, case.scale)
    return first, true.inverse().apply(second), true


def _degenerate(shape: str, count: int, rng: np.random.Generator) -> FloatArray:
    u, v = rng.uniform(0, 40, (2, count))
    if shape == "plane":
        return np.column_stack([u, v, np.zeros(count)])
    return np.column_stack([u, 5 * np.cos(v), 5 * np.sin(v)])


# ---- measuring ----


def outcome(method: Method, case: Case, seed: int) -> dict:
    reference, candidate, true = clouds(case, seed)
    wall, cpu = time.perf_counter(), _cpu_seconds()
    transform, sure = method(reference, candidate)
    row = {"wall": time.perf_counter() - wall, "cpu": _cpu_seconds() - cpu, "error": None, "sure": sure}
    if transform is not None:
        there = transform.apply(true.inverse().apply(reference))
        row["error"] = float(np.sqrt(np.square(there - reference).sum(axis=1).mean()))
    return row


def verdict(row: dict) -> str:
    if row["error"] is not None and row["error"] <= LIMIT:
        return "success"
    return "wrong" if row["sure"] else "said"


def run(name: str, seeds: int, *, quick: bool) -> list[dict]:
    sweep, rows = SWEEPS[name], []
    methods = from_nothing() if sweep.everyone else refinements()
    methods |= {method: ours(method) for method in ALSO_GLOBAL.get(name, ())}
    print(f"\n{sweep.title}, {sweep.unit}".rstrip(", "))
    print(f"{'':>8}  {'method':24}{'success':>8}{'said so':>9}{'wrong':>7}{'error mm':>10}{'wall s':>8}{'CPU s':>8}")
    for value in sweep.quick if quick else sweep.values:
        for method, call in methods.items():
            results = [outcome(call, sweep.case(value), seed) for seed in range(1, seeds + 1)]
            verdicts = [verdict(row) for row in results]
            share = {kind: verdicts.count(kind) / seeds for kind in ("success", "said", "wrong")}
            errors = [row["error"] for row in results if verdict(row) == "success"]
            error = f"{1000 * statistics.median(errors):.1f}" if errors else "-"
            wall, cpu = (statistics.median(row[clock] for row in results) for clock in ("wall", "cpu"))
            print(
                f"{value!s:>8}  {method:24}{share['success']:>8.0%}{share['said']:>9.0%}{share['wrong']:>7.0%}"
                f"{error:>10}{wall:>8.2f}{cpu:>8.2f}",
                flush=True,
            )
            rows.append({"sweep": name, "value": value, "method": method, **share, "wall": wall, "cpu": cpu})
    return rows


def speed(runs: int) -> None:
    """The sizes of Gao et al., 1,270,820 and 244,849 points, from 5 degrees and 2 m."""
    scene = demo()
    reference = scene.reference
    origin = local_origin(reference)
    start = Similarity(_rotation(np.array([0.0, 0.0, 1.0]), np.radians(5)), np.array([2.0, 0.0, 0.0]))
    true = scene.T_reference_candidate["densified"]
    candidate = start.apply(true.apply(scene.candidates["densified"].points))
    target = Target(Surface(Index(reference.points - origin)))
    register(reference, candidate, target=target)  # normals where they are wanted
    race: dict[str, Callable[[], object]] = {
        "pcbench icp, index included": lambda: register(reference, candidate),
        "pcbench icp, index and normals there": lambda: register(reference, candidate, target=target),
    }
    if importlib.util.find_spec("small_gicp"):
        import small_gicp

        threads = len(os.sched_getaffinity(0))
        goal, tree = small_gicp.preprocess_points(reference.points, VOXEL, num_threads=threads)
        source, _ = small_gicp.preprocess_points(candidate, VOXEL, num_threads=threads)

        def align(kind: str) -> None:
            T = np.eye(4)
            for max_distance in MAX_DISTANCES:
                T = small_gicp.align(
                    goal,
                    source,
                    tree,
                    T,
                    registration_type=kind,
                    max_correspondence_distance=max_distance,
                    max_iterations=60,
                    num_threads=threads,
                ).T_target_source

        for kind in ("PLANE_ICP", "GICP", "VGICP"):
            whole = with_small_gicp(kind)
            race[f"small_gicp {kind}, preprocessing included"] = lambda whole=whole: whole(reference.points, candidate)
        race["small_gicp PLANE_ICP, preprocessed"] = lambda: align("PLANE_ICP")
        race["small_gicp GICP, preprocessed"] = lambda: align("GICP")
    print(f"\n{len(reference):,} against {len(candidate):,} points, start 5 degrees and 2 m; median of {runs} runs")
    print(f"{'':44}{'wall s':>8}{'CPU s':>8}")
    for name, (wall, cpu) in alternate(race, runs).items():
        print(f"{name:44}{wall:>8.2f}{cpu:>8.2f}")


def _rotation(axis: FloatArray, angle: float) -> FloatArray:
    x, y, z = axis
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k


def _matrix(rotation: FloatArray, translation: FloatArray) -> FloatArray:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, np.asarray(translation).ravel()
    return matrix


def _rigid(matrix: FloatArray) -> Similarity:
    u, _, vt = np.linalg.svd(np.asarray(matrix)[:3, :3])  # some are rotations to single precision only
    return Similarity(u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt, np.asarray(matrix)[:3, 3])


def _cpu_seconds() -> float:
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.process_time() + children.ru_utime + children.ru_stime


class _no_output:
    """KISS-Matcher writes to the process's standard output."""

    def __enter__(self) -> None:
        self.kept, null = os.dup(1), os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, 1)
        os.close(null)

    def __exit__(self, *error: object) -> None:
        os.dup2(self.kept, 1)
        os.close(self.kept)


# ---- chart ----

COLORS = {"success": "#0072B2", "said": "#D8DADD", "wrong": "#D55E00"}  # Okabe and Ito's
LABELS = {"success": f"right to {100 * LIMIT:.0f} cm", "said": "failed and said so", "wrong": "confidently wrong"}


def draw(rows: list[dict], file: str) -> None:
    import matplotlib.pyplot as plt
    from matplotlib.patches import Patch, Rectangle

    names = [name for name in SWEEPS if any(row["sweep"] == name for row in rows)]
    table = {(row["sweep"], row["value"], row["method"]): row for row in rows}
    near = [name for name in names if not SWEEPS[name].everyone]
    far = [name for name in names if SWEEPS[name].everyone]
    blocks = [(group, _methods(rows, group)) for group in (near[:3], near[3:], far) if group]
    # Inches, so that a bar is as large in every block.
    bar, head, top, bottom, left, width = 0.27, 0.75, 0.8, 0.3, 1.85, 11.0
    height = top + bottom + sum(head + bar * len(methods) for _, methods in blocks)
    figure = plt.figure(figsize=(width, height), facecolor="white")
    y0 = height - top
    for group, methods in blocks:
        counts = [len({row["value"] for row in rows if row["sweep"] == name}) for name in group]
        cell = min(0.72, (width - left - 0.3 - 0.35 * len(group)) / sum(counts))
        x0, y0 = left, y0 - head - bar * len(methods)
        for k, (name, columns) in enumerate(zip(group, counts, strict=True)):
            area = (x0 / width, (y0 + 0.45) / height, columns * cell / width, bar * len(methods) / height)
            axis = figure.add_axes(area)
            x0 += columns * cell + 0.35
            values = list(dict.fromkeys(row["value"] for row in rows if row["sweep"] == name))
            for x, value in enumerate(values):
                for y, method in enumerate(methods):
                    row, start = table.get((name, value, method)), x - 0.45
                    if row is None:
                        axis.plot(x, y, marker=".", color="#A9ADB3", markersize=3)
                        continue
                    for kind, color in COLORS.items():
                        hatch = {"hatch": "xxxx", "edgecolor": "white"} if kind == "wrong" else {"edgecolor": "none"}
                        share = 0.9 * row[kind]
                        if share:
                            axis.add_patch(Rectangle((start, y - 0.38), share, 0.76, facecolor=color, lw=0, **hatch))
                        start += share
            axis.set(xlim=(-0.5, len(values) - 0.5), ylim=(len(methods) - 0.5, -0.5))
            axis.set_xticks(range(len(values)), [f"{v}" for v in values])
            axis.set_yticks(range(len(methods)), methods if k == 0 else [""] * len(methods))
            for label, method in zip(axis.get_yticklabels(), methods, strict=True):
                label.set_fontweight("bold" if method in OURS else "normal")
            axis.tick_params(length=0, labelsize=9)
            axis.set_title(
                f"{SWEEPS[name].title} ({SWEEPS[name].unit})" if SWEEPS[name].unit else SWEEPS[name].title,
                fontsize=10,
                loc="left",
                pad=5,
            )
            ruled = [y + 0.5 for y in range(len(methods) - 1) if (methods[y] in OURS) != (methods[y + 1] in OURS)]
            axis.hlines(ruled, -0.5, len(values) - 0.5, color="#8A8F96", lw=0.8)
            for side in axis.spines.values():
                side.set_visible(False)
    handles = [
        Patch(facecolor=COLORS[k], edgecolor="white", lw=0, hatch="xxxx" if k == "wrong" else "", label=LABELS[k])
        for k in COLORS
    ]
    figure.text(0.15 / width, 1 - 0.36 / height, "Which registration can be relied on?", fontsize=15, fontweight="bold")
    place = (0.1 / width, 1 - 0.46 / height)
    figure.legend(handles=handles, loc="upper left", ncols=3, frameon=False, fontsize=10, bbox_to_anchor=place)
    note = "Share of scenes: two samples of a 200 m city with 2 cm noise. Bold: pcbench. Dots: not run."
    figure.text(0.15 / width, 0.1 / height, note, fontsize=9, color="#50555C")
    figure.savefig(file, dpi=150)


OURS = ("icp", "icp-point", "similarity", "global", "global-similarity")


def _methods(rows: list[dict], group: list[str]) -> list[str]:
    """Ours first, the others as they come."""
    present = list(dict.fromkeys(row["method"] for row in rows if row["sweep"] in group))
    return [m for m in OURS if m in present] + [m for m in present if m not in OURS]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--runs", type=int, default=3, help="of the speed table")
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--only", default=",".join([*SWEEPS, "speed"]))
    parser.add_argument("--rows", type=Path)
    parser.add_argument("--chart")
    options = parser.parse_args()
    print(setting())
    rows: list[dict] = []
    if options.rows and options.rows.exists():
        rows = json.loads(options.rows.read_text())
    else:
        for name in options.only.split(","):
            if name != "speed":
                rows += run(name, 1 if options.quick else options.seeds, quick=options.quick)
                if options.rows:
                    options.rows.write_text(json.dumps(rows))
        if "speed" in options.only.split(","):
            speed(1 if options.quick else options.runs)
    if options.chart and rows:
        draw(rows, options.chart)


if __name__ == "__main__":
    main()
