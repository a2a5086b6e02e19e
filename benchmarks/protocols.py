"""Evaluation of DTU scans by pcbench, beside the same steps with the libraries of the official Python program.

    python benchmarks/protocols.py [--data PCBENCH_DATA/protocols] [--points 1000000] [--runs 3]

The other side is written from the published description: scikit-learn's NearestNeighbors, or scipy's cKDTree where
scikit-learn is not installed, a loop over points for the thinning and one over faces for the mesh. Both sides read the
same files. Scores of the made scan are of two random orders, so that their last digits differ.

--data    folder with dtu/ and expected.json, with scores of the steps of the official Python version, run with its
          libraries in six orders; left out if it is absent
--points  points of the candidate of a made scan; 0: none
--runs    alternating runs, of which the median counts
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from measure import alternate, setting
from real_data import data_root

from pcbench import Cloud, read_cloud, write_cloud
from pcbench.io.meshes import to_shape
from pcbench.measure.protocols.dtu import Dtu
from pcbench.measure.protocols.protocol import EvaluationInputs

SCAN = 7
THINNING, PATCH, MAX_DISTANCE = 0.2, 60.0, 20.0  # mm


class Scores(NamedTuple):
    """Accuracy and completeness in mm."""

    accuracy: float
    completeness: float


def with_pcbench(folder: Path, candidate: Path) -> Scores:
    """Evaluate with pcbench."""
    scores = Dtu().evaluate(EvaluationInputs(folder, candidate, f"scan{SCAN}")).scores
    return Scores(*(score.value or float("nan") for score in scores[:2]))


def with_libraries(folder: Path, candidate: Path) -> Scores:
    """Evaluate with numpy and a library of neighbour search, step by step as Jensen et al. 2014 describe it."""
    from scipy.io import loadmat

    shape = to_shape(candidate)
    points = shape.points if isinstance(shape, Cloud) else sample_faces(shape.vertices, shape.faces)
    points = np.random.default_rng(1).permutation(points)
    kept = np.ones(len(points), bool)
    for row, near in enumerate(neighbors_within(points, THINNING)):
        if kept[row]:
            kept[near] = False
            kept[row] = True
    points = points[kept]

    stored = loadmat(folder / "ObsMask" / f"ObsMask{SCAN}_10.mat")
    mask, box, side = stored["ObsMask"].astype(bool), stored["BB"].astype(np.float32), float(stored["Res"].item())
    points = points[((points >= box[0] - PATCH) & (points < box[1] + 2 * PATCH)).all(axis=1)]
    cells = np.around((points - box[0]) / side).astype(int)
    inside = ((cells >= 0) & (cells < mask.shape)).all(axis=1)
    observed = points[inside][mask[tuple(cells[inside].T)]]

    reference = read_cloud(folder / "Points" / "stl" / f"stl{SCAN:03}_total.ply").points
    plane = loadmat(folder / "ObsMask" / f"Plane{SCAN}.mat")["P"].ravel()
    above = reference[reference @ plane[:3] + plane[3] > 0]
    means = []
    for queries, targets in ((observed, reference), (above, points)):
        distances = nearest_distances(targets, queries)
        means.append(float(distances[distances < MAX_DISTANCE].mean()))
    return Scores(*means)


def sample_faces(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return the vertices and a grid of points on each face, face by face."""
    blocks = [vertices]
    for corner, second, third in vertices[faces]:
        a, b = second - corner, third - corner
        lengths, area = np.array([np.linalg.norm(a), np.linalg.norm(b)]), np.linalg.norm(np.cross(a, b))
        if area == 0:
            continue
        rows, columns = np.floor(lengths / (THINNING * np.sqrt(lengths[0] * lengths[1] / area))).astype(int)
        if rows == 0 or columns == 0:
            continue
        s, t = np.meshgrid((np.arange(rows) + 0.5) / rows, (np.arange(columns) + 0.5) / columns, indexing="ij")
        inside = s + t < 1
        blocks.append(corner + s[inside][:, None] * a + t[inside][:, None] * b)
    return np.concatenate(blocks)


def library() -> str:
    """Return the name of the library of neighbour search."""
    try:
        import sklearn  # noqa: F401
    except ImportError:
        return "scipy"
    return "scikit-learn"


