"""Ladders of what the candidate shows: overlap, missing parts, and the density of its points."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.voxels import robust_bounds
from pcbench.studies.stress.ladders.ladder import Ladder, Perturbation
from pcbench.studies.stress.metrics import METRICS
from pcbench.studies.stress.registration import REGISTRATION
from pcbench.studies.stress.scenes import StressPair
from pcbench.studies.stress.verdicts import VERDICTS

_ALL, _POSED = (REGISTRATION, METRICS, VERDICTS), (REGISTRATION, VERDICTS)
_MIN_POINTS = 200  # a candidate keeps at least these
_STEEP = 0.3  # vertical component of the normal up to which a surface counts as a wall
_LEVEL = 0.7  # vertical component of the normal from which it counts as level


def _overlapping(pair: StressPair, level: float, rng: np.random.Generator) -> StressPair:
    """Cut both clouds by vertical planes so that this share of each lies in the part that both show."""
    if level == 100:
        return pair
    angle = rng.uniform(0, 2 * np.pi)
    across = np.array([np.cos(angle), np.sin(angle), 0.0])
    width = 1 / (2 - level / 100)
    offsets, edges = pair.reference @ across, pair.points @ across
    low, high = np.quantile(offsets, [1 - width, width])
    cut = replace(pair, reference=pair.reference[offsets <= high])
    return cut.select(edges >= low)


def _cut_out(pair: StressPair, level: float, rng: np.random.Generator) -> StressPair:
    """Remove balls of a tenth of the extent until this share of the candidate's points is gone."""
    keep = np.ones(len(pair.points), bool)
    while keep.mean() > 1 - level / 100 and keep.sum() > _MIN_POINTS:
        left = np.flatnonzero(keep)
        centre = pair.points[rng.choice(left)]
        distances = np.square(pair.points[left] - centre).sum(axis=1)
        spare = len(left) - max(_MIN_POINTS, round((1 - level / 100) * len(keep)))
        ball = left[np.argsort(distances)[: max(0, min(spare, int((distances < (0.1 * pair.extent) ** 2).sum())))]]
        if not len(ball):
            break
        keep[ball] = False
    return pair.select(keep)


def _without_walls(pair: StressPair, level: float, rng: np.random.Generator) -> StressPair:
    return _without(pair, np.abs(_upward(pair)) < _STEEP, level, rng)


def _without_roofs(pair: StressPair, level: float, rng: np.random.Generator) -> StressPair:
    """Remove level surfaces of the upper two thirds of the scene."""
    low, high = robust_bounds(pair.points)
    above = pair.points[:, 2] > low[2] + (high[2] - low[2]) / 3
    return _without(pair, above & (np.abs(_upward(pair)) > _LEVEL), level, rng)


def _without_ground(pair: StressPair, level: float, rng: np.random.Generator) -> StressPair:
    """Remove level surfaces of the lower third of the scene."""
    low, high = robust_bounds(pair.points)
    below = pair.points[:, 2] <= low[2] + (high[2] - low[2]) / 3
    return _without(pair, below & (np.abs(_upward(pair)) > _LEVEL), level, rng)


def _without_vegetation(pair: StressPair, level: float, rng: np.random.Generator) -> StressPair:
    """Remove this share of the points on vegetation: whole plants in random order, and the last one in part.

    Leaves fall and trees are felled between two surveys.
    """
    assert pair.plants is not None
    rank = rng.permutation(int(pair.plants.max()) + 1)
    rows = np.flatnonzero(pair.plants >= 0)
    rows = rows[np.argsort(rank[pair.plants[rows]], kind="stable")]
    count = min(round(level / 100 * len(rows)), len(pair.points) - _MIN_POINTS)
    keep = np.ones(len(pair.points), bool)
    keep[rows[: max(0, count)]] = False
    return pair.select(keep)


