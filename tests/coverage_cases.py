"""Coverage of 95 % intervals over draws of both clouds and of the candidate's noise."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from surfaces import surface

from pcbench import Cloud, Settings
from pcbench.errors import Notice
from pcbench.geometry.neighbors import Index, match_both_directions
from pcbench.measure.directions import Direction
from pcbench.measure.metrics import Distances
from pcbench.measure.reference import Reference
from pcbench.measure.results import CANDIDATE_TO_REFERENCE, REFERENCE_TO_CANDIDATE
from pcbench.measure.scores import measure
from pcbench.measure.summaries import summarize

Floats = NDArray[np.float64]
NOISES = ("none", "white", "L/40", "L/20", "L/10", "clusters")
SCORES = (
    ("d1_mse", CANDIDATE_TO_REFERENCE),
    ("d1_mse", REFERENCE_TO_CANDIDATE),
    ("d2_mse", CANDIDATE_TO_REFERENCE),
    ("mean_distance", CANDIDATE_TO_REFERENCE),
    ("precision", CANDIDATE_TO_REFERENCE),
)


class Case(NamedTuple):
    surface: str
    noise: str
    reference: int = 4_000
    candidate: int = 4_000


def noise(kind: str, points: Floats, spacing: float, rng: np.random.Generator) -> Floats:
    """Return displacements (N,); correlated ones are 1.5 spacings, with half as much white noise."""
    white = 1.5 * spacing * rng.normal(size=len(points))
    if kind == "none":
        return np.zeros(len(points))
    if kind == "white":
        return white
    displacements = 0.5 * white
    if kind == "clusters":  # a random number of hills and hollows of L/30
        for center in points[rng.choice(len(points), rng.poisson(25))]:
            squared = ((points - center) ** 2).sum(axis=1)
            displacements += 4.5 * spacing * rng.normal() * np.exp(-squared / (2 / 30**2))
        return displacements
    length = 1 / float(kind.removeprefix("L/"))
    waves, phases = rng.normal(size=(3, 300)) / length, rng.uniform(0, 2 * np.pi, 300)
    return displacements + 1.5 * spacing * np.sqrt(2 / 300) * np.cos(points @ waves + phases).sum(axis=1)


class Draw(NamedTuple):
    """Values of SCORES, and the ends of their intervals."""

    values: Floats
    low: Floats
    high: Floats


def draw(case: Case, run: int) -> tuple[Draw, tuple[Notice, ...]]:
    """Return one draw, and the warnings on its intervals."""
    rng = np.random.default_rng([run, 77])
    reference, _ = surface(case.surface).sample(case.reference, rng)
    candidate, directions = surface(case.surface).sample(case.candidate, rng)
    spacing = case.reference**-0.5
    candidate = candidate + noise(case.noise, candidate, spacing, rng)[:, None] * directions
    prepared = Reference.prepare(Cloud(reference), Settings())
    index, normals = Index(candidate - prepared.origin), prepared.surface.compute_normals(None)
    candidate_matches, reference_matches = match_both_directions(prepared.index, index)
    both_directions = []
    for queries, matches, targets, reference_rows in (
        (index.points, candidate_matches, prepared.points, candidate_matches.indices),
        (prepared.points, reference_matches, index.points, np.arange(len(reference))),
    ):
        planes = ((queries - targets[matches.indices]) * normals[reference_rows]).sum(axis=1)
        no_floors = dict.fromkeys(("d1_mse", "d2_mse", "mean_distance"))
        both_directions.append(
            Direction(queries, Distances(matches.distances, planes), no_floors, prepared.cells.of_point[reference_rows])
        )
    thresholds, nowhere = (1.5 * spacing,), np.zeros(3)
    forth, back = (
        summarize(direction, thresholds, cells=prepared.cells, voxel=0.1, corner=nowhere, origin=nowhere)
        for direction in both_directions
    )
    scores = measure(forth, back, thresholds, cells=prepared.cells)
    estimates = [scores.metrics.directed[metric][direction] for metric, direction in SCORES[:-1]]
    estimates.append(scores.metrics.fscores[0].precision)
    rows = [(e.value, e.interval.low, e.interval.high) for e in estimates if e.interval is not None]
    return Draw(*np.array(rows, float).T), scores.warnings


class Coverage(NamedTuple):
    """Coverage and relative width of the intervals of each of SCORES.

    Coverage is the share of intervals that contain the mean of all draws. The width is the mean width over that of the
    interval that contains 95 % of the scores.
    """

    shares: Floats
    widths: Floats


def coverage(case: Case, runs: int) -> Coverage:
    draws = [draw(case, run)[0] for run in range(runs)]
    values, low, high = (np.array(rows) for rows in zip(*draws, strict=True))
    truth = values.mean(axis=0)
    tolerance = 1e-12 * np.abs(truth)
    is_covered = (low <= truth + tolerance) & (truth - tolerance <= high)
    expected_widths = 2 * 1.96 * values.std(axis=0, ddof=1)
    return Coverage(is_covered.mean(axis=0), (high - low).mean(axis=0) / np.maximum(expected_widths, 1e-300))
