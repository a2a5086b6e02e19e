"""Synthetic cities on which clouds of Gaussians are held against the exact surface."""

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
EXTENT = 100  # of the cities, in metres
FOOTPRINTS = 2  # of a pixel: what precision and recall allow
JUDGED = 60_000  # points of cloud and of truth at most: means and shares of them are right to half a percent


class City(NamedTuple):
    scene: Scene
    truth: Truth


class CloudScore(NamedTuple):
    """Of a cloud against the surface.

    Attributes:
        points: how many there are.
        accuracy: mean distance from them to the true surface, metres.
        completeness, seen: mean distance from the true cloud's points to the nearest of them, over all and over those
            that at least three cameras see.
        precision, recall, recall_seen: shares within two footprints of a pixel.
    """

    points: int
    accuracy: float
    completeness: float
    seen: float
    precision: float
    recall: float
    recall_seen: float

    @property
    def fscore(self) -> float:
        return 2 * self.precision * self.recall / max(self.precision + self.recall, 1e-9)

    @property
    def fscore_seen(self) -> float:
        return 2 * self.precision * self.recall_seen / max(self.precision + self.recall_seen, 1e-9)


def city(folder: Path, case: str, images: int, size: str) -> City:
    """The city of a case, photographed; made if the folder is not there."""
    if not folder.exists():
        folder.parent.mkdir(parents=True, exist_ok=True)
        fixed = ["--extent", EXTENT, "--points", 200_000, "--images", images, "--size", size, "--quiet"]
        words = ["synth", "city", "--out", folder, *fixed, *CASES[case].split()]
        subprocess.run([sys.executable, "-m", "pcbench.cli", *map(str, words)], check=True)
    scene, reference = read_scene(folder), folder / "truth" / "cloud.ply"
    return City(scene, read_truth(reference, mesh_of(folder, reference), scene.cameras, print))


def score_cloud(truth: Truth, points: np.ndarray) -> CloudScore:
    rng = np.random.default_rng(0)
    judged = rng.permutation(len(points))[:JUDGED]
    places = rng.permutation(len(truth.cloud))[:JUDGED]
    local = points - truth.origin
    there = truth.local_surface.query(local[judged]).distances
    back = Index(local).query(truth.cloud.points[places] - truth.origin).distances
    seen, limit = truth.visible[places], FOOTPRINTS * truth.pixel
    return CloudScore(
        len(points),
        float(there.mean()),
        float(back.mean()),
        float(back[seen].mean()),
        *(float(np.mean(distances <= limit)) for distances in (there, back, back[seen])),
    )
