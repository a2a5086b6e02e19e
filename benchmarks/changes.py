"""Count what the search for changes reports: python benchmarks/changes.py [--quick] [--scans FOLDER] [--clouds FOLDER]

Each pair is two disjoint samples of a scene; one gets a change of known place, kind and size. Tables: the share of the
changes that are reported, by kind of change, size (diameter over the scene's extent) and height (over the noise); with
the right kind, the right size (within 25 %) and the share of the changed points that belong to it; ladders of heights
where a larger one is reported less; and pairs without a change for which one is reported. Bounds are those of Clopper
and Pearson 1934 at 95 %.

Scenes are generated, and those of the data folder if it is there. `--scans FOLDER ...` adds clouds in any format, with
vertical z unless the name of the folder ends in `objects`. `--clouds FOLDER ...` adds reconstructed cities; each folder
has what these commands write:

    pcbench synth city --out FOLDER/city --points 200000 ...
    pcbench reconstruct mvs FOLDER/city --out FOLDER/cloud.ply

`--before` answers by the changed tiles of the deformation test instead. `--sample COUNT` limits the samples of the
search to fewer points, so that small clouds stand for large ones, whose parts are too small for a sample of the scene.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
from measure import limit_threads, setting
from real_data import data_note

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from change_cases import (
    HEIGHTS,
    OBJECT_CHANGES,
    SIZES,
    SURFACE_CHANGES,
    WITHOUT_HEIGHT,
    Found,
    Judgement,
    judge,
    ladder,
    objects,
)
from change_scenes import Points, Scene, scenes
from scipy.stats import beta

CHANGES = (*SURFACE_CHANGES, *OBJECT_CHANGES)
QUICK_SIZES, QUICK_HEIGHTS = (0.02, 0.1), (5, 10, 100)
QUICK_SCENES = ("samp42", "hexbin", "source", "stereo Books", "city", "parked cars")
_FALL = 0.05  # share by which the reported volume may fall along a ladder: the noise of an estimate


class Row(NamedTuple):
    """A judged change, with its scene and place; `shown` is the number of points of both clouds that changed."""

    scene: str
    group: str
    change: str
    share: float
    height: float
    seed: int
    shown: int
    judgement: Judgement

    @property
    def place(self) -> tuple[str, str, float, int]:
        return self.scene, self.change, self.share, self.seed

    @property
    def is_counted(self) -> bool:
        """Return whether it is large: 10 noise or an object more or less, and 2 % of the extent."""
        return self.share >= 0.02 and (self.height >= 10 or self.change in WITHOUT_HEIGHT)


class Null(NamedTuple):
    """An unchanged pair, and the number of changes that are reported for it."""

    scene: str
    group: str
    seed: int
    false: int


# ---- answers ----


def answer_now(reference: Points, candidate: Points) -> list[Found]:
    """Return the changes that `find_changes` reports."""
    from pcbench.changes import find_changes
    from pcbench.geometry.neighbors import Index
    from pcbench.geometry.normals import Surface

    result = find_changes(Surface(Index(reference)), Surface(Index(candidate))).of_clouds(reference, candidate)
    answer = []
    for number, change in enumerate(result.found):
        points = np.concatenate([reference[result.of_reference == number], candidate[result.of_candidate == number]])
        size = change.mean if change.motion is None else float(np.linalg.norm(change.motion))
        answer.append(Found(change.kind, size, change.area, points))
    return answer


def answer_before(reference: Points, candidate: Points) -> list[Found]:
    """Return the largest group of changed tiles, if the sentence of the deformation test names a moved part."""
    from pcbench import Cloud
    from pcbench.deformation import deform

    _, found = deform(Cloud(reference, unit="m"), Cloud(candidate, unit="m"), "none")
    local = found.local
    if local is None or local.at is None or not found.has_moved_part:
        return []
    return [Found("moved", local.largest, 0.0, np.array([local.at]))]


def limit_samples(count: int) -> None:
    """Limit the samples of the search for changes, in proportion, to a number of points."""
    from pcbench.changes import details, samples, search

    for module in (samples, details):
        module.MAX_SAMPLE = count
    samples._COUNTED_POINTS, search.MAX_SCREENED = 4 * count, 8 * count


# ---- runs ----


def run(options: argparse.Namespace, chosen: Sequence[Scene]) -> tuple[list[Row], list[Null]]:
    """Return the results of all scenes."""
    answer: Callable[[Points, Points], list[Found]] = answer_before if options.before else answer_now
    sizes, heights = (QUICK_SIZES, QUICK_HEIGHTS) if options.quick else (SIZES, HEIGHTS)
    rows, nulls, start = [], [], time.perf_counter()
    for scene in chosen:
        for seed in range(options.first, options.first + options.nulls):
            sample = scene.make(seed)
            nulls.append(Null(scene.name, scene.group, seed, len(answer(sample.reference, sample.candidate))))
        if scene.group == "stereo to truth":  # what it hides is no known change
            continue
        for seed in range(options.first, options.first + options.runs):
            sample = scene.make(seed)
            standing = objects(sample) if scene.is_upright else []
            for change in CHANGES:
                if options.only not in change:
                    continue
                for share in sizes:
                    for case in ladder(sample, change, share, seed, standing, heights):
                        judged = judge(case.truth, answer(case.truth.reference, case.truth.candidate))
                        shown = len(case.truth.points)
                        rows.append(Row(scene.name, scene.group, change, share, case.height, seed, shown, judged))
        print(f"{scene.name}: {time.perf_counter() - start:.0f} s", file=sys.stderr, flush=True)
    return rows, nulls


def bounds(count: int, runs: int) -> tuple[float, float]:
    """Return the 95 % bounds of a share."""
    low = beta.ppf(0.025, count, runs - count + 1) if count else 0.0
    high = beta.ppf(0.975, count + 1, runs - count) if count < runs else 1.0
    return float(low), float(high)


def counts(count: int, runs: int) -> str:
    """Return a count with its bounds in percent."""
    if not runs:
        return f"{'-':>20}"
    low, high = bounds(count, runs)
    return f"{f'{count} of {runs}':>12}{f'{100 * low:.0f}-{100 * high:.0f}':>8}"


# ---- tables ----


def print_reported(rows: list[Row]) -> None:
    """Print the shares of reported changes by change, size and height."""
    for change in CHANGES:
        of_change = [row for row in rows if row.change == change]
        if not of_change:
            continue
        heights = sorted({row.height for row in of_change})
        labels = [""] if change in WITHOUT_HEIGHT else [f"{height:g} noise" for height in heights]
        print(f"\n{change + ', reported':26}" + "".join(f"{label:>12}" for label in labels))
        for size in sorted({row.share for row in of_change}):
            cells = []
            for height in heights:
                flags = [row.judgement.reported for row in of_change if (row.share, row.height) == (size, height)]
                cells.append(f"{f'{sum(flags)} of {len(flags)}' if flags else '-':>12}")
            print(f"  {100 * size:3.0f} % of the extent     " + "".join(cells))


def print_quality(rows: list[Row]) -> None:
    """Print what is right about the changes, and those elsewhere, by change and by scenes."""
    print(f"\n{'10 noise, 2 % and more':26}{'reported':>12}{'%':>8}{'kind':>12}{'%':>8}{'size':>12}{'%':>8}", end="")
    print(f"{'points':>8}{'false elsewhere':>18}{'%':>8}")
    counted = [row for row in rows if row.is_counted]
    by_change = [(name, [row for row in counted if row.change == name]) for name in CHANGES]
    groups = list(dict.fromkeys(row.group for row in counted))
    by_group = [(name, [row for row in counted if row.group == name]) for name in groups]
    for name, of_name in (*by_change, *by_group, ("all", counted)):
        if not of_name:
            continue
        reported = [row.judgement for row in of_name if row.judgement.reported]
        sized = [result for result in reported if result.size_right is not None]
        cells = counts(len(reported), len(of_name))
        cells += counts(sum(result.kind_right for result in reported), len(reported))
        cells += counts(sum(bool(result.size_right) for result in sized), len(sized))
        recall = f"{np.mean([result.recall for result in reported]):8.2f}" if reported else f"{'-':>8}"
        elsewhere = sum(row.judgement.false > 0 for row in of_name)
        print(f"{name:26}{cells}{recall}      {counts(elsewhere, len(of_name))}")


def falls(rows: list[Row]) -> Iterator[str]:
    """Yield the ladders on which a larger change is reported less: not at all, or with less volume."""
    for key in dict.fromkeys(row.place for row in rows):
        steps = [row for row in rows if row.place == key]
        for small, large in pairwise(steps):
            before, after = small.judgement, large.judgement
            place = (
                f"{key[0]}, {key[1]} of {100 * key[2]:g} %, seed {key[3]}: {small.height:g} -> {large.height:g} noise"
            )
            if before.reported and not after.reported:
                yield f"{place}: no longer reported"
            elif before.volume and after.volume is not None and after.volume < (1 - _FALL) * before.volume:
                yield f"{place}: area times size from {before.volume:.4g} to {after.volume:.4g}"


def print_falls(rows: list[Row]) -> None:
    ladders = {row.place for row in rows if row.change not in WITHOUT_HEIGHT}
    found = list(falls(rows))
    print(f"\nsteps of {len(ladders)} ladders of heights at which a larger change is reported less: {len(found)}")
    for line in found:
        print(f"  {line}")


def print_failures(rows: list[Row]) -> None:
    """Print the large changes that are not reported, or not rightly, and changes elsewhere."""
    for row in rows:
        found = row.judgement
        wrong = [] if found.reported or not row.is_counted else ["not reported"]
        wrong += [] if found.kind_right or not found.reported else ["other kind"]
        wrong += [] if found.size_right is not False or not found.reported else ["other size"]
        wrong += [f"{found.false} elsewhere"] if found.false else []
        if wrong:
            place = f"{row.scene}, seed {row.seed}: {row.change} of {100 * row.share:g} %, {row.height:g} noise"
            print(f"  {place}, {row.shown} points: {', '.join(wrong)}")


def print_nulls(nulls: list[Null]) -> None:
    """Print for how many unchanged pairs a change is reported."""
    if not nulls:
        return
    print(f"\n{'unchanged':26}{'with a change':>14}{'%':>6}{'changes':>10}")
    groups = [(name, [null for null in nulls if null.group == name]) for name in dict.fromkeys(n.group for n in nulls)]
    names = [(f"  {name}", [n for n in nulls if n.scene == name]) for name in dict.fromkeys(n.scene for n in nulls)]
    names = [(name, of_name) for name, of_name in names if any(null.false for null in of_name)]
    for name, of_name in (*groups, *names):
        wrong = sum(null.false > 0 for null in of_name)
        print(f"{name:26}{counts(wrong, len(of_name))}{sum(null.false for null in of_name):10}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="few scenes, sizes and heights")
    parser.add_argument("--runs", type=int, default=1, help="places of each change and size in a scene")
    parser.add_argument("--nulls", type=int, default=2, help="unchanged pairs of each scene")
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--scenes", default="", help="only scenes whose name or group contains one of these, by commas")
    parser.add_argument("--only", default="", help="only changes whose name contains this text")
    parser.add_argument("--scans", type=Path, nargs="*", default=[], help="folders of further scans")
    parser.add_argument("--clouds", type=Path, nargs="*", default=[], help="folders of reconstructed cities")
    parser.add_argument("--failures", action="store_true", help="list the failures")
    parser.add_argument("--before", action="store_true", help="answer by the tiles of the deformation test")
    parser.add_argument("--sample", type=int, help="largest sample of the search for changes")
    options = parser.parse_args()
    limit_threads(1)
    if options.sample:
        limit_samples(options.sample)
    print(setting() + data_note(), flush=True)
    texts = options.scenes.split(",") if options.scenes else QUICK_SCENES if options.quick else [""]
    chosen = [
        scene
        for scene in scenes(options.scans, options.clouds)
        if any(text in (scene.name, scene.group) or (text in scene.name and not options.quick) for text in texts)
    ]
    rows, nulls = run(options, chosen)
    print_reported(rows)
    if rows:
        print_quality(rows)
        print_falls(rows)
        if options.failures:
            print("\nfailures")
            print_failures(rows)
    print_nulls(nulls)


if __name__ == "__main__":
    main()