def _thinned(pair: StressPair, level: float, rng: np.random.Generator) -> StressPair:
    """Keep one of `level` points of the candidate."""
    count = max(_MIN_POINTS, round(len(pair.points) / level))
    return pair.select(np.sort(rng.permutation(len(pair.points))[:count]))


def _falling_density(pair: StressPair, level: float, rng: np.random.Generator) -> StressPair:
    """Let the density fall with the distance from the middle, to this fraction of it at half the extent."""
    distances = np.linalg.norm(pair.points - np.median(pair.points, axis=0), axis=1) / (0.5 * pair.extent)
    keep = rng.random(len(distances)) < np.power(level, -distances)
    if keep.sum() < _MIN_POINTS:
        keep[np.argsort(distances)[:_MIN_POINTS]] = True
    return pair.select(keep)


def _duplicated(pair: StressPair, level: float, rng: np.random.Generator) -> StressPair:
    """Add `level` exact copies of a tenth of the points."""
    chosen = rng.permutation(len(pair.points))[: len(pair.points) // 10]
    rows = np.concatenate([np.arange(len(pair.points)), np.repeat(chosen, int(level))])
    return pair.select(rows)


def _quantised(pair: StressPair, level: float, _: np.random.Generator) -> StressPair:
    """Round the coordinates of the candidate to multiples of a step."""
    if level == 0:
        return pair
    step = level * pair.spacing
    noise = float(np.hypot(pair.candidate_noise, step / np.sqrt(12)))
    return replace(pair.with_points(np.round(pair.points / step) * step), candidate_noise=noise)


def _without(pair: StressPair, part: NDArray[np.bool_], level: float, rng: np.random.Generator) -> StressPair:
    """Remove this share of a part of the candidate, in whole cells of a tenth of the extent."""
    cells = np.floor(pair.points[:, :2] / (0.1 * pair.extent)).astype(np.int64)
    _, number = np.unique(cells, axis=0, return_inverse=True)
    number = number.ravel()
    gone = rng.random(int(number.max()) + 1) < level / 100
    keep = ~(part & gone[number])
    return pair.select(keep) if keep.sum() >= _MIN_POINTS else pair


def _upward(pair: StressPair) -> FloatArray:
    upward: FloatArray = pair.normals[:, 2]
    return upward


def _missing(part: str, them: str, perturb: Perturbation, *, needs_vegetation: bool = False) -> Ladder:
    return Ladder(
        f"missing-{part}",
        f"missing {part}",
        "parts",
        f"% of {them}",
        (0, 25, 50, 75, 100),
        (),
        perturb,
        _POSED,
        needs_vegetation=needs_vegetation,
    )


_OVERLAPS, _SHARES = (100, 80, 60, 40, 30, 20, 10, 5), (0, 10, 25, 50, 75, 90, 97)
_THINNINGS, _FALLS = (1, 2, 4, 8, 16, 32, 64), (1, 3, 10, 30, 100, 1000)
_STEPS = (0, 0.1, 0.25, 0.5, 1, 2, 4)

PART_LADDERS = (
    Ladder("overlap", "overlap", "parts", "%", _OVERLAPS, (100, 40, 20), _overlapping, _POSED),
    Ladder("cutouts", "holes", "parts", "% of the points", _SHARES, (), _cut_out, _ALL),
    _missing("walls", "them", _without_walls),
    _missing("roofs", "them", _without_roofs),
    _missing("ground", "it", _without_ground),
    _missing("vegetation", "it", _without_vegetation, needs_vegetation=True),
    Ladder("density", "thinning of the candidate", "density", "to 1", _THINNINGS, (1, 16), _thinned, _ALL),
    Ladder("falling-density", "fall of the density to the edge", "density", "to 1", _FALLS, (), _falling_density, _ALL),
    Ladder(
        "duplicates", "copies of a tenth of the points", "density", "copies", (0, 1, 3, 10, 30), (), _duplicated, _ALL
    ),
    Ladder("quantised", "rounding of coordinates", "coordinates", "spacings", _STEPS, (), _quantised, _ALL),
)
