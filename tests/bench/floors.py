"""Scores of independent, error-free samples over their sampling floors: python tests/bench/floors.py [--runs 60]

Every row is a surface, the numbers of points of the reference and the candidate, and how much denser the candidate is
at one end of the scene than at the other. The mean score over runs is divided by the mean floor: 1 is right. `--noise`
displaces the candidate along the normals, in its own mean spacings: the score grows, and the floor should not.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from measure import limit_threads, setting
from surfaces import surface

from pcbench import Cloud, Settings
from pcbench.geometry.neighbors import Index
from pcbench.measure.directions import MEAN_METRICS, Direction, from_candidate, from_reference
from pcbench.measure.reference import Reference

METRICS = tuple(metric.name for metric in MEAN_METRICS)
SURFACES = ("plane", "torus", "sphere", "cylinder", "boxes", "city")
NOISES = (0.0, 0.25, 0.5, 1.0, 2.0)


class Case(NamedTuple):
    surface: str
    reference: int
    candidate: int
    falling: float = 1.0
    noise: float = 0.0  # mean spacings of the candidate


CASES = tuple(
    Case(name, reference, candidate, falling)
    for name in SURFACES
    for reference, candidate, falling in (
        (50, 50, 1),
        (200, 200, 1),
        (1_000, 1_000, 1),
        (5_000, 5_000, 1),
        (8_000, 2_000, 1),
        (8_000, 500, 1),
        (2_000, 8_000, 1),
        (500, 8_000, 1),
        (4_000, 4_000, 16),
    )
)


def directions(case: Case, run: int) -> tuple[Direction, Direction]:
    """Candidate → reference and back, of one draw of both."""
    rng = np.random.default_rng([run, *case[1:3]])
    reference, _ = surface(case.surface).sample(case.reference, rng)
    candidate, normals = surface(case.surface).sample(case.candidate, rng, case.falling)
    size = case.noise * len(candidate) ** -0.5
    candidate = candidate + size * rng.normal(size=(len(candidate), 1)) * normals
    prepared = Reference.prepare(Cloud(reference), Settings())
    index = Index(candidate - prepared.origin)
    forth, back = prepared.index.query(index.points), index.query(prepared.points)
    accuracy = from_candidate(prepared, index.points, forth)
    return accuracy, from_reference(prepared, index, forth.indices, back, forth=accuracy, seed=run)


class Row(NamedTuple):
    """Mean scores and floors (2, METRICS) of both directions."""

    scores: np.ndarray
    floors: np.ndarray


def measured(case: Case, runs: int) -> Row:
    scores, floors = np.zeros((2, 2, len(METRICS)))
    for run in range(runs):
        for way, direction in enumerate(directions(case, run)):
            for column, metric in enumerate(MEAN_METRICS):
                values, floor = metric.of_each(direction.distances), direction.floors[metric.name]
                assert values is not None
                assert floor is not None
                scores[way, column] += np.mean(values) / runs
                floors[way, column] += floor / runs
    return Row(scores, floors)


def noisy(sizes: tuple[float, ...] = NOISES) -> Iterator[Case]:
    for name in ("plane", "torus", "boxes"):
        for size in sizes:
            yield Case(name, 5_000, 5_000, noise=size)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=60)
    parser.add_argument("--noise", action="store_true")
    options = parser.parse_args()
    limit_threads(1)
    print(setting())
    print(f"{'':40}" + "".join(f"{way} {name:14}" for way in ("c→r", "r→c") for name in METRICS))
    plain = {}
    for case in noisy() if options.noise else CASES:
        row = measured(case, options.runs)
        cells = row.scores / np.maximum(row.floors, 1e-30)
        if options.noise:  # beside it, the floor over that without noise
            if case.noise == 0:
                plain[case.surface] = row.floors
            others = row.floors / np.maximum(plain[case.surface], 1e-30)
            text = "".join(f"{a:8.2f} ({b:4.2f})   " for a, b in zip(cells.ravel(), others.ravel(), strict=True))
        else:
            text = "".join(f"{cell:10.3f}        " for cell in cells.ravel())
        name, reference, candidate, falling, noise = case
        print(f"{name:9}{reference:7,}{candidate:7,}  falling {falling:3g} noise {noise:4.2f}" + text, flush=True)


if __name__ == "__main__":
    main()
