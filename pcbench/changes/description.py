"""Kind, place and size of a part that differs between two clouds."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from pcbench.changes.parts import ChangedPart, PointTests
from pcbench.changes.result import ADDED, MOVED, REMOVED, Change
from pcbench.changes.samples import Sample
from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.neighbors import Index
from pcbench.geometry.voxels import cells

_MAX_SIZE_RATIO = 2.0  # of the areas of a part before and after it moved
# Distance of a moved part from its former or new place, in voxels, for most of its points.
_MAX_MISFIT, _FITTING_PERCENT, _COMMON_PERCENT = 1.5, 80, 60
_REFINEMENTS = 3  # of a motion by closest points
_MAX_COMPARED_PAIRS = 50  # of removed and added parts: among more, some have the same shape by chance
_MAX_MOTION = 5.0  # in diameters: farther apart, an object that came cannot be told from the one that went
_SURROUNDINGS = 2.0  # radius of a part's surroundings, in radii of the part
_CELL = 3.0  # side of the cells of a footprint, in voxels
_MIN_COVERED_SHARE = 0.5
_MIN_FOOTPRINT_SHARE = 0.4  # of the occupied cells: those of narrow parts lie along the outline
_MIN_FACING = 0.8  # of the distance to the nearest point, along the normal: it lies straight below or above
_PEAK_SHARE = 0.999
_DIRECTIONS = 16  # in which the farthest points are corners of a polygon, whose inner points are no part of the outline
_ROUNDING = 1e-12  # of an area, beyond which a point lies inside
_MIN_RELIEF = 4.0  # height of an object above its surroundings, in voxels


class Shown(NamedTuple):
    """Points of a part that one cloud shows.

    Attributes:
        points: (N, 3) sampled points.
        areas: (N,) area that each represents.
        signed: (N,) candidate minus reference along the reference's normals.
    """

    points: FloatArray
    areas: FloatArray
    signed: FloatArray

    def __len__(self) -> int:
        return len(self.points)

    @property
    def area(self) -> float:
        """Area of the surface."""
        return float(self.areas.sum())

    @property
    def center(self) -> FloatArray:
        """Mean point (3,)."""
        center: FloatArray = np.average(self.points, axis=0, weights=self.areas)
        return center

    @property
    def diameter(self) -> float:
        """Twice the largest distance of a point from the centre."""
        return 2 * float(np.linalg.norm(self.points - self.center, axis=1).max())


class SampledPair(NamedTuple):
    """Samples of the reference and the candidate, their tests, and the reference's normals at their points.

    Attributes:
        samples, evidence, normals: of the reference and the candidate.
        points: number of points among which the most significant ones are sought.
        shows_whole: whether the samples show the whole scene. In small places, gaps and objects look alike.
    """

    samples: Sequence[Sample]
    evidence: Sequence[PointTests]
    normals: Sequence[FloatArray]
    points: int
    shows_whole: bool = True

    @property
    def side(self) -> float:
        """Side of the voxels of both samples."""
        return self.samples[0].side

    def shown(self, part: ChangedPart) -> tuple[Shown, Shown]:
        """Return the points of a part in the reference and in the candidate."""
        ours, theirs = (
            Shown(sample.points[rows], sample.areas[rows], tests.signed[rows])
            for sample, rows, tests in zip(self.samples, part, self.evidence, strict=True)
        )
        return ours, theirs

    def normal(self, part: ChangedPart) -> FloatArray:
        """Return the mean normal (3,) of the reference at a part; upwards if there is none."""
        total: FloatArray = np.sum([n[rows].sum(axis=0) for n, rows in zip(self.normals, part, strict=True)], axis=0)
        length = float(np.linalg.norm(total))
        return total / length if length > 0 else np.array([0.0, 0.0, 1.0])

    def p_value(self, part: ChangedPart) -> float:
        """Return the probability that sampling and noise produce points as significant as these anywhere."""
        least = min(tests.p_value(rows) for tests, rows in zip(self.evidence, part, strict=True))
        return min(1.0, least * self.points)


def describe(parts: Sequence[ChangedPart], scene: SampledPair) -> list[tuple[ChangedPart, Change | None]]:
    """Return the change that each part shows; None if one cloud does not cover the place or hides it.

    A removed and an added part of the same shape become one part, which moved.
    """
    described: list[tuple[ChangedPart, Change | None]] = []
    unmoved = []
    for part in parts:
        ours, theirs = scene.shown(part)
        motion = None
        if min(len(ours), len(theirs)) > 0:
            motion = _motion(ours, theirs, scene, scene.normal(part))
        if motion is None:
            unmoved.append(part)
        else:
            described.append((part, _moved(ours, theirs, motion, scene.normal(part), scene, part)))
    removed = [part for part in unmoved if _is_removed(part, scene)]
    added = [part for part in unmoved if not _is_removed(part, scene)]
    up = np.array([0.0, 0.0, 1.0])
    for i, j, motion in _same_shapes(removed, added, scene):
        whole = ChangedPart(removed[i].reference, added[j].candidate)
        ours, theirs = scene.shown(whole)
        described.append((whole, _moved(ours, theirs, motion, up, scene, whole)))
        unmoved = [part for part in unmoved if part is not removed[i] and part is not added[j]]
    for part in unmoved:
        which = 0 if _is_removed(part, scene) else 1
        shown, direction = scene.shown(part)[which], _upward(part, scene)
        is_visible = _is_visible(shown, scene.samples[1 - which], direction, scene)
        described.append((part, _grown(part, which, direction, scene) if is_visible else None))
    return described


def _is_removed(part: ChangedPart, scene: SampledPair) -> bool:
    ours, theirs = scene.shown(part)
    return ours.area > theirs.area


def _motion(ours: Shown, theirs: Shown, scene: SampledPair, normal: FloatArray) -> FloatArray | None:
    """Return the displacement (3,) that carries a part of the reference onto that of the candidate, if there is one.

    Each part, displaced, has to lie on the other cloud: its former or its new place.
    """
    along = float(np.median(theirs.signed)) * normal
    return _best_motion(ours, theirs, scene, [theirs.center - ours.center, along])


def _best_motion(ours: Shown, theirs: Shown, scene: SampledPair, starts: Sequence[FloatArray]) -> FloatArray | None:
    """Return the motion (3,) with the smallest misfit, refined from several starts; None if none fits."""
    best, least = None, _MAX_MISFIT * scene.side
    for start in starts:
        motion = start
        for _ in range(_REFINEMENTS):
            back = scene.samples[0].index.query(theirs.points - motion)
            residuals = theirs.points - motion - scene.samples[0].points[back.indices]
            near = back.distances <= 3 * _MAX_MISFIT * scene.side
            if not near.any():
                break
            motion = motion + residuals[near].mean(axis=0)
        misfit = max(
            _upper_misfit(scene.samples[0].index, theirs.points - motion),
            _upper_misfit(scene.samples[1].index, ours.points + motion),
        )
        if misfit <= least:
            best, least = motion, misfit
    return best


def _upper_misfit(index: Index, points: FloatArray) -> float:
    return float(np.percentile(index.query(points).distances, _FITTING_PERCENT))


def _same_shapes(
    removed: Sequence[ChangedPart], added: Sequence[ChangedPart], scene: SampledPair
) -> list[tuple[int, int, FloatArray]]:
    """Return pairs of a removed and an added part of the same shape, with the motion; the nearest ones first."""
    pairs = []
    if len(removed) * len(added) > _MAX_COMPARED_PAIRS:
        return []
    before = [scene.shown(part)[0] for part in removed]
    after = [scene.shown(part)[1] for part in added]
    for i, ours in enumerate(before):
        for j, theirs in enumerate(after):
            if not 1 / _MAX_SIZE_RATIO <= ours.area / theirs.area <= _MAX_SIZE_RATIO:
                continue
            distance = float(np.linalg.norm(theirs.center - ours.center))
            if distance > _MAX_MOTION * max(ours.diameter, theirs.diameter):
                continue
            motion = _shortest_motion(ours, theirs, scene)
            if motion is not None and _have_same_shape(ours, theirs, scene.side):
                pairs.append((float(np.linalg.norm(motion)), i, j, motion))
    equal_pairs: list[tuple[int, int, FloatArray]] = []
    for _, i, j, motion in sorted(pairs, key=lambda pair: pair[:3]):
        if all(i != a and j != b for a, b, _ in equal_pairs):
            equal_pairs.append((i, j, motion))
    return equal_pairs


def _shortest_motion(ours: Shown, theirs: Shown, scene: SampledPair) -> FloatArray | None:
    """Return the shortest motion (3,) that fits.

    Of an object that moved by less than its size, only the ends differ, and they lie farther apart than it moved.
    """
    for share in (0.25, 0.5, 0.75, 1.0):
        motion = _best_motion(ours, theirs, scene, [share * (theirs.center - ours.center)])
        if motion is not None and np.linalg.norm(motion) > scene.side:
            return motion
    return None


def _have_same_shape(ours: Shown, theirs: Shown, side: float) -> bool:
    """Return whether each of two parts, moved to the same centre, lies on the other, up to missing pieces."""
    motion = theirs.center - ours.center
    return all(
        float(np.percentile(Index(a).query(b).distances, _COMMON_PERCENT)) <= 2 * _MAX_MISFIT * side
        for a, b in ((theirs.points, ours.points + motion), (ours.points, theirs.points - motion))
    )


def _moved(
    ours: Shown, theirs: Shown, motion: FloatArray, normal: FloatArray, scene: SampledPair, part: ChangedPart
) -> Change:
    """Return the change of a part that both clouds show, apart from each other by a motion (3,)."""
    mean = float(motion @ normal)
    sideways = motion - mean * normal
    peak = mean
    if np.linalg.norm(sideways) <= max(scene.side, 0.25 * abs(mean)):  # a surface shows no motion along itself
        motion = mean * normal
        peak = _peak(theirs.signed)
        if abs(peak) < abs(mean):
            peak = mean
    area = 0.5 * (ours.area + theirs.area)
    place = 0.5 * (ours.center + theirs.center)
    return _change(MOVED, place, [ours, theirs], area, area * mean, mean, peak, motion, part, scene)


def _grown(part: ChangedPart, which: int, up: FloatArray, scene: SampledPair) -> Change:
    """Return the change of a part that one cloud shows (0: the reference), by its height above the other cloud."""
    shown, other, step = scene.shown(part)[which], scene.samples[1 - which], _CELL * scene.side
    heights = (1.0 if which else -1.0) * _heights(shown.points, other, up, scene.side)
    faces = np.abs(shown.signed) >= _MIN_FACING * other.index.query(shown.points).distances
    if which and faces.mean() >= _MIN_COVERED_SHARE:  # the nearest surface is straight below, and no other one counts
        heights = shown.signed
    flat = np.column_stack([_in_plane(shown.points, up), np.zeros(len(shown))])
    grid = cells(flat, step)
    largest = np.zeros(len(grid.first))
    np.maximum.at(largest, grid.of_point, np.abs(heights))
    means = grid.means(heights)
    # The top of an object limits its volume, and the mean of a surface's points, which are noisy, is its height.
    columns = np.where(largest > np.abs(means) + step, np.sign(means) * largest, means)
    mean = float(np.average(heights, weights=shown.areas))
    volume = float(columns.mean()) * _footprint(flat, step)
    # Where both clouds show a surface, material was added if the candidate's is higher.
    is_added = mean > 0 if min(len(part.reference), len(part.candidate)) > 0 else which == 1
    kind = ADDED if is_added else REMOVED
    return _change(kind, shown.center, [shown], shown.area, volume, mean, _peak(heights), None, part, scene)


def _footprint(flat: FloatArray, step: float) -> float:
    """Return the area that points (N, 3) in a plane cover.

    Cells along the outline count as a whole, in proportion to their side: twice the side shows how much that adds.
    """
    fine, coarse = (len(cells(flat, side).first) * side**2 for side in (step, 2 * step))
    return max(2 * fine - coarse, _MIN_FOOTPRINT_SHARE * fine)


def _heights(points: FloatArray, other: Sample, up: FloatArray, side: float) -> FloatArray:
    """Return the heights (N,) of points above another cloud: over the point that is nearest across a direction."""
    places, others = _in_plane(points, up), _in_plane(other.points, up)
    lower, upper = places.min(axis=0) - 4 * _CELL * side, places.max(axis=0) + 4 * _CELL * side
    near = np.flatnonzero(((others >= lower) & (others <= upper)).all(axis=1))
    if not len(near):
        return (points - other.points[other.index.query(points).indices]) @ up
    flat = Index(np.column_stack([others[near], np.zeros(len(near))]))
    nearest = flat.query(np.column_stack([places, np.zeros(len(places))])).indices
    heights: FloatArray = (points - other.points[near[nearest]]) @ up
    return heights


def _change(
    kind: str,
    place: FloatArray,
    shown: Sequence[Shown],
    area: float,
    volume: float,
    mean: float,
    peak: float,
    motion: FloatArray | None,
    part: ChangedPart,
    scene: SampledPair,
) -> Change:
    x, y, z = map(float, place)
    outline = convex_outline(np.concatenate([each.points[:, :2] for each in shown]))
    motion_values = None if motion is None else (float(motion[0]), float(motion[1]), float(motion[2]))
    return Change(
        kind,
        (x, y, z),
        outline,
        area,
        volume,
        mean,
        peak,
        motion_values,
        len(part.reference),
        len(part.candidate),
        scene.p_value(part),
    )


def _peak(values: FloatArray) -> float:
    """Return the value that is exceeded in size by a thousandth of the values, and at least by one of several."""
    order = np.argsort(np.abs(values))
    return float(values[order[int(_PEAK_SHARE * (len(values) - 1))]])


def _upward(part: ChangedPart, scene: SampledPair) -> FloatArray:
    """Return the direction (3,) across the surface on which a part stands, upwards or along the reference's normals."""
    sample = scene.samples[0]
    points = np.concatenate([shown.points for shown in scene.shown(part)])
    center = np.median(points, axis=0)
    radius = max(_SURROUNDINGS * float(np.percentile(np.linalg.norm(points - center, axis=1), 90)), 8 * sample.side)
    near = sample.index.query_radius(center[None], radius).indices
    theirs = scene.shown(part)[1]
    is_beside = len(theirs) > 0 and abs(float(np.median(theirs.signed))) > 0.5 * radius  # other surfaces may be nearer
    if len(near) < 3 or is_beside:
        return scene.normal(part)
    around = sample.points[near]
    across = np.linalg.eigh(np.cov(around.T))[1][:, 0]
    sign = float(across @ scene.normals[0][near].sum(axis=0)) or 1.0
    upward: FloatArray = across * np.sign(sign)
    return upward


