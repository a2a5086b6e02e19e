"""Ladders of changed parts and objects, and of a part without errors beside a deformation.

Objects are boxes on a level part of the scene, half as high as wide.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcbench.changes.result import ADDED, MOVED, REMOVED
from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.neighbors import Index
from pcbench.geometry.sampling import median_spacing
from pcbench.studies.stress.changes import CHANGES
from pcbench.studies.stress.ladders.ladder import Ladder, Perturbation
from pcbench.studies.stress.ladders.warps import WARP_LADDERS
from pcbench.studies.stress.scenes import StressPair, TrueChange
from pcbench.studies.stress.verdicts import VERDICTS

_PART_SHARE = 0.1  # diameter of a raised part, and side of an object that moves, over the extent
_LEVEL = 0.7  # vertical component of the normal from which a surface counts as level
_PLACES = 30  # places of which the one with the most points is chosen
_DOME = 4.0  # size of the dome beside a part without errors, in noises
_DOME_LADDER = next(ladder for ladder in WARP_LADDERS if ladder.name == "warp-dome")


class _Box(NamedTuple):
    """A box whose bottom has its centre at a place (3,); its height is half its side."""

    place: FloatArray
    side: float

    def contains(self, points: FloatArray) -> NDArray[np.bool_]:
        """Return which points (N, 3) lie inside, or below its bottom: it hides them."""
        x, y, z = np.abs(points - self.place).T
        inside: NDArray[np.bool_] = np.maximum(np.maximum(x, y), z) < self.side / 2
        return inside

    def sample(self, spacing: float, noise: float, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
        """Return points (N, 3) of its top and its walls at a median spacing, with noise, and their normals."""
        density = np.log(2) / (np.pi * spacing**2)  # of random points with this median distance to the nearest one
        face = rng.integers(6, size=int(3 * self.side**2 * density))  # 0 and 1: the top; the walls have half of it
        corners = rng.uniform(-0.5, 0.5, (len(face), 3)) * [self.side, self.side, self.side / 2]
        normals = np.zeros_like(corners)
        is_top, axis, sign = face < 2, face % 2, np.where(face < 4, 1.0, -1.0)
        wall = np.flatnonzero(~is_top)
        corners[is_top, 2], normals[is_top, 2] = self.side / 4, 1.0
        corners[wall, axis[wall]], normals[wall, axis[wall]] = sign[wall] * self.side / 2, sign[wall]
        points = self.place + [0.0, 0.0, self.side / 4] + corners + rng.normal(0, noise, corners.shape)
        return points, normals


def _raised(pair: StressPair, level: float, rng: np.random.Generator) -> StressPair:
    """Raise a round level part of the candidate."""
    place = _level_place(pair, rng)
    if level == 0:
        return pair
    size = level * float(np.hypot(pair.noise, pair.candidate_noise))
    before, rows = (
        np.linalg.norm(points - place, axis=1) < _PART_SHARE * pair.extent / 2
        for points in (pair.reference, pair.points)
    )
    points = pair.points.copy()
    points[rows, 2] += size
    changed = np.concatenate([pair.reference[before], points[rows]])
    return replace(pair.with_points(points), change=TrueChange((MOVED,), changed, size))


def _with_added(pair: StressPair, level: float, rng: np.random.Generator) -> StressPair:
    """Put an object into the candidate."""
    place = _level_place(pair, rng)
    if level == 0:
        return pair
    changed, points = _with_box(pair, _Box(place, level / 100 * pair.extent), rng)
    return replace(changed, change=TrueChange((ADDED,), points))


def _with_removed(pair: StressPair, level: float, rng: np.random.Generator) -> StressPair:
    """Put an object into the reference."""
    place = _level_place(pair, rng)
    if level == 0:
        return pair
    reference, points = _reference_with_box(pair, _Box(place, level / 100 * pair.extent), rng)
    return replace(pair, reference=reference, change=TrueChange((REMOVED,), points))


def _with_moved(pair: StressPair, level: float, rng: np.random.Generator) -> StressPair:
    """Put an object into both clouds, and move that of the candidate sideways."""
    place, angle = _level_place(pair, rng), rng.uniform(0, 2 * np.pi)
    if level == 0:
        return pair
    side = _PART_SHARE * pair.extent
    step = level / 100 * side * np.array([np.cos(angle), np.sin(angle), 0.0])
    reference, before = _reference_with_box(pair, _Box(place, side), rng)
    changed, after = _with_box(pair, _Box(place + step, side), rng)
    kinds = (MOVED,) if level < 100 else (MOVED, ADDED, REMOVED)  # one object beside the other may be two changes
    change = TrueChange(kinds, np.concatenate([before, after]), float(np.linalg.norm(step)))
    return replace(changed, reference=reference, change=change)


def _partly_exact(pair: StressPair, level: float, rng: np.random.Generator) -> StressPair:
    """Bend the candidate to a dome, and add vertical planes without noise until this share of both clouds is exact."""
    if level == 0:
        return pair
    bent = _DOME_LADDER.perturb(pair, _DOME, rng)
    share = level / 100
    low, high = np.percentile(pair.reference, [1, 99], axis=0)

    def planes(count: int) -> FloatArray:
        points = rng.uniform(low, [*high[:2], low[2] + 0.1 * pair.extent], (count, 3))
        points[::2, 0], points[1::2, 1] = (low + high)[:2] / 2
        return points

    first, second = (planes(round(share / (1 - share) * len(points))) for points in (pair.reference, pair.points))
    normals = np.tile(np.eye(3)[:2], (len(second) // 2 + 1, 1))[: len(second)]
    return replace(
        bent.with_points(np.concatenate([bent.points, second]), np.concatenate([bent.normals, normals])),
        reference=np.concatenate([pair.reference, first]),
        true_rms=bent.true_rms * float(np.sqrt(1 - share)),
    )


def _level_place(pair: StressPair, rng: np.random.Generator) -> FloatArray:
    """Return a point of the candidate on a level surface: of several, the one with the most points around it."""
    rows = np.flatnonzero(pair.normals[:, 2] > _LEVEL)
    places = (
        pair.points[rng.choice(rows, _PLACES)] if len(rows) else pair.points[rng.integers(len(pair.points), size=1)]
    )
    index, radius = Index(pair.points), _PART_SHARE * pair.extent / 2
    counts = [int((np.linalg.norm(index.points - place, axis=1) < radius).sum()) for place in places]
    place: FloatArray = places[int(np.argmax(counts))]
    return place


def _with_box(pair: StressPair, box: _Box, rng: np.random.Generator) -> tuple[StressPair, FloatArray]:
    """Return the pair with a box in the candidate, and the points of the box."""
    keep = ~box.contains(pair.points)
    points, normals = box.sample(median_spacing(Index(pair.points)), pair.candidate_noise, rng)
    both = np.concatenate([pair.points[keep], points]), np.concatenate([pair.normals[keep], normals])
    return pair.with_points(*both), points


def _reference_with_box(pair: StressPair, box: _Box, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """Return the reference with a box, and the points of the box."""
    points, _ = box.sample(pair.spacing, pair.noise, rng)
    return np.concatenate([pair.reference[~box.contains(pair.reference)], points]), points


def _change(
    name: str, unit: str, levels: tuple[float, ...], perturb: Perturbation, quick: tuple[float, ...] = ()
) -> Ladder:
    return Ladder(name, name.replace("-", " "), "changes", unit, levels, quick, perturb, (CHANGES,))


_OBJECT_SIZES, _EXACT_SHARES = (0, 2, 5, 10, 20, 30), (0, 5, 10, 25, 50, 75, 90)

CHANGE_LADDERS = (
    _change("raised-part", "x noise", (0, 3, 5, 10, 30, 100, 300, 1000), _raised, (0, 10, 100)),
    _change("added-object", "% of the extent", _OBJECT_SIZES, _with_added),
    _change("removed-object", "% of the extent", _OBJECT_SIZES, _with_removed),
    _change("moved-object", "% of its side", (0, 5, 10, 25, 50, 100, 200), _with_moved),
    Ladder(
        "exact-part",
        "exact planes beside a dome",
        "changes",
        "% of the points",
        _EXACT_SHARES,
        (),
        _partly_exact,
        (VERDICTS,),
    ),
)
