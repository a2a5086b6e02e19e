"""The worst places of a comparison: where candidates are farthest off, and where they miss parts of the reference."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from pcbench.geometry.arrays import FloatArray
from pcbench.measure.results import CANDIDATE_TO_REFERENCE, REFERENCE_TO_CANDIDATE
from pcbench.report.inputs import FinishedComparison
from pcbench.report.words import length, rounding_limit

_PER_CANDIDATE = 3  # places per candidate and direction
_MAX_PLACES = 24
_FARTHEST = 5000  # points in which places are searched
_RADIUS_SHARE = 0.04  # of the scene's extent: points nearer to a place belong to it


@dataclass(frozen=True)
class Place:
    """A place: what is found there, its position, and a length to frame it by.

    Attributes:
        candidate: name of the candidate.
        what: what is found there.
        distance: the distance, in the reference's unit.
        size: the distance in words, with its unit.
        at: position.
        layer: name of the layer that shows it; empty for the reference.
        of: name of the candidate by whose distance the reference is coloured.
        radius: size of the surroundings to show.
    """

    candidate: str
    what: str
    distance: float
    size: str
    at: tuple[float, float, float]
    layer: str
    of: str
    radius: float


def worst_places(comparison: FinishedComparison) -> list[Place]:
    """Return the places with the largest distances, both directions of each candidate, and the largest local change."""
    places = list(_places(comparison, max(1, min(_PER_CANDIDATE, _MAX_PLACES // (2 * len(comparison))))))
    largest = sorted(range(len(places)), key=lambda k: -places[k].distance)[:_MAX_PLACES]
    return [places[k] for k in sorted(largest)]


def _places(comparison: FinishedComparison, count: int) -> Iterator[Place]:
    unit, radius = comparison.reference.unit, _RADIUS_SHARE * comparison.reference.extent
    least = rounding_limit(comparison)
    for candidate in comparison:
        name = candidate.name
        sides = (
            (candidate.deviation, CANDIDATE_TO_REFERENCE, "off the reference", (name, "")),
            (candidate.completeness, REFERENCE_TO_CANDIDATE, "missing in the candidate", ("", name)),
        )
        for map_, way, what, layer in sides:
            extremes = candidate.metrics.hausdorff[way]
            limit = extremes.largest if candidate.censored.get(way) else math.inf
            points, distances = map_.points, map_.scalars["distance"]
            if map_.sampled_from is not None:  # a sample hardly ever contains the farthest point
                points = np.concatenate([extremes.worst_point[None], points])
                distances = np.concatenate([[extremes.largest], distances])
            for row in _peaks(points, distances, radius, count, least):
                distance = float(distances[row])
                size = f"{'≥ ' if distance >= limit else ''}{length(distance, unit)}"
                yield Place(name, what, distance, size, _tuple(points[row]), *layer, radius)
        local = candidate.deformation.local
        if local is not None and local.largest is not None and local.at is not None:
            size = length(local.largest, unit)
            yield Place(name, "local change", local.largest, size, local.at, name, "", radius)


def _peaks(points: FloatArray, distances: FloatArray, radius: float, count: int, least: float) -> list[int]:
    """Return the rows of the farthest points that are at least `radius` from each other."""
    farthest = np.arange(len(distances))
    if len(distances) > _FARTHEST:
        farthest = np.argpartition(distances, -_FARTHEST)[-_FARTHEST:]
    farthest = farthest[np.argsort(-distances[farthest], kind="stable")]
    farthest = farthest[distances[farthest] > least]
    peaks: list[int] = []
    while len(farthest) and len(peaks) < count:
        peaks.append(int(farthest[0]))
        farthest = farthest[np.linalg.norm(points[farthest] - points[farthest[0]], axis=1) > radius]
    return peaks


def _tuple(point: FloatArray) -> tuple[float, float, float]:
    x, y, z = point.tolist()
    return x, y, z
