"""Free space as a laser scanner observed it: places that its beams passed, and places where they ended.

Schoeps et al. 2017, "A multi-view stereo benchmark with high-resolution images and multi-camera videos", section 4.2. A
beam is a cone around the ray from the scanner to a scan point. Its radius at distance d is the start radius plus d
times the tangent of half the divergence angle. A point in the beam of a scan point is observed: it lies in free space
if the beam passes it to reach the scan point, and on the surface if it is near the scan point.

All arithmetic has the precision of the points, so that the rounding of the official program (float32) can be repeated.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcbench.errors import InputError
from pcbench.geometry.neighbors import Index, Neighborhoods

Floats = NDArray[np.floating[Any]]

_MAX_PAIRS = 1 << 20  # pairs of a point and a scan point that are evaluated at a time
_MAX_CHORD_RATIO = 1.1  # between the widest and the narrowest beam of a search
_FIRST_QUERIES = 256  # points of the first search; the number then follows the number of scan points per beam
# Rays are searched among unit vectors. Rounding to float32 moves these, and the distance of a point to a ray relative
# to its distance to the scanner, by several units of 6e-8.
_SEARCH_MARGIN, _SEARCH_GROWTH = 2e-6, 1e-5


class Beam(NamedTuple):
    """Shape of a laser beam.

    Attributes:
        start_radius: its radius at the scanner.
        divergence_halfangle_rad: angle between its axis and its side.
    """

    start_radius: float
    divergence_halfangle_rad: float

    def radii(self, distances: Floats) -> Floats:
        """Return the radii (N,) at distances (N,) from the scanner."""
        kind = distances.dtype.type
        radii: Floats = kind(self.start_radius) + distances * kind(np.tan(kind(self.divergence_halfangle_rad)))
        return radii


class BeamObservation(NamedTuple):
    """Evidence of scans about points.

    Attributes:
        squared_distances: (N,) squared distance to the nearest scan point in whose beam the point lies; inf: none.
        in_free_space: (N,) whether a beam passes the point and ends behind it.
    """

    squared_distances: Floats
    in_free_space: NDArray[np.bool_]

    @classmethod
    def nothing(cls, count: int, kind: type[np.floating[Any]]) -> BeamObservation:
        """Return the observation of points that no scan has seen yet."""
        return cls(np.full(count, np.inf, kind), np.zeros(count, np.bool_))


class FreeSpace:
    """The beams of one scan.

    Args:
        scan: (N, 3) scan points relative to the scanner, float32 or float64. Points at the scanner are left out.
        beam: shape of the beams.

    Raises:
        InputError: there is no point away from the scanner.
    """

    def __init__(self, scan: Floats, beam: Beam) -> None:
        lengths = length(scan)
        scan, lengths = scan[lengths > 0], lengths[lengths > 0]
        if not len(scan):
            raise InputError("expected scan points away from the scanner, at the origin of the scan's coordinates")
        rays = scan / lengths[:, None]
        self._beam, self._lengths = beam, lengths
        self._x, self._y, self._z = np.ascontiguousarray(scan.T)
        self._ray_x, self._ray_y, self._ray_z = np.ascontiguousarray(rays.T)
        self._rays = Index(rays)

    def observe(self, points: Floats) -> BeamObservation:
        """Return the evidence of the scan about points (N, 3) relative to the scanner, in its precision."""
        result = BeamObservation.nothing(len(points), points.dtype.type)
        distances = length(points)
        radii = self._beam.radii(distances)
        at_scanner = radii >= distances  # such a point is in the beam of any scan point in front of it
        if at_scanner.any():
            everything = Neighborhoods(np.array([0, len(self._lengths)]), np.arange(len(self._lengths)))
            for row in np.flatnonzero(at_scanner):
                self._evaluate(points, radii, np.array([row]), everything, result)
        rows = np.flatnonzero(~at_scanner)
        chords = 2 * np.sin(np.arcsin(np.float64(radii[rows]) / distances[rows]) / 2)
        for batch, near in self._search(points, distances, rows, chords * (1 + _SEARCH_GROWTH) + _SEARCH_MARGIN):
            self._evaluate(points, radii, batch, near, result)
        return result

    def _search(
        self, points: Floats, distances: Floats, rows: NDArray[np.int64], chords: Floats
    ) -> Iterator[tuple[NDArray[np.int64], Neighborhoods]]:
        """Yield points and the scan points in their beams, in batches of about `_MAX_PAIRS` pairs."""
        order = np.argsort(chords, kind="stable")
        ascending = chords[order]
        start, count = 0, _FIRST_QUERIES
        while start < len(order):
            # A batch is searched within its largest chord, and beams are much wider near the scanner.
            last = int(np.searchsorted(ascending, _MAX_CHORD_RATIO * ascending[start], side="right"))
            batch = order[start : min(start + count, last)]
            queries = rows[batch]
            near = self._rays.query_radius(points[queries] / distances[queries, None], float(chords[batch[-1]]))
            start += len(batch)
            count = int(np.clip(len(batch) * _MAX_PAIRS / max(len(near.indices), 1), 1, 4 * len(batch)))
            yield queries, near

    def _evaluate(
        self,
        points: Floats,
        radii: Floats,
        rows: NDArray[np.int64],
        near: Neighborhoods,
        result: BeamObservation,
    ) -> None:
        """Add the evidence about some points to the result.

        Args:
            points: (N, 3) all points.
            radii: (N,) radii of the beams at these.
            rows: (M,) points to evaluate.
            near: rows of scan points whose beams may contain them.
            result: the evidence about all points, which is changed.
        """
        for first, last in _blocks(near.offsets):
            pairs = near.indices[near.offsets[first] : near.offsets[last]]
            counts = near.counts[first:last]
            occupied = counts > 0
            if not occupied.any():
                continue
            x, y, z = (np.repeat(column, counts) for column in points[rows[first:last]].T)
            ray_x, ray_y, ray_z = self._ray_x[pairs], self._ray_y[pairs], self._ray_z[pairs]
            along = _sum(ray_x * x, ray_y * y, ray_z * z)
            squares = _sum(*(np.square(p - along * r) for p, r in ((x, ray_x), (y, ray_y), (z, ray_z))))
            in_beam = (along >= 0) & (squares <= np.repeat(np.square(radii[rows[first:last]]), counts))
            passed = in_beam & (along < self._lengths[pairs])
            differences = ((self._x, x), (self._y, y), (self._z, z))
            squared = _sum(*(np.square(scan[pairs] - p) for scan, p in differences))
            squared[~in_beam] = np.inf
            starts = (near.offsets[first:last] - near.offsets[first])[occupied]
            chosen = rows[first:last][occupied]
            result.squared_distances[chosen] = np.minimum.reduceat(squared, starts)
            result.in_free_space[chosen] = np.logical_or.reduceat(passed, starts)


def length(vectors: Floats) -> Floats:
    """Return the lengths (N,) of vectors (N, 3) in their precision."""
    lengths: Floats = np.sqrt(_sum(*np.square(vectors.T)))
    return lengths


def _sum(x: Floats, y: Floats, z: Floats) -> Floats:
    """Return x + (y + z): the order in which the official program adds, which rounds differently from others."""
    total: Floats = x + (y + z)
    return total


def _blocks(offsets: NDArray[np.int64]) -> Iterator[tuple[int, int]]:
    """Yield ranges of queries with at most `_MAX_PAIRS` pairs, or of one query."""
    first, count = 0, len(offsets) - 1
    while first < count:
        last = int(np.searchsorted(offsets, offsets[first] + _MAX_PAIRS, side="right")) - 1
        last = min(max(last, first + 1), count)
        yield first, last
        first = last
