"""Find the parts of a scene that changed between two aligned clouds.

Two tests cover all sizes, and none of them cuts pairs off at a distance. Where a cloud is a smooth surface, cells of
several sizes are tested for an offset along the normals, as M3C2 does (Lague et al. 2013). Anywhere, the number of
points around a point is compared with the number that the other cloud's density explains: a part that moved far, or
that one cloud lacks, has no counterparts. Both are made on even samples of at most 60,000 points, with closest points
and planes of the complete clouds. An offset counts only if both clouds show it, and only beyond what the reference
shows against itself: planes are biased at edges and between sparse points.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcbench.changes.description import SampledPair, describe
from pcbench.changes.offsets import Offsets, find_offsets, shortest_width
from pcbench.changes.parts import PointTests, connected_parts
from pcbench.changes.presence import find_absence
from pcbench.changes.result import STABLE, UNMATCHED, Change, Changes
from pcbench.changes.samples import Sample, common_side
from pcbench.geometry.arrays import FloatArray, IntArray
from pcbench.geometry.neighbors import Matches
from pcbench.geometry.normals import Surface

_MIN_POINTS = 100
_MAX_NOISE_SAMPLE = 10_000
_MAX_SHEET_VARIATION = 0.03  # surface variation, or four times its lower quartile: a smooth surface
_MIN_UPWARD = 0.5  # vertical component of a normal, from which a surface is no wall
_MAX_TANGENTIAL = 3.0  # tangential distance of closest points on the same surface, in voxels of the sample


@dataclass(frozen=True, eq=False)
class SampledChanges:
    """Changes, with the labels of even samples of both clouds.

    Attributes:
        found: the changes, the most important one first.
        samples: samples of the reference and of the candidate; None if the clouds are too small.
        labels: labels of the sampled points, see `Changes`.
    """

    found: tuple[Change, ...]
    samples: tuple[Sample, Sample] | None
    labels: tuple[NDArray[np.int32], NDArray[np.int32]]

    @property
    def share(self) -> float:
        """Share of the sampled points that belong to changes, 0 to 1: the larger one of both clouds."""
        return max(float(np.mean(labels >= 0)) if len(labels) else 0.0 for labels in self.labels)

    def are_stable(self, which: int) -> bool:
        """Return whether all points of a cloud (0: the reference) are stable."""
        return self.samples is None or bool((self.labels[which] == STABLE).all())

    def of_clouds(self, reference: FloatArray, candidate: FloatArray) -> Changes:
        """Return the changes with the labels of all points (N, 3) and (M, 3) of both clouds."""
        return Changes(self.found, self.of_points(0, reference), self.of_points(1, candidate))

    def of_points(self, which: int, points: FloatArray) -> NDArray[np.int32]:
        """Return the labels (N,) of points (N, 3) of a cloud: those of the nearest sampled points."""
        if self.samples is None or self.are_stable(which):
            return np.broadcast_to(np.int32(STABLE), len(points))  # takes no memory
        labels: NDArray[np.int32] = self.labels[which][self.samples[which].index.query(points).indices]
        return labels


class ClosestPoints(NamedTuple):
    """Closest points of two complete clouds, for callers that know them already.

    Attributes:
        to_candidate: of each point of the reference in the candidate.
        to_reference: of each point of the candidate in the reference.
        nearest_other: (N,) rows of the nearest other point of each point of the reference.
    """

    to_candidate: Matches
    to_reference: Matches
    nearest_other: IntArray


def find_changes(reference: Surface, candidate: Surface, closest: ClosestPoints | None = None) -> SampledChanges:
    """Find the changes between a reference and an aligned candidate.

    Args:
        reference: points and normals of the reference.
        candidate: points of the candidate, in the same coordinates.
        closest: their closest points; None: those of the samples are searched.
    """
    sizes, no_labels = (len(reference), len(candidate)), np.zeros(0, np.int32)
    nothing = SampledChanges((), None, (no_labels, no_labels))
    if min(sizes) < _MIN_POINTS or reference.spacing == 0 or candidate.spacing == 0:
        return nothing
    side = common_side(reference, candidate, _noise(reference, candidate))
    samples = Sample.of(reference, side), Sample.of(candidate, side)
    if min(map(len, samples)) < _MIN_POINTS:
        return nothing
    offsets = _offsets(reference, candidate, samples, closest)
    evidence = []
    for sample, other, sample_offsets in zip(samples, samples[::-1], offsets, strict=True):
        evidence.append(
            PointTests(find_offsets(sample, sample_offsets), sample_offsets.signed, find_absence(sample, other.index))
        )
    scene = SampledPair(samples, evidence, [each.normals for each in offsets])
    described = describe(list(connected_parts(samples, evidence)), scene)
    changed = [(part, change) for part, change in described if change is not None]
    changed.sort(key=lambda each: -each[1].importance)
    unmatched = [part for part, change in described if change is None]

    def labels(number: int) -> NDArray[np.int32]:
        numbers = np.full(len(samples[number]), STABLE, np.int32)
        for part in unmatched:
            numbers[part[number]] = UNMATCHED
        for label, (part, _) in enumerate(changed):
            numbers[part[number]] = label
        return numbers

    return SampledChanges(tuple(change for _, change in changed), samples, (labels(0), labels(1)))


def _noise(reference: Surface, candidate: Surface) -> float:
    """Return the standard deviation of the candidate's distances from the reference's planes on the stable part."""
    points = candidate.index.every(max(1, len(candidate) // _MAX_NOISE_SAMPLE))
    rows = reference.index.query(points).indices
    return shortest_width(reference.plane_offsets(points, rows))


def _offsets(
    reference: Surface, candidate: Surface, samples: Sequence[Sample], closest: ClosestPoints | None
) -> list[Offsets]:
    """Return the signed distances of both samples from the other cloud, along the reference's normals."""
    ours, theirs = samples
    if closest is None:
        nearest_other = reference.index.query(ours.points, 2).indices[:, 1]
        back, forth = candidate.index.query(ours.points), reference.index.query(theirs.points)
    else:
        nearest_other = closest.nearest_other[ours.rows]
        back, forth = closest.to_candidate.at(ours.rows), closest.to_reference.at(theirs.rows)
    own = _own_offsets(reference, ours, nearest_other)
    vectors = candidate.points[back.indices] - ours.points, theirs.points - reference.points[forth.indices]
    offsets = []
    for sample, rows, matches, vector, self_offsets in (
        (ours, ours.rows, back, vectors[0], own),
        (theirs, forth.indices, forth, vectors[1], own[ours.index.query_index(theirs.index).indices]),
    ):
        normals, variation = _oriented(reference.normals(rows)), reference.variation(rows)
        signed = np.einsum("ni,ni->n", vector, normals)
        tangential = np.sqrt(np.maximum(np.square(matches.distances) - np.square(signed), 0))
        smooth = variation <= max(_MAX_SHEET_VARIATION, 4 * float(np.percentile(variation, 25)))
        is_sheet = smooth & (tangential <= _MAX_TANGENTIAL * sample.side)
        offsets.append(Offsets(signed, normals, is_sheet, self_offsets))
    return offsets


def _oriented(normals: FloatArray) -> FloatArray:
    """Return normals (N, 3) that point upwards, and on walls along the larger one of x and y.

    The sign of estimated normals is arbitrary on walls, where offsets of one cell would cancel.
    """
    axis = np.where(np.abs(normals[:, 2]) >= _MIN_UPWARD, 2, np.argmax(np.abs(normals[:, :2]), axis=1))
    signs = np.sign(np.take_along_axis(normals, axis[:, None], axis=1))
    return np.where(signs == 0, 1.0, signs) * normals


def _own_offsets(reference: Surface, sample: Sample, nearest: IntArray) -> FloatArray:
    """Return (N,) absolute distances of a sample of the reference from planes at the nearest other points, smoothed."""
    signed = np.einsum("ni,ni->n", sample.points - reference.points[nearest], _oriented(reference.normals(nearest)))
    return np.abs(sample.smooth(signed))
