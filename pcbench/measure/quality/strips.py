"""Agreement of overlapping strips: the offset between the surfaces that two strips show of the same places.

At places where two strips have enough points within a radius, the normal follows from the points about the mean of
each strip, and the offset is the difference of both means along it. So neither the slope of the surface nor
another distribution of the points changes it. On surfaces of at most 30 degrees, the offset over the normal's z is the
vertical difference dz; the USGS Lidar Base Specification 2.1 calls its root mean square RMSDz (interswath consistency).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcbench.errors import InputError
from pcbench.geometry.arrays import FloatArray, IntArray
from pcbench.geometry.neighbors import Index
from pcbench.measure.intervals import partition
from pcbench.measure.quality.bootstrap import BlockEstimate, median_estimate, root_mean_square_estimate
from pcbench.measure.quality.groups import PointGroups
from pcbench.measure.quality.patches import seeds_of

FILE, NONE, AUTO, GPS_TIME, SOURCE = "file", "none", "auto", "gps_time", "point_source_id"
MIN_GAP_S = 5.0
"""Gap of the GPS time, in seconds, at which a new strip begins."""
_RADIUS_FACTOR = 1.5  # of the radius of patches
_MAX_STRIPS = 40  # the largest ones
_MIN_STRIP_POINTS = 100
_MIN_POINTS = 6  # of a strip at a place
_MIN_PLACES = 30  # of a pair of strips
_MAX_FLATNESS, _MIN_BREADTH = 0.3, 0.12  # as of patches
_MAX_LATERAL_SHARE = 0.6  # of the radius, between the means of both strips
_MIN_UPRIGHT = math.cos(math.radians(30.0))
_OUTLIER_SIGMAS = 5.0  # of the offsets of a pair, beyond which a place shows change or vegetation
_CHUNK_ROWS = 2_000_000


class StripPair(NamedTuple):
    """The agreement of two strips.

    Attributes:
        first: name of the strip with the smaller number.
        second: name of the other one.
        places: number of places that both show.
        dz: median vertical difference, second less first; None if few of these places are level.
        rms_dz: root mean square of the vertical differences; None likewise.
        rms_normal: root mean square of the offsets along the normals.
        left_out: share of the places beyond 5 NMAD, which are left out of both.
    """

    first: str
    second: str
    places: int
    dz: BlockEstimate | None
    rms_dz: BlockEstimate | None
    rms_normal: BlockEstimate
    left_out: float


class StripAgreement(NamedTuple):
    """The agreement of the strips of a cloud.

    Attributes:
        field: what tells the strips apart.
        strips: number of strips.
        pairs: pairs of strips with enough places, that with the largest difference first.
        rms_normal: root mean square of the offsets along the normals over all pairs; None without pairs.
        why_not: why there are no pairs; empty if there are.
    """

    field: str
    strips: int
    pairs: tuple[StripPair, ...]
    rms_normal: BlockEstimate | None
    why_not: str


def strip_names(
    attributes: Mapping[str, NDArray[Any]], files: IntArray | None, wanted: str
) -> tuple[str, IntArray, list[str]]:
    """Return what tells strips apart, the strip of each point (N,), and the names of the strips.

    Args:
        attributes: attributes of the points, each (N,).
        files: (N,) number of the file of each point; None: one file.
        wanted: the setting `QualitySettings.strips`.

    Raises:
        InputError: the cloud has no such attribute.
    """
    choices = [SOURCE, GPS_TIME, FILE] if wanted == AUTO else [wanted]
    for field in choices:
        numbers: IntArray | None
        if field == FILE:
            numbers = files
        elif field == GPS_TIME and field in attributes:
            numbers = _split_at_gaps(np.asarray(attributes[field], dtype=np.float64))
        elif field in attributes:
            numbers = np.asarray(attributes[field])
        else:
            numbers = None
            if wanted not in (AUTO, NONE):
                available = ", ".join(sorted(attributes)) or "none"
                raise InputError(f"expected --strips as an attribute of the cloud ({available}), got {wanted!r}")
        if numbers is None:
            continue
        values, strips, counts = np.unique(numbers, return_inverse=True, return_counts=True)
        large = np.argsort(-counts, kind="stable")[:_MAX_STRIPS]
        large = np.sort(large[counts[large] >= _MIN_STRIP_POINTS])
        if len(large) < 2:
            continue
        places = np.full(len(values), -1)
        places[large] = np.arange(len(large))
        return field, places[strips], [f"{value:g}" for value in values[large].astype(float)]
    return NONE if wanted == AUTO else wanted, np.zeros(0, dtype=np.int64), []


def strip_agreement(
    index: Index, strips: IntArray, names: list[str], field: str, radius: float, seed: int
) -> StripAgreement:
    """Return the agreement of overlapping strips.

    Args:
        index: index of the points.
        strips: (N,) strip of each point; -1: of none.
        names: names of the strips.
        field: what tells them apart.
        radius: radius of patches.
        seed: seed of random samples and of the bootstrap.
    """
    if len(names) < 2:
        return StripAgreement(field, len(names), (), None, "the points are not divided into strips")
    reach = _RADIUS_FACTOR * radius
    places, normals, offsets = _offsets(index, strips, len(names), seeds_of(index.points, reach, seed), reach)
    pairs, squares, members = [], [], []
    for pair, (first, second) in enumerate(combinations(range(len(names)), 2)):
        rows = np.flatnonzero(np.isfinite(offsets[pair]))
        if len(rows) < _MIN_PLACES:
            continue
        values = offsets[pair, rows]
        middle = np.median(values)
        spread = 1.4826 * float(np.median(np.abs(values - middle)))
        kept = np.abs(values - middle) <= _OUTLIER_SIGMAS * spread if spread > 0 else np.ones(len(values), bool)
        rows, values = rows[kept], values[kept]
        blocks = partition(places[rows]).of_point
        is_level = normals[rows, 2] >= _MIN_UPRIGHT
        heights, level = values[is_level] / normals[rows, 2][is_level], blocks[is_level]
        has_heights = len(heights) >= _MIN_PLACES
        rms = root_mean_square_estimate(values, blocks, seed)
        assert rms is not None
        pairs.append(
            StripPair(
                names[first],
                names[second],
                len(rows),
                median_estimate(heights, level, seed) if has_heights else None,
                root_mean_square_estimate(heights, level, seed) if has_heights else None,
                rms,
                1 - float(kept.mean()),
            )
        )
        squares.append(values)
        members.append(rows)
    if not pairs:
        return StripAgreement(field, len(names), (), None, "no two strips show enough places on a common surface")
    rows = np.concatenate(members)
    total = root_mean_square_estimate(np.concatenate(squares), partition(places[rows]).of_point, seed)
    return StripAgreement(field, len(names), tuple(sorted(pairs, key=_importance)), total, "")


def _importance(pair: StripPair) -> tuple[float, float]:
    return (-abs(pair.dz.value) if pair.dz is not None else 0.0, -pair.rms_normal.value)


def _split_at_gaps(times: FloatArray) -> IntArray | None:
    """Return the number of the strip of each point (N,), split at gaps of the GPS time; None without gaps."""
    if not np.isfinite(times).all():
        return None
    order = np.argsort(times, kind="stable")
    numbers = np.empty(len(times), dtype=np.int64)
    numbers[order] = np.concatenate([[0], np.cumsum(np.diff(times[order]) > MIN_GAP_S)])
    return numbers if numbers.max() else None


def _offsets(
    index: Index, strips: IntArray, count: int, seeds: FloatArray, radius: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return places (P, 3), upward normals (P, 3), and the offset of each pair at each place (pairs, P), else NaN."""
    mean = max(float(index.query_radius(seeds[:: max(len(seeds) // 64, 1)], radius).counts.mean()), 1.0)
    step = max(int(_CHUNK_ROWS / max(mean, 3.0 * count)), 1)
    parts = [
        _offsets_at(
            PointGroups.of(index.query_radius(seeds[k : k + step], radius), index.points),
            strips,
            count,
            seeds[k : k + step],
            radius,
        )
        for k in range(0, len(seeds), step)
    ]
    normals, offsets = zip(*parts, strict=True)
    return seeds, np.concatenate(normals), np.concatenate(offsets, axis=1)


def _offsets_at(
    groups: PointGroups, strips: IntArray, count: int, seeds: FloatArray, radius: float
) -> tuple[FloatArray, FloatArray]:
    offsets = groups.values - seeds[groups.of_row]
    strip = strips[groups.rows]
    is_known = strip >= 0
    cell = groups.of_row * count + np.maximum(strip, 0)
    size = len(seeds) * count
    counts = np.asarray(np.bincount(cell, is_known.astype(np.float64), size), dtype=np.float64)
    sums = np.stack([np.bincount(cell, offsets[:, k] * is_known, size) for k in range(3)], axis=1)
    means: FloatArray = sums / np.maximum(counts, 1)[:, None]
    _, values, axes = groups.principal_axes(offsets - means[cell], is_known.astype(float))
    normals = axes[:, :, 0] * np.where(axes[:, 2:, 0] < 0, -1.0, 1.0)
    breadth = np.sqrt(np.maximum(values[:, 1], 0))
    is_flat = (values[:, 1] > _MIN_BREADTH * values[:, 2]) & (
        np.sqrt(np.maximum(values[:, 0], 0)) < _MAX_FLATNESS * breadth
    )
    numbers, centres = counts.reshape(-1, count), means.reshape(-1, count, 3)
    result = np.full((count * (count - 1) // 2, len(seeds)), math.nan)
    for pair, (first, second) in enumerate(combinations(range(count), 2)):
        rows = np.flatnonzero(is_flat & (numbers[:, [first, second]].min(axis=1) >= _MIN_POINTS))
        between = centres[rows, second] - centres[rows, first]
        along = np.einsum("ni,ni->n", between, normals[rows])
        across = np.linalg.norm(between - along[:, None] * normals[rows], axis=1)
        close = across <= _MAX_LATERAL_SHARE * radius
        result[pair, rows[close]] = along[close]
    return normals, result