def _in_plane(points: FloatArray, up: FloatArray) -> FloatArray:
    """Return coordinates (N, 2) of points (N, 3) in the plane across a direction."""
    axis = np.eye(3)[int(np.argmin(np.abs(up)))]
    axis = np.cross(up, axis)
    axis /= np.linalg.norm(axis)
    coordinates: FloatArray = points @ np.column_stack([axis, np.cross(up, axis)])
    return coordinates


def _is_visible(shown: Shown, other: Sample, up: FloatArray, scene: SampledPair) -> bool:
    """Return whether the other cloud covers the place of a part.

    It does if it has points across most of the part's footprint, or if it surrounds the footprint of an object that
    rises above its surroundings, in samples of the whole scene. Otherwise the other cloud ends there, or has a gap.
    """
    from scipy.ndimage import binary_dilation, binary_fill_holes

    side = scene.side
    places, others = _in_plane(shown.points, up), _in_plane(other.points, up)
    span = max(float(np.ptp(places, axis=0).max()), 8 * side)
    lower, upper = places.min(axis=0) - span, places.max(axis=0) + span
    step = _CELL * side
    shape = tuple(int(n) + 1 for n in (upper - lower) / step)
    covered = np.zeros(shape, dtype=bool)
    inside = ((others >= lower) & (others <= upper)).all(axis=1)
    covered[tuple(((others[inside] - lower) / step).astype(np.int64).T)] = True
    covered = binary_dilation(covered)
    texels = tuple(((places - lower) / step).astype(np.int64).T)
    if covered[texels].mean() >= _MIN_COVERED_SHARE:
        return True
    if not scene.shows_whole:
        return False
    surrounded = binary_fill_holes(covered)
    if surrounded[texels].mean() < _MIN_COVERED_SHARE:
        return False
    heights = shown.points @ up
    return float(np.percentile(heights, 95) - np.percentile(heights, 5)) >= _MIN_RELIEF * side


