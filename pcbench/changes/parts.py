"""Connected parts of points that differ between two clouds."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcbench.changes.offsets import OffsetTest
from pcbench.changes.presence import BALLS, Absence
from pcbench.changes.samples import Sample
from pcbench.geometry.arrays import FloatArray, IntArray
from pcbench.geometry.neighbors import Index
from pcbench.geometry.voxels import cells

_LINK = 4.0  # largest gap between points of one part, in voxels of the samples
_CELL_SIDE = 0.57  # of cells whose points are all near each other, in these gaps: less than the root of a third
_LINKED_AT_ONCE = 2_048  # points whose links are in memory: each has about a hundred on a surface
_MIN_POINTS = 12  # sampled points of each cloud that lie off the other's surface in one part
# Points of a small part that lie off the surface and that have no counterparts: if it moved farther than its size, only
# one cloud shows its offset.
_MIN_OF_EACH = 6
_MAX_RATIO = 2.0  # of the offsets that both clouds show


class PointTests(NamedTuple):
    """Tests at the points of a sample, N points.

    Attributes:
        offsets: tests for an offset from the other cloud's surface.
        signed: (N,) signed distances from that surface.
        absence: tests for counterparts.
    """

    offsets: OffsetTest
    signed: FloatArray
    absence: Absence

    @property
    def is_flagged(self) -> NDArray[np.bool_]:
        """(N,) whether a point differs from the other cloud."""
        return self.absence.is_absent | self.offsets.is_off

    def p_value(self, rows: IntArray) -> float:
        """Return the probability that a part, given by its rows, differs by chance at one place.

        Points share the neighbours in a ball, so that each ball counts once.
        """
        if not len(rows):
            return 1.0
        balls = max(1.0, len(rows) / BALLS[0].points)
        log_p = balls * float(np.log(np.maximum(self.absence.p[rows], 1e-300)).mean())
        return min(float(self.offsets.p[rows].min()), float(np.exp(max(log_p, -690.0))))


class ChangedPart(NamedTuple):
    """Rows of both samples that form a connected part."""

    reference: IntArray
    candidate: IntArray


def connected_parts(samples: Sequence[Sample], evidence: Sequence[PointTests]) -> Iterator[ChangedPart]:
    """Yield the significant parts of the flagged points of both samples, reference first.

    Points of one cloud belong together if they are near each other; points of both, if one is the other's nearest.
    A part is significant if enough of its points have no counterparts, or if both clouds show about the same offset.
    """
    rows = [np.flatnonzero(each.is_flagged) for each in evidence]
    starts, total = (0, len(rows[0])), sum(map(len, rows))
    if total == 0:
        return
    labels = np.arange(total)
    for sample, r, start in zip(samples, rows, starts, strict=True):
        for links in _links_within(sample, r):
            labels = _joined(labels, links + start)
    for own, other in ((0, 1), (1, 0)):
        links = _links_across(samples[own], samples[other], rows[own], rows[other])
        labels = _joined(labels, links + np.array([[starts[own]], [starts[other]]]))
    order = np.argsort(labels, kind="stable")
    for members in np.split(order, np.flatnonzero(np.diff(labels[order])) + 1):
        split = int(np.searchsorted(members, starts[1]))
        part = ChangedPart(rows[0][members[:split]], rows[1][members[split:] - starts[1]])
        if _is_significant(part, evidence):
            yield part


def _joined(labels: IntArray, links: IntArray) -> IntArray:
    """Return the labels (N,) of nodes by the lowest node of their component, after more links (2, E) joined them."""
    labels = labels.copy()
    while len(links[0]):
        ends = labels[links]
        apart = np.flatnonzero(ends[0] != ends[1])
        links, ends = links[:, apart], ends[:, apart]
        np.minimum.at(labels, ends.max(axis=0), ends.min(axis=0))
        while not np.array_equal(labels, labels[labels]):
            labels = labels[labels]
    return labels


def _links_within(sample: Sample, rows: IntArray) -> Iterator[IntArray]:
    """Yield (2, E) pairs of flagged points of one sample that are near each other, which connect all that are."""
    if not len(rows):
        return
    points, gap = sample.points[rows], _LINK * sample.side
    grid = cells(points, _CELL_SIDE * gap)
    yield np.stack([np.arange(len(rows)), grid.first[grid.of_point]])
    index = Index(points)
    for start in range(0, len(rows), _LINKED_AT_ONCE):
        near = index.query_radius(points[start : start + _LINKED_AT_ONCE], gap)
        pairs = np.stack([np.repeat(np.arange(len(near.counts)) + start, near.counts), near.indices])
        yield pairs[:, pairs[1] < pairs[0]]


def _links_across(own: Sample, other: Sample, rows: IntArray, other_rows: IntArray) -> IntArray:
    """Return (2, E) pairs of flagged points of which the second is the other sample's nearest point to the first."""
    if not (len(rows) and len(other_rows)):
        return np.empty((2, 0), np.int64)
    number = np.full(len(other), -1)
    number[other_rows] = np.arange(len(other_rows))
    facing = number[other.index.query(own.points[rows]).indices]
    some = np.flatnonzero(facing >= 0)
    return np.stack([some, facing[some]])


def _is_significant(part: ChangedPart, evidence: Sequence[PointTests]) -> bool:
    for rows, each in zip(part, evidence, strict=True):
        is_absent, is_off = each.absence.is_absent[rows], each.offsets.is_off[rows]
        has_both = min(np.count_nonzero(is_absent), np.count_nonzero(is_off)) >= _MIN_OF_EACH
        if each.absence.is_significant(rows) or (has_both and np.count_nonzero(is_absent | is_off) >= _MIN_POINTS):
            return True
    off = [rows[each.offsets.is_off[rows]] for rows, each in zip(part, evidence, strict=True)]
    if min(map(len, off)) < _MIN_POINTS:
        return False
    ours, theirs = (float(np.median(each.signed[rows])) for rows, each in zip(off, evidence, strict=True))
    return ours * theirs > 0 and 1 / _MAX_RATIO <= ours / theirs <= _MAX_RATIO
