"""Synthetic cities for comparing clouds of Gaussians with the exact surface."""

import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pcbench.geometry.neighbors import Index
from pcbench.scenes import Scene, read_scene
from pcbench.studies.bench.truth import Truth, mesh_of, read_truth

CASES = {
    "circles, seed 11": "--rig circles --seed 11",
    "circles, seed 12": "--rig circles --seed 12",
    "oblique, half texture": "--rig oblique --texture 0.5 --seed 7",
    "grid, hard": "--rig grid --hard --seed 5",
    "oblique, flat": "--rig oblique --texture 0 --density 0.02 --relief 0 --seed 22",
}
EXTENT = 100  # size of the cities, in metres
FOOTPRINTS = 2  # pixel footprints: the distance threshold of precision and recall
MAX_SCORED_POINTS = 60_000  # of the cloud and of the truth: the error of means and shares is at most half a percent


class City(NamedTuple):
    """The scene of a city and its exact surface."""

    scene: Scene
    truth: Truth


class CloudScore(NamedTuple):
    """Distances between a cloud and the true surface.

    Attributes:
        points: number of points of the cloud.
        accuracy: mean distance from the cloud to the true surface, metres.
        accuracy_by_area: the same if each cubic cell with an edge of one footprint counts once, by one random point. A
            cloud that has more points where it is accurate does not gain.
        completeness, seen: mean distance from the points of the true cloud to the cloud, over all points and over those
            visible to at least three cameras, metres.
        precision, recall, recall_seen: shares within two pixel footprints.
    """

    points: int
    accuracy: float
    accuracy_by_area: float
    completeness: float
    seen: float
    precision: float
    recall: float
    recall_seen: float

    @property
    def fscore(self) -> float:
        """F-score over the whole true cloud."""
        return 2 * self.precision * self.recall / max(self.precision + self.recall, 1e-9)

    @property
    def fscore_seen(self) -> float:
        """F-score over the part of the true cloud that at least three cameras see."""
        return 2 * self.precision * self.recall_seen / max(self.precision + self.recall_seen, 1e-9)


def city(folder: Path, case: str, images: int, size: str) -> City:
    """Return the photographed city of a case, synthesized unless the folder exists.

    A case is a key of `CASES`, or "RIG, seed NUMBER".
    """
    if not folder.exists():
        folder.parent.mkdir(parents=True, exist_ok=True)
        options = ["--extent", EXTENT, "--points", 200_000, "--images", images, "--size", size, "--quiet"]
        arguments = ["synth", "city", "--out", folder, *options, *_options(case).split()]
        subprocess.run([sys.executable, "-m", "pcbench.cli", *map(str, arguments)], check=True)
    return read_city(folder)


def read_city(folder: Path) -> City:
    """Read a photographed city, with the part of its surface that the cameras saw."""
    scene, reference = read_scene(folder), folder / "truth" / "cloud.ply"
    return City(scene, read_truth(reference, mesh_of(folder, reference), scene.cameras, print))


def _options(case: str) -> str:
    if case in CASES:
        return CASES[case]
    rig, seed = case.split(", seed ")
    return f"--rig {rig} --seed {int(seed)}"


def score_cloud(truth: Truth, points: np.ndarray) -> CloudScore:
    """Compare a cloud with the true surface, in both directions."""
    rng = np.random.default_rng(0)
    cloud_rows = rng.permutation(len(points))[:MAX_SCORED_POINTS]
    truth_rows = rng.permutation(len(truth.cloud))[:MAX_SCORED_POINTS]
    local = points - truth.origin
    to_truth = truth.local_surface.query(local[cloud_rows]).distances
    by_area = truth.local_surface.query(local[_rows_by_area(local, truth.pixel, rng)]).distances
    from_truth = Index(local).query(truth.cloud.points[truth_rows] - truth.origin).distances
    is_seen, limit = truth.visible[truth_rows], FOOTPRINTS * truth.pixel
    return CloudScore(
        len(points),
        float(to_truth.mean()),
        float(by_area.mean()),
        float(from_truth.mean()),
        float(from_truth[is_seen].mean()),
        *(float(np.mean(distances <= limit)) for distances in (to_truth, from_truth, from_truth[is_seen])),
    )


def _rows_by_area(points: np.ndarray, side: float, rng: np.random.Generator) -> np.ndarray:
    """Return a random point (M,) of each cubic cell, of at most as many cells as points are scored."""
    order = rng.permutation(len(points))
    cells = np.floor(points[order] / side).astype(np.int64)
    rows = order[np.unique(cells, axis=0, return_index=True)[1]]
    return rng.permutation(rows)[:MAX_SCORED_POINTS]
