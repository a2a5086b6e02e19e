"""Known changes of one of two clouds, and what an answer says about them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from change_scenes import Points, Sample, extent
from numpy.typing import NDArray
from scipy import sparse
from scipy.spatial import cKDTree

from pcbench.changes.result import ADDED, MOVED, REMOVED

SIZES = (0.01, 0.02, 0.05, 0.1, 0.3)  # diameter over the extent of the scene
HEIGHTS = (3, 5, 10, 30, 100, 300, 1000)  # over the noise
MIN_POINTS = 12  # of each cloud in a place that is to change
MAX_HEIGHT = 1 / 3  # of the extent
_FLAT = 0.1  # largest RMS distance from the plane of a flat place, over its radius
_TRIES = 40  # places
_MAX_BOX_HEIGHT = 1 / 16  # of its side, up to which the walls hardly lower the mean distance
_REACH = 3  # spacings around the true change that count as its place
_MIN_SHARE = 0.2  # of the points of a found change in the place of the true one
_OBJECT_GAP = 4  # spacings between objects
MAX_SIZE_ERROR = 0.25


class Truth(NamedTuple):
    """A pair with one change.

    Args:
        reference, candidate: (N, 3) and (M, 3) points.
        kinds: kinds that are right.
        size: length of its offset or motion; None if it has none.
        points: (K, 3) positions of everything that changed, before and after.
    """

    reference: Points
    candidate: Points
    kinds: frozenset[str]
    size: float | None
    points: Points


class Found(NamedTuple):
    """A change of an answer.

    Args:
        kind: its kind.
        size: mean distance or length of its motion; None if the answer has neither.
        area: its area.
        points: (K, 3) points of both clouds that belong to it.
    """

    kind: str
    size: float | None
    area: float
    points: Points


class Judgement(NamedTuple):
    """Judgement of an answer about a true change.

    Args:
        reported: whether a change at its place is reported.
        kind_right: whether the largest of these has the right kind.
        size_right: whether its size is right; None if there is no true one.
        recall: share of the points that changed that belong to a reported change.
        volume: sum over these changes of area times size; None if one has no size.
        false: number of changes elsewhere.
    """

    reported: bool
    kind_right: bool
    size_right: bool | None
    recall: float
    volume: float | None
    false: int


class Part(NamedTuple):
    """A place that is to change: rows of its points in both clouds, and its frame.

    Args:
        of_reference, of_candidate: rows.
        centre: (3,) centre.
        axes: (3, 3) rows are two directions along the surface and its normal.
        radius: half of its diameter.
        is_flat: whether the surface is flat there.
    """

    of_reference: NDArray[np.intp]
    of_candidate: NDArray[np.intp]
    centre: Points
    axes: Points
    radius: float
    is_flat: bool


Change = Callable[[Sample, Part, float, np.random.Generator], Truth]


# ---- places ----


def patch(sample: Sample, share: float, rng: np.random.Generator) -> Part | None:
    """Return a random ball of the surface with this diameter over the extent, a flat one if there is any."""
    radius = share * extent(sample.reference) / 2
    trees = cKDTree(sample.reference), cKDTree(sample.candidate)
    best: Part | None = None
    for row in rng.permutation(len(sample.candidate))[:_TRIES]:
        centre = sample.candidate[row]
        rows = [np.array(tree.query_ball_point(centre, radius), dtype=np.intp) for tree in trees]
        if min(map(len, rows)) < MIN_POINTS:
            continue
        points = np.concatenate([sample.reference[rows[0]], sample.candidate[rows[1]]])
        centred = points - points.mean(axis=0)
        values, vectors = np.linalg.eigh(centred.T @ centred / len(points))
        axes = vectors.T[::-1].copy()
        axes[2] *= 1.0 if axes[2, 2] >= 0 else -1.0
        part = Part(*rows, centre, axes, radius, bool(values[0] < (_FLAT * radius) ** 2))
        # Of a whole patch, not of a sliver at an edge or of a single scan line.
        if part.is_flat and values[1] > 0.15 * radius**2:
            return part
        best = best or part
    return best


def objects(sample: Sample) -> list[Part]:
    """Return the objects that stand apart on the ground of an upright scene."""
    clouds = (sample.reference, sample.candidate)
    points = np.concatenate(clouds)
    size = extent(sample.reference)
    cell = 0.02 * size
    _, cells = np.unique(np.floor(points[:, :2] / cell).astype(int), axis=0, return_inverse=True)
    cells = cells.ravel()
    ground = np.full(cells.max() + 1, np.inf)
    np.minimum.at(ground, cells, points[:, 2])
    above = np.flatnonzero(points[:, 2] - ground[cells] > max(10 * sample.noise, 0.2 * cell))
    if len(above) < MIN_POINTS:
        return []
    tree = cKDTree(points[above])
    gap = _OBJECT_GAP * float(np.median(tree.query(points[above], 2)[0][:, 1]))
    links = tree.query_pairs(gap, output_type="ndarray")
    graph = sparse.coo_matrix((np.ones(len(links)), links.T), (len(above), len(above)))
    _, labels = sparse.csgraph.connected_components(graph, directed=False)
    found = []
    for label in np.flatnonzero(np.bincount(labels) >= 2 * MIN_POINTS):
        rows = above[labels == label]
        first, second = rows[rows < len(clouds[0])], rows[rows >= len(clouds[0])] - len(clouds[0])
        radius = float(np.ptp(points[rows, :2], axis=0).max()) / 2
        if min(len(first), len(second)) >= MIN_POINTS and radius < 0.2 * size:
            found.append(Part(first, second, points[rows].mean(axis=0), np.eye(3), radius, is_flat=False))
    return found


# ---- changes ----


def raised_disc(sample: Sample, part: Part, height: float, _: np.random.Generator) -> Truth:
    """Raise a disc along its normal."""
    candidate = sample.candidate.copy()
    candidate[part.of_candidate] += height * part.axes[2]
    changed = [sample.reference[part.of_reference], candidate[part.of_candidate]]
    size = height if part.is_flat else None
    return Truth(sample.reference, candidate, frozenset({MOVED}), size, np.concatenate(changed))


def box(sample: Sample, part: Part, height: float, rng: np.random.Generator) -> Truth:
    """Put a square box on the surface; it hides what is below it."""
    side = np.sqrt(2) * part.radius
    at = (sample.candidate[part.of_candidate] - part.centre) @ part.axes.T
    rows = part.of_candidate[(np.abs(at[:, :2]) < side / 2).all(axis=1)]
    top = sample.candidate[rows] + height * part.axes[2]
    density = len(rows) / side**2
    walls = rng.uniform(-0.5, 0.5, (int(4 * side * height * density), 3)) * [side, side, height]
    walls[:, 2] += height / 2
    edge = rng.integers(4, size=len(walls))
    walls[np.arange(len(walls)), edge // 2] = side * (edge % 2 - 0.5)
    added = part.centre + walls @ part.axes + rng.normal(0, sample.noise, walls.shape)
    keep = np.ones(len(sample.candidate), bool)
    keep[rows] = False
    old = (sample.reference[part.of_reference] - part.centre) @ part.axes.T
    below = sample.reference[part.of_reference[(np.abs(old[:, :2]) < side / 2).all(axis=1)]]
    candidate = np.concatenate([sample.candidate[keep], top, added])
    size = height if part.is_flat and height < _MAX_BOX_HEIGHT * side else None
    return Truth(sample.reference, candidate, frozenset({MOVED, ADDED}), size, np.concatenate([below, top, added]))


def wall(sample: Sample, part: Part, height: float, rng: np.random.Generator) -> Truth:
    """Add a sheet that stands on the surface, as long as the part, with the density of its points."""
    density = len(part.of_candidate) / (np.pi * part.radius**2)
    length = 2 * part.radius
    sheet = rng.uniform(-0.5, 0.5, (int(density * length * height), 3)) * [length, 0, height]
    sheet[:, 2] += height / 2
    added = part.centre + sheet @ part.axes + rng.normal(0, sample.noise, sheet.shape)
    candidate = np.concatenate([sample.candidate, added])
    return Truth(sample.reference, candidate, frozenset({ADDED}), None, added)


def removed_object(sample: Sample, part: Part, _: float, __: np.random.Generator) -> Truth:
    candidate = np.delete(sample.candidate, part.of_candidate, axis=0)
    return Truth(sample.reference, candidate, frozenset({REMOVED}), None, sample.reference[part.of_reference])


def added_object(sample: Sample, part: Part, _: float, __: np.random.Generator) -> Truth:
    reference = np.delete(sample.reference, part.of_reference, axis=0)
    return Truth(reference, sample.candidate, frozenset({ADDED}), None, sample.candidate[part.of_candidate])


def moved_object(sample: Sample, part: Part, height: float, rng: np.random.Generator) -> Truth:
    """Move an object sideways; the kind of one that moved by more than its size may be both added and removed."""
    angle = rng.uniform(0, 2 * np.pi)
    candidate = sample.candidate.copy()
    candidate[part.of_candidate] += height * np.array([np.cos(angle), np.sin(angle), 0.0])
    changed = [sample.reference[part.of_reference], candidate[part.of_candidate]]
    return Truth(sample.reference, candidate, frozenset({MOVED}), height, np.concatenate(changed))


SURFACE_CHANGES: dict[str, Change] = {"raised disc": raised_disc, "box": box, "wall": wall}
OBJECT_CHANGES: dict[str, Change] = {
    "removed object": removed_object,
    "added object": added_object,
    "moved object": moved_object,
}
WITHOUT_HEIGHT = ("removed object", "added object")


class Case(NamedTuple):
    """A change of a scene; `height` is over the noise, 0 for changes without height."""

    change: str
    share: float
    height: float
    truth: Truth


def ladder(
    sample: Sample, name: str, share: float, seed: int, standing: list[Part], heights: tuple[float, ...] = HEIGHTS
) -> Iterator[Case]:
    """Yield a change of one place at all heights that the scene shows.

    Args:
        sample: the scene.
        name: change, of `SURFACE_CHANGES` or `OBJECT_CHANGES`.
        share: diameter over the extent; of objects, a size between half and twice of it.
        seed: seed of the place.
        standing: `objects` of the sample.
        heights: heights over the noise.
    """
    rng = np.random.default_rng([seed, *name.encode(), int(1000 * share)])
    size = extent(sample.reference)
    part: Part | None
    if name in SURFACE_CHANGES:
        change, part = SURFACE_CHANGES[name], patch(sample, share, rng)
    else:
        change = OBJECT_CHANGES[name]
        fitting = [part for part in standing if share / np.sqrt(2) < 2 * part.radius / size < share * np.sqrt(2)]
        part = fitting[rng.integers(len(fitting))] if fitting else None
    if part is None:
        return
    for height in (0,) if name in WITHOUT_HEIGHT else heights:
        if height * sample.noise > MAX_HEIGHT * size:
            return
        truth = change(sample, part, height * sample.noise, np.random.default_rng([seed, 25]))
        if len(truth.points) >= MIN_POINTS:
            yield Case(name, share, height, truth)


# ---- judgement ----


def judge(truth: Truth, answer: list[Found]) -> Judgement:
    """Compare an answer with the truth, by place."""
    true_tree = cKDTree(truth.points)
    spacing = float(np.median(cKDTree(truth.reference).query(truth.reference[::7], 2)[0][:, 1]))
    reach = _REACH * max(spacing, float(np.median(true_tree.query(truth.points, 2)[0][:, 1])))
    there, false = [], 0
    for found in answer:
        share = float(np.mean(true_tree.query(found.points)[0] <= reach)) if len(found.points) else 0.0
        if share >= _MIN_SHARE:
            there.append(found)
        else:
            false += 1
    if not there:
        return Judgement(False, False, None if truth.size is None else False, 0.0, 0.0, false)
    largest = max(there, key=lambda found: len(found.points))
    size_right = None
    if truth.size is not None:
        size_right = largest.size is not None and abs(abs(largest.size) / truth.size - 1) <= MAX_SIZE_ERROR
    labelled = cKDTree(np.concatenate([found.points for found in there]))
    recall = float(np.mean(labelled.query(truth.points)[0] <= 1e-9))
    sizes = [found.size for found in there]
    volume = None
    if all(size is not None for size in sizes):
        volume = sum(found.area * abs(found.size or 0.0) for found in there)
    return Judgement(True, largest.kind in truth.kinds, size_right, recall, volume, false)
