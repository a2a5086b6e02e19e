"""Scores of independent, error-free samples of one surface, and their sampling floors."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from surfaces import surface

from pcbench import Cloud, Settings
from pcbench.geometry.neighbors import Index
from pcbench.geometry.normals import Surface
from pcbench.measure import pair
from pcbench.measure.directions import MEAN_METRICS, Direction, from_candidate, from_reference
from pcbench.measure.pair import align, match_pair
from pcbench.measure.reference import Reference

METRICS = tuple(metric.name for metric in MEAN_METRICS)


class Case(NamedTuple):
    """Numbers of points; how much denser the candidate is at one end of the scene; its noise, in its mean spacings."""

    surface: str
    reference: int
    candidate: int
    falling: float = 1.0
    noise: float = 0.0


class Means(NamedTuple):
    """Means over runs of scores and floors (2, METRICS), candidate → reference and back."""

    scores: np.ndarray
    floors: np.ndarray

    @property
    def ratios(self) -> np.ndarray:
        return self.scores / np.maximum(self.floors, 1e-30)


def measure_directions(reference: np.ndarray, candidate: np.ndarray, settings: Settings) -> tuple[Direction, Direction]:
    """Return both directions, candidate → reference and back, of aligned clouds."""
    prepared = Reference.prepare(Cloud(reference), settings)
    index = Index(candidate - prepared.origin)
    candidate_matches, reference_matches = prepared.index.query(index.points), index.query(prepared.points)
    accuracy = from_candidate(prepared, index.points, candidate_matches, seed=0)
    return accuracy, from_reference(
        prepared,
        Surface(index, is_even=False),
        candidate_matches.indices,
        reference_matches,
        forth=accuracy,
        seed=settings.seed,
    )


def mean_floors(case: Case, runs: int) -> Means:
    scores, floors = np.zeros((2, 2, len(METRICS)))
    for run in range(runs):
        rng = np.random.default_rng([run, case.reference, case.candidate])
        reference, _ = surface(case.surface).sample(case.reference, rng)
        candidate, normals = surface(case.surface).sample(case.candidate, rng, case.falling)
        noise_std = case.noise * len(candidate) ** -0.5
        candidate = candidate + noise_std * rng.normal(size=(len(candidate), 1)) * normals
        for row, direction in enumerate(measure_directions(reference, candidate, Settings(seed=run))):
            for column, metric in enumerate(MEAN_METRICS):
                values, floor = metric.values_of(direction.distances), direction.floors[metric.name]
                assert values is not None
                assert floor is not None
                scores[row, column] += np.mean(values) / runs
                floors[row, column] += floor / runs
    return Means(scores, floors)


def mean_rounded_ratios(name: str, counts: tuple[int, int], steps: tuple[float, float], runs: int) -> np.ndarray:
    """Return the mean ratio of score and floor (2, METRICS) of samples of a surface that are rounded to steps."""
    ratios = np.zeros((2, len(METRICS)))
    for run in range(runs):
        rng = np.random.default_rng([run, *counts])
        clouds = []
        for count, step in zip(counts, steps, strict=True):
            points, _ = surface(name).sample(count, rng)
            clouds.append(np.round(points / step) * step if step else points)
        settings = Settings(register="none", seed=run)
        prepared = Reference.prepare(Cloud(clouds[0]), settings)
        aligned = align(prepared, "candidate", Cloud(clouds[1]), settings)
        both = pair.measure_directions(prepared, aligned, match_pair(prepared, aligned), run)
        for row, direction in enumerate(both):
            for column, metric in enumerate(MEAN_METRICS):
                ratios[row, column] += (
                    np.mean(metric.values_of(direction.distances)) / direction.floors[metric.name] / runs
                )
    return ratios