def neighbors_within(points: np.ndarray, radius: float) -> Any:
    """Return the rows of the neighbours of each point within a radius."""
    if library() == "scipy":
        from scipy.spatial import cKDTree

        return cKDTree(points).query_ball_point(points, radius, workers=-1)
    from sklearn.neighbors import NearestNeighbors

    search = NearestNeighbors(radius=radius, algorithm="kd_tree", n_jobs=-1).fit(points)
    return search.radius_neighbors(points, return_distance=False)


def nearest_distances(points: np.ndarray, queries: np.ndarray) -> np.ndarray:
    """Return the distance of each query to the nearest point."""
    if library() == "scipy":
        from scipy.spatial import cKDTree

        return cKDTree(points).query(queries, workers=-1)[0]
    from sklearn.neighbors import NearestNeighbors

    search = NearestNeighbors(n_neighbors=1, algorithm="kd_tree", n_jobs=-1).fit(points)
    return search.kneighbors(queries)[0][:, 0]


def make_scan(folder: Path, count: int) -> Path:
    """Write a data set of one wavy surface of 300 mm x 300 mm, and return a candidate of `count` points with noise."""
    from scipy.io import savemat

    rng = np.random.default_rng(0)

    def surface(points: int, noise: float) -> Cloud:
        x, y = rng.uniform(0, 300, (2, points))
        return Cloud(np.column_stack([x, y, 30 + 10 * np.sin(x / 20) * np.cos(y / 30) + rng.normal(0, noise, points)]))

    (folder / "ObsMask").mkdir()
    (folder / "Points" / "stl").mkdir(parents=True)
    box = np.array([[10.0, 10, 0], [290, 290, 80]])
    mask = np.ones((281, 281, 81), np.uint8)
    savemat(folder / "ObsMask" / f"ObsMask{SCAN}_10.mat", {"ObsMask": mask, "BB": box, "Res": 1.0})
    savemat(folder / "ObsMask" / f"Plane{SCAN}.mat", {"P": np.array([[0.0], [0], [1], [-22]])})
    write_cloud(folder / "Points" / "stl" / f"stl{SCAN:03}_total.ply", surface(count // 2, 0.0))
    write_cloud(folder / "candidate.ply", surface(count, 0.15))
    return folder / "candidate.ply"


def print_case(name: str, folder: Path, candidate: Path, runs: int, expected: dict[str, float] | None) -> None:
    """Time both sides on one candidate, and print their scores beside those of the steps of the Python version."""
    scores: dict[str, Scores] = {}

    def run(side: str, evaluate: Callable[[Path, Path], Scores]) -> None:
        scores[side] = evaluate(folder, candidate)

    sides = {"pcbench": with_pcbench, library(): with_libraries}
    seconds = alternate({side: partial(run, side, evaluate) for side, evaluate in sides.items()}, runs)
    print(f"\n{name}")
    print(f"{'':14}{'accuracy':>12}{'completeness':>14}{'wall s':>9}{'CPU s':>9}")
    if expected is not None:
        print(f"{'Python steps':14}{expected['accuracy']:12.5f}{expected['completeness']:14.5f}")
        print(f"{'  (6 orders)':14}{expected['accuracy_sd']:>11.5f}σ{expected['completeness_sd']:13.5f}σ")
    for side in sides:
        accuracy, completeness = scores[side]
        wall, cpu = seconds[side]
        print(f"{side:14}{accuracy:12.5f}{completeness:14.5f}{wall:9.2f}{cpu:9.2f}")
    ours, theirs = (seconds[side] for side in sides)
    print(f"{'ratio':14}{'':26}{theirs.wall / ours.wall:9.1f}{theirs.cpu / ours.cpu:9.1f}")


def main() -> None:
    """Print a table for each case."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=(data_root() or Path()) / "protocols")
    parser.add_argument("--points", type=lambda text: int(float(text)), default=1_000_000)
    parser.add_argument("--runs", type=int, default=3)
    given = parser.parse_args()
    print(setting())
    if (given.data / "expected.json").is_file():
        expected = json.loads((given.data / "expected.json").read_text())["dtu"]
        for name in ("points007.ply", "mesh007.ply"):
            print_case(name, given.data / "dtu", given.data / "dtu" / name, given.runs, expected[name])
    else:
        print(f"missing: the folder {given.data} of the scores of the Python version")
    if given.points:
        with tempfile.TemporaryDirectory() as folder:
            candidate = make_scan(Path(folder), given.points)
            print_case(f"made scan, {given.points:,} points", Path(folder), candidate, given.runs, None)


if __name__ == "__main__":
    main()
