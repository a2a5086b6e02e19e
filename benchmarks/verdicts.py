"""Count right, withheld and wrong verdicts on deformation: python benchmarks/verdicts.py [--runs 10] [--only TEXT]

Three tables. *Undeformed*: pairs of independent samples of generated scenes with many kinds of noise, random halves of
real scans, and reconstructed clouds with true cameras. *Deformed*: the same pairs, with candidates deformed by 1, 2 and
4 times the size that the verdict on the undeformed pair calls detectable, in one kind after the other. *Small change*:
the verdict with the roles of both clouds swapped, with five points less, and from another start.

Each candidate starts displaced by a few spacings and is registered by ICP. Real scans are left out if the data folder
is absent. `--clouds FOLDER ...` adds reconstructed clouds; each folder has what these commands write:

    pcbench synth city --out FOLDER/city --points 400000 ...
    pcbench reconstruct mvs FOLDER/city --out FOLDER/cloud.ply      (and splat.ply, sfm.ply)

`--first SEED` selects other scenes, noise, halves and starts; `--jobs N` runs pairs in N processes.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from measure import setting
from real_data import data_note, data_root

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

import deformation_cases
import pytest
from deformation_cases import NULLS, true_rms

from pcbench import Cloud, read_cloud
from pcbench.deformation import Deformation, deform
from pcbench.deformation.model import KINDS
from pcbench.errors import RegistrationError
from pcbench.geometry.neighbors import Index
from pcbench.geometry.sampling import median_spacing
from pcbench.geometry.transform import Similarity
from pcbench.studies.stress.ladders.photogrammetric import PHOTOGRAMMETRIC_LADDERS
from pcbench.studies.stress.scenes import SCENES, WOODED, scene_pair

Points = np.ndarray
TIMES = (1, 2, 4)  # of the detectable size
MAX_POINTS = 150_000  # of a reconstructed candidate
HALVES = ("scans/webots1.xyz", "scans/vehicle0.xyz", "small_gicp/source.ply", "small_gicp/target.ply")


class Pair(NamedTuple):
    reference: Cloud
    candidate: Cloud  # at its true pose


class Case(NamedTuple):
    group: str
    make: Callable[[int], Pair]


class Row(NamedTuple):
    """Result on one pair; `times` is 0 for an undeformed one, and -1 for a small change.

    A verdict that holds only if the pose is right ends in ` (?)`.
    """

    group: str
    kind: str
    times: float
    verdict: str
    doubted: bool
    warned: bool
    ratio: float | None = None  # found size over true size
    covered: bool | None = None
    changed: bool = False


# ---- pairs ----


def sampled(name: str, seed: int) -> Pair:
    """Return two samples of a built-in scene: sparse or dense, in full or with half of the candidate cut off."""
    rng = np.random.default_rng([seed, 11])
    pair = scene_pair(name, seed, int(rng.choice([8_000, 24_000, 60_000])))
    points = pair.points
    if seed % 2:
        along = points[:, :2] @ rng.normal(size=2)
        points = points[along > np.quantile(along, rng.uniform(0.2, 0.6))]
    return Pair(metres(pair.reference), metres(points))


def resampled(method: str, seed: int) -> Pair:
    """Return a sampled city or terrain with the measured errors of dense stereo or splatting."""
    rng = np.random.default_rng([seed, 12])
    ladder = next(ladder for ladder in PHOTOGRAMMETRIC_LADDERS if method in ladder.name)
    pair = scene_pair(("city", "terrain")[seed % 2], seed, int(rng.choice([24_000, 60_000])))
    pair = ladder.perturb(pair, float(rng.choice([0.5, 1.0, 2.0])), rng)
    return Pair(metres(pair.reference), metres(pair.points))


def halves(file: Path, seed: int) -> Pair:
    """Return disjoint random parts of a real scan, 30 to 50 % as the reference."""
    cloud, rng = read_cloud(file), np.random.default_rng([seed, 13])
    is_first = rng.random(len(cloud)) < rng.uniform(0.3, 0.5)
    return Pair(cloud.select(np.flatnonzero(is_first)), cloud.select(np.flatnonzero(~is_first)))


def reconstructed(folder: Path, file: str, seed: int) -> Pair:
    """Return the visible true surface and a random part of a reconstructed cloud."""
    truth, cloud, rng = read_cloud(folder / "city/truth/cloud.ply"), read_cloud(folder / file), _rng(seed, 14)
    if (visible := truth.attributes.get("visible")) is not None:
        truth = truth.select(np.flatnonzero(np.asarray(visible) != 0))
    rows = rng.permutation(len(cloud))[: int(rng.uniform(0.3, 1.0) * min(len(cloud), MAX_POINTS))]
    if seed % 2:
        along = cloud.points[rows, :2] @ rng.normal(size=2)
        rows = rows[along > np.quantile(along, rng.uniform(0.2, 0.6))]
    return Pair(truth, cloud.select(np.sort(rows)))


def generated(make: Callable[[int], object], seed: int) -> Pair:
    pair = make(seed)
    return Pair(pair.reference, pair.candidate)


def metres(points: Points) -> Cloud:
    return Cloud(points, unit="m")


def cases(folders: list[Path]) -> list[Case]:
    """Return all cases whose data are there."""
    found = [Case(f"sampled {name}", partial(sampled, name)) for name in (*SCENES, WOODED)]
    found += [Case(f"{method} errors", partial(resampled, method)) for method in ("mvs", "splat")]
    found += [Case(name, partial(generated, make)) for name, make in NULLS.items()]
    if root := data_root():
        found += [Case(f"halves {Path(file).stem}", partial(halves, root / file)) for file in HALVES]
    for file in ("cloud.ply", "splat.ply", "sfm.ply"):
        files = [folder for folder in folders if (folder / file).exists()]
        name = {"cloud.ply": "mvs clouds"}.get(file, f"{Path(file).stem} clouds")
        if files:
            found.append(
                Case(name, lambda seed, files=files, file=file: reconstructed(files[seed % len(files)], file, seed))
            )
    return found


# ---- deformations ----


def field(kind: str, points: Points) -> Callable[[Points], Points]:
    """Return a function from positions (N, 3) to displacements (N, 3) of a kind."""
    low, high = np.percentile(points, [1, 99], axis=0)
    centre, scale = (low + high) / 2, (high - low)[:2].max() / 2

    def displacement(places: Points) -> Points:
        position = (places - centre) / scale
        values = np.zeros_like(places)
        for axis, powers in KINDS[kind].items():
            value = sum(np.prod(position**power, axis=1) for power in powers)
            values[:, "xyz".index(axis[-1])] += -value if axis.startswith("-") else value
        return values

    return displacement


def displaced(cloud: Cloud, spacing: float, seed: int) -> Cloud:
    """Return the cloud displaced by up to three spacings and rotated by as much at its border."""
    rng = _rng(seed, 15)
    centre = cloud.points.mean(axis=0)
    radius = float(np.sqrt(np.square(cloud.points - centre).sum(axis=1).mean()))
    angles = rng.uniform(-1, 1, 3) * spacing / radius
    rotation = np.eye(3) + np.cross(np.eye(3), angles)
    rotation = np.linalg.qr(rotation)[0] * np.sign(np.diag(np.linalg.qr(rotation)[1]))
    shift = centre - rotation @ centre + rng.uniform(-3, 3, 3) * spacing
    return cloud.transformed(Similarity(rotation, shift))


def evaluate(reference: Cloud, candidate: Cloud) -> tuple[Deformation, bool, bool] | None:
    """Return the verdict, whether the pose is doubted, and whether the registration has any warning."""
    try:
        registration, found = deform(reference, candidate, "icp")
    except RegistrationError:
        return None
    return found, registration.doubtful, bool(registration.warnings)


def run(case: Case, first_kind: int, seed: int, tables: str) -> list[Row]:
    """Return the results on one undeformed pair and its deformed and changed variants."""
    try:
        pair = case.make(seed)
    except pytest.skip.Exception:
        return []
    spacing = median_spacing(Index(pair.reference.points))
    rows, group = [], case.group
    result = evaluate(pair.reference, displaced(pair.candidate, spacing, seed))
    if result is None:
        return [Row(group, "", 0, "refused", True, True)]
    base, doubted, warned = result
    rows.append(Row(group, "", 0, base.label, doubted, warned))
    if "changes" in tables:
        rows += changed_rows(group, pair, spacing, seed, base)
    if "bends" not in tables:
        return rows
    known = [size for size in base.detectable if size.displacement is not None]
    for size in known[first_kind % len(known) :][:1] if known else ():
        bend = field(size.kind, pair.candidate.points)
        unit_rms, _ = true_rms(deformation_cases.Pair(pair.reference, pair.candidate, bend))
        for times in TIMES:
            bent = replace(
                pair.candidate, points=pair.candidate.points + times * size.rms / unit_rms * bend(pair.candidate.points)
            )
            result = evaluate(pair.reference, displaced(bent, spacing, seed))
            if result is None:
                rows.append(Row(group, size.kind, times, "refused", True, True))
                continue
            found, doubted, warned = result
            size_found, ratio, covered = found.amplitude, None, None
            if found.verdict == "non-affine" and size_found is not None:
                truth = times * size.rms
                ratio, covered = size_found.rms / truth, size_found.ci[0] <= truth <= size_found.ci[1]
            rows.append(Row(group, size.kind, times, found.label, doubted, warned, ratio, covered))
    return rows


def changed_rows(group: str, pair: Pair, spacing: float, seed: int, base: Deformation) -> list[Row]:
    """Return the verdicts on the pair with small changes that should not matter."""
    rng = _rng(seed, 16)
    fewer = pair.candidate.select(np.sort(rng.permutation(len(pair.candidate))[5:]))
    variants = {
        "roles swapped": (pair.candidate, displaced(pair.reference, spacing, seed)),
        "five points less": (pair.reference, displaced(fewer, spacing, seed)),
        "another start": (pair.reference, displaced(pair.candidate, spacing, seed + 1000)),
    }
    rows = []
    for name, (reference, candidate) in variants.items():
        result = evaluate(reference, candidate)
        verdict = "refused" if result is None else result[0].label
        rows.append(Row(group, name, -1, verdict, False, False, changed=verdict != base.label))
    return rows


def _rng(seed: int, stream: int) -> np.random.Generator:
    return np.random.default_rng([seed, stream])


# ---- tables ----


def print_undeformed(rows: list[Row]) -> None:
    rows = [row for row in rows if row.times == 0]
    print(
        f"\nundeformed{'':16}{'runs':>5}{'none':>6}{'affine':>8}{'non-affine':>12}{'undecided':>11}{'doubted':>9}{'warned':>8}"
    )
    for group, of_group in _groups(rows):
        verdicts = [row.verdict for row in of_group]
        affine = verdicts.count("affine") + verdicts.count("similarity")
        withheld = len(verdicts) - verdicts.count("none") - affine - verdicts.count("non-affine")
        print(
            f"{group:26}{len(verdicts):5}{verdicts.count('none'):6}{affine:8}{verdicts.count('non-affine'):12}"
            f"{withheld:11}{sum(row.doubted for row in of_group):9}{sum(row.warned for row in of_group):8}"
        )


def print_deformed(rows: list[Row]) -> None:
    rows = [row for row in rows if row.times > 0]
    if not rows:
        return
    print(f"\ndeformed{'':18}{'times':>6}{'runs':>5}{'found':>7}{'(?)':>7}{'undecided':>11}{'missed':>8}", end="")
    print(f"{'size':>7}{'range':>14}{'within 20 %':>13}{'covered':>9}")
    by_kind = [row._replace(group=row.kind) for row in rows]
    for times in TIMES:
        for group, of_group in (*_groups(rows, times)[:-1], *_groups(by_kind, times)):
            found = [row for row in of_group if row.verdict == "non-affine"]
            assumed = sum(row.verdict == "non-affine (?)" for row in of_group)
            missed = sum(row.verdict in ("none", "affine", "similarity") for row in of_group)
            ratios = [row.ratio for row in found if row.ratio is not None]
            sizes = f"{np.median(ratios):7.2f}{min(ratios):7.2f}-{max(ratios):<6.2f}" if ratios else f"{'':21}"
            near = sum(abs(ratio - 1) <= 0.2 for ratio in ratios)
            covered = sum(bool(row.covered) for row in found)
            print(
                f"{group:26}{times:6}{len(of_group):5}{len(found):7}{assumed:7}"
                f"{len(of_group) - len(found) - assumed - missed:11}{missed:8}{sizes}{near:13}{covered:9}"
            )


def print_changes(rows: list[Row]) -> None:
    rows = [row for row in rows if row.times < 0]
    if not rows:
        return
    print(f"\nsmall change{'':14}{'runs':>5}{'another verdict':>17}")
    for name in dict.fromkeys(row.kind for row in rows):
        of_name = [row for row in rows if row.kind == name]
        print(f"{name:26}{len(of_name):5}{sum(row.changed for row in of_name):17}")


def _groups(rows: list[Row], times: float | None = None) -> list[tuple[str, list[Row]]]:
    rows = rows if times is None else [row for row in rows if row.times == times]
    names = sorted({row.group for row in rows}, key=[row.group for row in rows].index)
    return [(name, [row for row in rows if row.group == name]) for name in names] + [("all", rows)]


def run_all(jobs: int, tasks: list[tuple[str, int, int, str]], folders: list[Path]) -> Iterator[list[Row]]:
    if jobs == 1:
        yield from (_run_task(folders, task) for task in tasks)
        return
    with multiprocessing.get_context("spawn").Pool(jobs) as pool:
        yield from pool.imap_unordered(partial(_run_task, folders), tasks)


def _run_task(folders: list[Path], task: tuple[str, int, int, str]) -> list[Row]:
    name, number, seed, tables = task
    case = next(case for case in cases(folders) if case.group == name)
    return run(case, number, seed, tables)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=10, help="pairs of each group")
    parser.add_argument("--first", type=int, default=500, help="first seed")
    parser.add_argument("--only", default="", help="only groups whose name contains this text")
    parser.add_argument("--tables", default="bends,changes", help="tables beside that of undeformed pairs")
    parser.add_argument("--clouds", type=Path, nargs="*", default=[], help="folders of reconstructed clouds")
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    options = parser.parse_args()
    os.environ["OMP_NUM_THREADS"] = "1" if options.jobs > 1 else str(os.cpu_count())  # for the processes
    print(setting() + data_note())
    groups = [case.group for case in cases(options.clouds) if options.only in case.group]
    tasks = [
        (group, number, options.first + number, options.tables) for number in range(options.runs) for group in groups
    ]
    rows, start = [], time.perf_counter()
    for number, found in enumerate(run_all(options.jobs, tasks, options.clouds), 1):
        rows += found
        for row in found:
            if row.times == 0 and row.verdict != "none":
                print(f"{row.group}: {row.verdict}{', pose doubted' if row.doubted else ''}", file=sys.stderr)
        if number % 20 == 0:
            print(f"{number} of {len(tasks)} pairs, {time.perf_counter() - start:.0f} s", file=sys.stderr, flush=True)
    order = {group: place for place, group in enumerate(groups)}
    rows.sort(key=lambda row: order[row.group])
    print_undeformed(rows)
    print_deformed(rows)
    print_changes(rows)


if __name__ == "__main__":
    main()