def convex_outline(points: FloatArray) -> tuple[tuple[float, float], ...]:
    """Return the corners of the convex hull of points (N, 2), counter-clockwise (Andrew's monotone chain, 1979)."""
    ordered = np.unique(_outer_points(points), axis=0)
    if len(ordered) < 3:
        return tuple((float(x), float(y)) for x, y in ordered)
    halves = []
    for chain in (ordered, ordered[::-1]):
        hull: list[FloatArray] = []
        for point in chain:
            while len(hull) > 1 and _turn(hull[-2], hull[-1], point) <= 0:
                hull.pop()
            hull.append(point)
        halves.append(hull[:-1])
    return tuple((float(x), float(y)) for x, y in halves[0] + halves[1])


def _outer_points(points: FloatArray) -> FloatArray:
    """Return the points (M, 2) of (N, 2) that may be corners of the convex hull.

    A point inside a polygon of other points is none (Akl and Toussaint 1978, "A fast convex hull algorithm"). The
    polygon's corners are farthest in sixteen directions, counter-clockwise.
    """
    angles = np.arange(_DIRECTIONS) * (2 * np.pi / _DIRECTIONS)
    corners = points[np.argmax(points @ np.stack([np.cos(angles), np.sin(angles)]), axis=0)]
    area = float(np.prod(corners.max(axis=0) - corners.min(axis=0)))
    inside = np.full(len(points), area > 0)
    for start, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        if (start != end).any():
            along, away = end - start, points - start
            inside &= along[0] * away[:, 1] - along[1] * away[:, 0] > _ROUNDING * area
    outer: FloatArray = points[~inside]
    return outer


def _turn(a: FloatArray, b: FloatArray, c: FloatArray) -> float:
    return float((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]))
