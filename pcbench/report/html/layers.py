"""The clouds of the page's 3D view: each candidate, and the reference coloured by its distance to each candidate."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcbench.geometry.arrays import FloatArray, IntArray, even_rows
from pcbench.report.colors import Range, ranges_of
from pcbench.report.html.packing import CodeGrid, levels, morton_order, pack, rounded, scalar_codes
from pcbench.report.inputs import FinishedComparison
from pcbench.report.plot.views import COORDINATES, SceneAxes

MAX_POINTS = 500_000  # of a cloud
MAX_BYTES = 2_800_000  # of all clouds before base64, which adds a third
_POINT_BYTES, _SCALAR_BYTES = 4.0, 0.95  # of a typical point after compression: noisy surfaces compress least
_MAX_FAR_SHARE = 0.5  # of a cloud's budget for points beyond the legend's limit
_CORE_RANKS = 0.1, 99.9  # percentiles of the coordinates; points far outside would make the grid coarse
_CORE_GROWTH = 2.0  # box lengths beyond these percentiles that are still shown
_OVERSAMPLING = 2  # points sorted for each point kept: sorting all points of a large cloud would take long
_SPACING_SAMPLE = 20_000
_DIRECTIONS = 100  # in which the outermost points are found


class _Scalar(NamedTuple):
    """A scalar with its colour range; `candidate` is the one that a scalar of the reference belongs to."""

    key: str
    values: FloatArray
    scale: Range
    candidate: str = ""


class _Source(NamedTuple):
    """A cloud of the view before thinning; the reference has no name.

    `sampled_from` is the number of measured points, if these are a sample of them.
    """

    name: str
    points: FloatArray
    scalars: list[_Scalar]
    sampled_from: int | None = None


@dataclass(frozen=True, eq=False)
class Layer:
    """A cloud of the view.

    Attributes:
        head: its description in the page's JSON.
        data: its points and scalars, see `packing.pack`.
        rows: the rows of the measured points that are shown, in the order of the data.
    """

    head: dict[str, Any]
    data: str
    rows: IntArray


def layers(comparison: FinishedComparison, end: float | None = None, axes: SceneAxes = COORDINATES) -> list[Layer]:
    """Return the layers of a comparison, candidates first.

    Args:
        comparison: the comparison.
        end: the end of the colour ranges, if the user sets it.
        axes: the axes along which the scene is framed.
    """
    sources = [source for source in _sources(comparison, end) if len(source.points)]
    limits = _point_limits([len(s.points) for s in sources], [len(s.scalars) for s in sources])
    return [_layer(source, limit, axes.rows) for source, limit in zip(sources, limits, strict=True)]


def _sources(comparison: FinishedComparison, end: float | None) -> Iterator[_Source]:
    spacing = comparison.reference.spacing_median
    maps = {c.name: c.deviation for c in comparison}
    scales = {}
    for key in dict.fromkeys(key for map_ in maps.values() for key in map_.scalars):
        values = {name: map_.even_values(key) for name, map_ in maps.items() if key in map_.scalars}
        scales[key] = ranges_of(values, spacing=spacing, end=end)
    for name, map_ in maps.items():
        scalars = [_Scalar(key, values, scales[key][name]) for key, values in map_.scalars.items()]
        yield _Source(name, map_.points, scalars, map_.sampled_from)
    cores = {name: map_.m3c2 for name, map_ in maps.items() if map_.m3c2 is not None}
    scales_m3c2 = ranges_of({name: m3c2.distances for name, m3c2 in cores.items()}, spacing=spacing, end=end)
    for name, m3c2 in cores.items():
        yield _Source(f"{name}, M3C2", m3c2.cores, [_Scalar("m3c2_distance", m3c2.distances, scales_m3c2[name])])
    backward = {c.name: c.completeness for c in comparison}
    to_candidates = ranges_of(
        {name: map_.even_values("distance") for name, map_ in backward.items()}, spacing=spacing, end=end
    )
    shared, *others = backward.values()
    points, missing = shared.points, {name: map_.scalars["distance"] for name, map_ in backward.items()}
    if not all(np.array_equal(map_.rows, shared.rows) for map_ in others):  # samples have their own largest deviations
        points = shared.points[shared.is_even]
        missing = {name: map_.even_values("distance") for name, map_ in backward.items()}
    scalars = [_Scalar("distance", values, to_candidates[name], name) for name, values in missing.items()]
    yield _Source("", points, scalars, shared.sampled_from)


def _point_limits(sizes: Sequence[int], scalars: Sequence[int]) -> list[int]:
    """Return how many points of each cloud fit into the budget: small clouds completely, the others equal parts."""
    costs = [_POINT_BYTES + _SCALAR_BYTES * count for count in scalars]
    limits = [0] * len(sizes)
    budget, open_costs = float(MAX_BYTES), sum(costs)
    for k in sorted(range(len(sizes)), key=lambda k: sizes[k]):
        limits[k] = max(1, min(sizes[k], MAX_POINTS, int(budget / open_costs)))
        budget -= limits[k] * costs[k]
        open_costs -= costs[k]
    return limits


def _layer(source: _Source, limit: int, axes: FloatArray) -> Layer:
    points, scalars = source.points, source.scalars
    core_rows = np.flatnonzero(_near_core(points))
    is_beyond = np.zeros(len(core_rows), dtype=bool)
    for scalar in scalars:
        is_beyond |= np.abs(scalar.values[core_rows]) > scalar.scale.high  # false for NaN
    kept = _thin(points[core_rows], is_beyond, limit)
    rows = core_rows[kept]
    grid = CodeGrid.of(points[rows])
    codes = grid.codes(points[rows])
    order = morton_order(codes)
    rows, codes = rows[order], codes[order]
    tables = [levels(_finite(s.values[rows]), s.scale.high, signed=s.scale.signed) for s in scalars]
    packed = [scalar_codes(s.values[rows], table) for s, table in zip(scalars, tables, strict=True)]
    sample = points[rows[:: max(1, len(rows) // _SPACING_SAMPLE)]]
    core = np.percentile(sample @ axes.T, [1, 99], axis=0)
    head = {
        "name": source.name,
        "total": source.sampled_from or len(points),
        "is_sample": source.sampled_from is not None,
        "shown": len(rows),
        "outside": len(points) - len(core_rows),
        "beyond": int(is_beyond.sum()),
        "beyond_shown": int(is_beyond[kept].sum()),
        "low": grid.low.tolist(),
        "step": grid.step.tolist(),
        "core": core.tolist(),
        "extremes": _extremes(sample[((sample @ axes.T - core[0]) * (core[1] - sample @ axes.T) >= 0).all(axis=1)]),
        "spacing": _shown_spacing(points[rows]),
        "scalars": [
            {
                "key": s.key,
                "of": s.candidate,
                "low": s.scale.low,
                "high": s.scale.high,
                "signed": s.scale.signed,
                "note": s.scale.note,
                "levels": rounded(table, 6),
            }
            for s, table in zip(scalars, tables, strict=True)
        ],
    }
    return Layer(head, pack(codes, packed), rows)


def _near_core(points: FloatArray) -> NDArray[np.bool_]:
    """Return which points (N, 3) lie near the cloud's core; a distant outlier would make the grid coarse."""
    sample = points[:: max(1, len(points) // 200_000)]
    low, high = np.percentile(sample, _CORE_RANKS, axis=0)
    margin = _CORE_GROWTH * (high - low).max() + 1e-9 * np.abs(high).max() + np.finfo(np.float64).tiny
    is_near: NDArray[np.bool_] = ((points >= low - margin) & (points <= high + margin)).all(axis=1)
    return is_near


def _thin(points: FloatArray, is_beyond: NDArray[np.bool_], limit: int) -> IntArray:
    """Return the rows of at most `limit` points.

    Points beyond the legend's limit are kept, unless they would take more than half of the points. The rest is
    thinned evenly along the Morton curve, so that all parts of the scene keep their share.
    """
    if len(points) <= limit:
        return np.arange(len(points))
    far_rows, near_rows = np.flatnonzero(is_beyond), np.flatnonzero(~is_beyond)
    far_rows = _evenly_in_space(points, far_rows, max(int(_MAX_FAR_SHARE * limit), limit - len(near_rows)))
    return np.concatenate([far_rows, _evenly_in_space(points, near_rows, limit - len(far_rows))])


def _evenly_in_space(points: FloatArray, rows: IntArray, count: int) -> IntArray:
    """Return at most `count` of the rows, at even steps along the Morton curve through their points."""
    if len(rows) <= count:
        return rows
    rows = _evenly(rows, _OVERSAMPLING * count)
    order = morton_order(CodeGrid.of(points[rows]).codes(points[rows])) if count else rows[:0]
    return _evenly(rows[order], count)


def _evenly(rows: IntArray, count: int) -> IntArray:
    """Return at most `count` rows at even steps."""
    return rows[even_rows(len(rows), max(count, 0))]


def _extremes(points: FloatArray) -> list[list[float]]:
    """Return the outermost of points (N, 3) in many directions, which the view must contain."""
    if not len(points):
        return []
    k = np.arange(_DIRECTIONS) + 0.5  # on a spiral from pole to pole
    height, angle = 1 - 2 * k / _DIRECTIONS, np.pi * (1 + 5**0.5) * k
    level = np.sqrt(1 - height**2)
    directions = np.stack([level * np.cos(angle), level * np.sin(angle), height])
    rows = np.unique(((points - points[0]) @ directions).argmax(axis=0))
    extremes: list[list[float]] = points[rows].tolist()
    return extremes


def _finite(values: FloatArray) -> FloatArray:
    finite: FloatArray = values[np.isfinite(values)]
    return finite


def _shown_spacing(points: FloatArray) -> float:
    """Return the typical spacing of points (N, 3) in Morton order, by which they are drawn large enough."""
    if len(points) < 2:
        return 0.0
    return float(np.median(np.linalg.norm(np.diff(points[: 2 * _SPACING_SAMPLE], axis=0), axis=1)))
