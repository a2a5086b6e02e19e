"""Is a wrong pose ever returned without a warning? python benchmarks/registration_trials.py

--trials 20       trials per scene
--methods icp,similarity,global,global-similarity
--only forest     only these scenes
--meshes FOLDER   additional scenes, one per file
--start 0         index of the first trial
--rows FILE       save the outcomes

Each trial cuts one cloud into two halves without common points that overlap in part. It adds noise of 0.2 spacings to
both, thins the candidate, and moves it by 5 to 60 degrees and up to 5 % of the extent; with a scale of 0.5 to 2 if the
method solves for one. A pose is right if the candidate is within one spacing of the reference (root mean square) of its
true position. Any other pose is wrong: *said* if it comes with a warning, *refused* if no pose is returned, otherwise
*silent*. Every tenth candidate is a mirror image, which has no right pose.
"""

import argparse
import json
import resource
import time
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from measure import setting
from real_data import data_note
from registration_cases import rotation
from registration_scenes import HELD_OUT, TUNED, Scene, available_scenes, mesh_scenes

from pcbench import register
from pcbench.errors import RegistrationError
from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.neighbors import Index
from pcbench.geometry.sampling import median_spacing
from pcbench.geometry.transform import Similarity
from pcbench.geometry.voxels import robust_extent

METHODS = ("icp", "similarity", "global", "global-similarity")
ANGLES, OVERLAPS, RATIOS, NOISE = (5, 10, 15, 20, 30, 45, 60), (0.3, 0.5, 0.7, 1.0), (1, 4), 0.2
SYMMETRIC = ("teapot", "airplane", "ant")  # equal to their mirror images
KINDS = ("right", "right, warned", "said", "silent", "refused")


class Trial(NamedTuple):
    """Two clouds, the true pose candidate -> reference (None for a mirror image), and the reference's spacing."""

    reference: FloatArray
    candidate: FloatArray
    true: Similarity | None
    spacing: float
    angle: float
    overlap: float
    ratio: int


def make_trial(name: str, scene: Scene, method: str, number: int) -> Trial:
    """Create a trial; the same index gives the same trial for all methods with, or without, a scale."""
    rng = np.random.default_rng([number, *name.encode()])
    points = rng.permutation(scene(number))
    reference, moving = points[::2], points[1::2]
    angle, overlap, ratio = (rng.choice(values) for values in (ANGLES, OVERLAPS, RATIOS))
    if method.startswith("global"):
        angle = rng.uniform(5, 180)
    upright = np.ptp(points[:, 2]) < 0.3 * np.ptp(points[:, :2], axis=0).max()  # flat scenes are cut vertically
    direction = rng.normal(size=3) * [1, 1, not upright]
    coordinates = [cloud @ (direction / np.linalg.norm(direction)) for cloud in (reference, moving)]
    width = 1 / (2 - overlap)
    reference = reference[coordinates[0] <= np.quantile(coordinates[0], width)]
    moving = moving[coordinates[1] >= np.quantile(coordinates[1], 1 - width)][::ratio]
    spacing = median_spacing(Index(reference))
    reference, moving = (cloud + rng.normal(0, NOISE * spacing, cloud.shape) for cloud in (reference, moving))
    axis, heading = rng.normal(size=(2, 3))
    axis = [0, 0, 1] + 0.1 * axis if upright and rng.random() < 0.5 else axis
    scale = float(np.exp(rng.uniform(-np.log(2), np.log(2)))) if "similarity" in method else 1.0
    mirrored = name not in SYMMETRIC and rng.random() < 0.1
    R, center = rotation(axis / np.linalg.norm(axis), np.radians(angle)), moving.mean(axis=0)
    shift = rng.uniform(0, 0.05) * robust_extent(reference) * heading / np.linalg.norm(heading)
    T_true = Similarity(R, center + shift - scale * R @ center, scale)
    if mirrored:
        moving = (moving - center) * [-1, 1, 1] + center
    candidate = T_true.inverse().apply(moving)
    return Trial(reference, candidate, None if mirrored else T_true, spacing, float(angle), overlap, ratio)


def run_trial(name: str, scene: Scene, method: str, number: int) -> dict:
    """Run a method on one trial and classify its pose."""
    trial = make_trial(name, scene, method, number)
    row = {"scene": name, "method": method, "number": number, "angle": trial.angle, "overlap": trial.overlap}
    row |= {"ratio": int(trial.ratio), "mirrored": trial.true is None, "off": None, "codes": []}
    cpu = _cpu_seconds()
    try:
        registration = register(trial.reference, trial.candidate, method)
    except RegistrationError:
        return row | {"kind": "refused", "cpu": _cpu_seconds() - cpu}
    row |= {"cpu": _cpu_seconds() - cpu, "codes": [notice.code for notice in registration.warnings]}
    row["contrast"] = registration.contrast
    row["pose"] = registration.T_reference_candidate.matrix.tolist()
    if trial.true is not None:
        expected = trial.true.apply(trial.candidate)
        aligned = registration.T_reference_candidate.apply(trial.candidate)
        row["off"] = float(np.sqrt(np.square(aligned - expected).sum(axis=1).mean()) / trial.spacing)
    if row["off"] is not None and row["off"] <= 1:
        return row | {"kind": "right, warned" if registration.warnings else "right"}
    return row | {"kind": "said" if registration.warnings else "silent"}


def run_trials(scenes: dict[str, Scene], methods: Iterable[str], numbers: Iterable[int]) -> list[dict]:
    """Run all trials and print their tables."""
    rows = []
    for method in methods:
        print(f"\n{method:20}{'trials':>8}" + "".join(f"{kind:>15}" for kind in KINDS) + f"{'CPU s':>8}")
        for name, scene in scenes.items():
            outcomes = [run_trial(name, scene, method, number) for number in numbers]
            _print(name, outcomes)
            rows += outcomes
        _print("all", [row for row in rows if row["method"] == method])
    return rows


def _print(name: str, rows: list[dict]) -> None:
    counts = [sum(row["kind"] == kind for row in rows) for kind in KINDS]
    cpu = float(np.median([row["cpu"] for row in rows]))
    print(f"{name:20}{len(rows):8}" + "".join(f"{count:15}" for count in counts) + f"{cpu:8.2f}", flush=True)


def _cpu_seconds() -> float:
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.process_time() + children.ru_utime + children.ru_stime


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=20)
    parser.add_argument("--start", type=int, default=0)
    parser.add_argument("--methods", default=",".join(METHODS))
    parser.add_argument("--only")
    parser.add_argument("--meshes", type=Path)
    parser.add_argument("--rows", type=Path)
    options = parser.parse_args()
    print(setting() + data_note())
    scenes = available_scenes(TUNED | HELD_OUT) | (mesh_scenes(options.meshes) if options.meshes else {})
    if options.only:
        scenes = {name: scenes[name] for name in options.only.split(",")}
    numbers = range(options.start, options.start + options.trials)
    rows = run_trials(scenes, options.methods.split(","), numbers)
    if options.rows:
        options.rows.write_text(json.dumps(rows))


if __name__ == "__main__":
    main()
