"""Find the parts of a scene that changed between two aligned clouds.

Two tests cover all sizes, and none of them cuts pairs off at a distance. Where a cloud is a smooth surface, cells of
several sizes are tested for an offset along the normals, as M3C2 does (Lague et al. 2013). Anywhere, the number of
points around a point is compared with the number that the other cloud's density explains: a part that moved far, or
that one cloud lacks, has no counterparts. Both are made on even samples of at most 60,000 points, with closest points
and planes of the complete clouds: first on samples of the whole scene, then on finer ones of suspicious places. An
offset counts only if both clouds show it, and only beyond what the reference shows against itself: planes are biased at
edges and between sparse points.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcbench.changes.description import SampledPair, describe
from pcbench.changes.details import MAX_GAIN, MAX_SCREENED, MIN_GAIN, Places, Screened, find_places
from pcbench.changes.offsets import Offsets, find_offsets, shortest_width
from pcbench.changes.parts import ChangedPart, PointTests, connected_parts
from pcbench.changes.presence import find_absence
from pcbench.changes.result import STABLE, UNMATCHED, Change, Changes
from pcbench.changes.samples import SIDE_VOXELS, Sample, common_side, finest_side
from pcbench.geometry.arrays import FloatArray, IntArray
from pcbench.geometry.neighbors import Index, Matches
from pcbench.geometry.normals import Surface
from pcbench.geometry.regions import Region

_MIN_POINTS = 100
_MAX_NOISE_SAMPLE = 10_000
_MAX_SHEET_VARIATION = 0.03  # surface variation, or four times its lower quartile: a smooth surface
_MIN_UPWARD = 0.5  # vertical component of a normal, from which a surface is no wall
_MAX_P = 0.05  # of a change in suspicious places, which are many
_MAX_TANGENTIAL = 3.0  # tangential distance of closest points on the same surface, in voxels of the sample


@dataclass(frozen=True, eq=False)
class SampledChanges:
    """Changes, with the labels of sampled points of both clouds.

    Attributes:
        found: the changes, the most important one first.
        samples: sampled points of the reference and of the candidate; None if the clouds are too small.
        labels: labels of the sampled points, see `Changes`.
        share: share of the points of an even sample of the scene that belong to changes, 0 to 1: the larger one of both
            clouds.
        noise: standard deviation of the noise of a sampled point.
        large: the same without changes that only a search of suspicious places shows; None if there are none.
        left_out: number of further suspicious places, which were not searched.
    """

    found: tuple[Change, ...]
    samples: tuple[Index, Index] | None
    labels: tuple[NDArray[np.int32], NDArray[np.int32]]
    share: float
    noise: float = 0.0
    large: SampledChanges | None = None
    left_out: int = 0

    @classmethod
    def none(cls) -> SampledChanges:
        """Return the result for clouds that are too small."""
        no_labels = np.zeros(0, np.int32)
        return cls((), None, (no_labels, no_labels), 0.0)

    def are_stable(self, which: int) -> bool:
        """Return whether all points of a cloud (0: the reference) are stable."""
        return self.samples is None or bool((self.labels[which] == STABLE).all())

    def of_clouds(self, reference: FloatArray, candidate: FloatArray) -> Changes:
        """Return the changes with the labels of all points (N, 3) and (M, 3) of both clouds."""
        return Changes(self.found, self.of_points(0, reference), self.of_points(1, candidate), self.left_out)

    def of_points(self, which: int, points: FloatArray) -> NDArray[np.int32]:
        """Return the labels (N,) of points (N, 3) of a cloud: those of the nearest sampled points."""
        if self.samples is None or self.are_stable(which):
            return np.broadcast_to(np.int32(STABLE), len(points))  # takes no memory
        labels: NDArray[np.int32] = self.labels[which][self.samples[which].query(points).indices]
        return labels


class SampleSearch(NamedTuple):
    """The search on one pair of samples.

    Attributes:
        samples: samples of the reference and of the candidate.
        described: parts that differ, with the change that each shows; None if one cloud hides it.
        noise, scatter: standard deviations of a point's noise, and of the offsets of small stable cells.
    """

    samples: tuple[Sample, Sample]
    described: list[tuple[ChangedPart, Change | None]]
    noise: float
    scatter: float

    @property
    def changes(self) -> list[Change]:
        """The changes."""
        return [change for _, change in self.described if change is not None]

    def labels(self, which: int, numbers: Mapping[int, int]) -> NDArray[np.int32]:
        """Return the labels (N,) of a sample (0: the reference), with the number of each change by its `id`."""
        labels = np.full(len(self.samples[which]), STABLE, np.int32)
        for is_change in (False, True):
            for part, change in self.described:
                if (change is not None) == is_change:
                    labels[part[which]] = UNMATCHED if change is None else numbers[id(change)]
        return labels


class ClosestPoints(NamedTuple):
    """Closest points of two complete clouds, for callers that know them already.

    Attributes:
        to_candidate: of each point of the reference in the candidate.
        to_reference: of each point of the candidate in the reference.
        has_duplicates: whether points of the reference are at the same place.
    """

    to_candidate: Matches
    to_reference: Matches
    has_duplicates: bool


def find_changes(reference: Surface, candidate: Surface, closest: ClosestPoints | None = None) -> SampledChanges:
    """Find the changes between a reference and an aligned candidate.

    Args:
        reference: points and normals of the reference.
        candidate: points of the candidate, in the same coordinates.
        closest: their closest points; None: those of the samples are searched.
    """
    if min(len(reference), len(candidate)) < _MIN_POINTS or reference.spacing == 0 or candidate.spacing == 0:
        return SampledChanges.none()
    finest = finest_side(reference, candidate, _noise(reference, candidate, closest))
    side = common_side(reference, candidate, finest)
    samples = _samples(reference, candidate, side)
    if samples is None:
        return SampledChanges.none()
    whole, details = _search(reference, candidate, samples, closest), None
    finer = max(finest, side / MAX_GAIN)
    places = _places(reference, candidate, closest, whole, finer) if side >= MIN_GAIN * finest else None
    if places is not None and (samples := _samples(reference, candidate, finer, places)) is not None:
        details = _search_details(reference, candidate, samples, closest, whole.scatter)
    large = _sampled_changes(whole)
    if details is None or places is None or not details.changes:
        return large
    return replace(_sampled_changes(whole, details, places), large=large, left_out=places.left_out)


def _sampled_changes(
    whole: SampleSearch, details: SampleSearch | None = None, places: Places | None = None
) -> SampledChanges:
    """Return the changes that the search of the whole scene found, and that of some places, whose labels replace it."""
    searches = [whole] if details is None else [whole, details]
    changes = sorted((each for search in searches for each in search.changes), key=lambda each: -each.importance)
    numbers = {id(change): number for number, change in enumerate(changes)}
    labels = [whole.labels(which, numbers) for which in (0, 1)]
    share = max(float(np.mean(each >= 0)) for each in labels)
    indices = [sample.index for sample in whole.samples]
    if details is not None and places is not None:
        for which, detail in enumerate(details.samples):
            outside = np.flatnonzero(~places.contains(indices[which].points))
            indices[which] = Index(np.concatenate([indices[which].points[outside], detail.points]))
            labels[which] = np.concatenate([labels[which][outside], details.labels(which, numbers)])
    return SampledChanges(tuple(changes), (indices[0], indices[1]), (labels[0], labels[1]), share, whole.noise)


def _samples(
    reference: Surface, candidate: Surface, side: float, region: Region | None = None
) -> tuple[Sample, Sample] | None:
    """Return samples of both clouds inside a region at a length scale; None if there are too few points."""
    rows = reference.first_in_cells(side / SIDE_VOXELS, region), candidate.first_in_cells(side / SIDE_VOXELS, region)
    if min(map(len, rows)) < _MIN_POINTS:
        return None
    return Sample.of(reference, rows[0], side), Sample.of(candidate, rows[1], side)


def _search(
    reference: Surface,
    candidate: Surface,
    samples: tuple[Sample, Sample],
    closest: ClosestPoints | None,
    points: int | None = None,
    least_error: float = 0.0,
) -> SampleSearch:
    """Search the changes between two samples, with closest points and planes of the complete clouds.

    Args:
        reference: the reference.
        candidate: the aligned candidate.
        samples: their samples.
        closest: closest points of the complete clouds, if they are known.
        points: number of points among which the most significant ones are sought; None: the samples.
        least_error: smallest standard error of an offset.
    """
    offsets = _offsets(reference, candidate, samples, closest)
    evidence = []
    for sample, other, sample_offsets in zip(samples, samples[::-1], offsets, strict=True):
        test = find_offsets(sample, sample_offsets, least_error)
        evidence.append(PointTests(test, sample_offsets.signed, find_absence(sample, other.index)))
    normals = [each.normals for each in offsets]
    scene = SampledPair(samples, evidence, normals, points or sum(map(len, samples)), shows_whole=points is None)
    described = describe(list(connected_parts(samples, evidence)), scene)
    noise, scatter = (max(getattr(each.offsets, name) for each in evidence) for name in ("noise", "scatter"))
    return SampleSearch(samples, described, noise, scatter)


def _search_details(
    reference: Surface,
    candidate: Surface,
    samples: tuple[Sample, Sample],
    closest: ClosestPoints | None,
    scatter: float,
) -> SampleSearch:
    """Search the changes between samples of suspicious places, which stand for all points of both clouds."""
    search = _search(reference, candidate, samples, closest, len(reference) + len(candidate), scatter)
    described = [(part, change) for part, change in search.described if change is None or change.p_value <= _MAX_P]
    return search._replace(described=described)


def _places(
    reference: Surface, candidate: Surface, closest: ClosestPoints | None, whole: SampleSearch, finer: float
) -> Places | None:
    """Return the places where a small part may have changed."""
    changed = [
        sample.points[np.concatenate([part[which] for part, _ in whole.described])]
        for which, sample in enumerate(whole.samples)
        if whole.described
    ]
    are_distinct = closest is not None and not closest.has_duplicates
    screens = (
        _screened(
            reference, candidate, reference, None if closest is None else closest.to_candidate, finer, are_distinct
        ),
        _screened(candidate, reference, reference, None if closest is None else closest.to_reference, finer),
    )
    points_of_changes = np.concatenate(changed) if changed else np.zeros((0, 3))
    return find_places(screens, whole.samples[0].side, finer, points_of_changes, reference.corner)


def _screened(
    surface: Surface,
    other: Surface,
    reference: Surface,
    closest: Matches | None,
    finer: float,
    are_distinct: bool = False,
) -> Screened:
    """Return some points of a cloud beside the other one, with their offsets along the reference's normals.

    Args:
        surface: the cloud.
        other: the other one.
        reference: one of both.
        closest: closest points of the complete cloud in the other one; None: they are searched.
        finer: length scale of the offsets.
        are_distinct: whether all points of the cloud are known to be at different places.
    """
    step = -(-len(surface) // MAX_SCREENED)
    points = surface.index.every(step)
    every = np.arange(0, len(surface), step)
    matches = other.index.query(points) if closest is None else closest.at(every)
    is_reference = surface is reference
    rows = matches.indices
    if is_reference:  # the first point at each place
        rows = every if are_distinct else surface.index.query(points).indices
    vectors = other.index.points[matches.indices]
    vectors -= points
    if not is_reference:
        np.negative(vectors, out=vectors)
    offsets = _signed(reference, rows, vectors, matches.distances, finer, np.zeros(0))
    return Screened(points, matches.distances, offsets.signed, offsets.is_sheet, len(surface) / len(points))


def _noise(reference: Surface, candidate: Surface, closest: ClosestPoints | None) -> float:
    """Return the standard deviation of the candidate's distances from the reference's planes on the stable part."""
    step = max(1, len(candidate) // _MAX_NOISE_SAMPLE)
    points = candidate.index.every(step)
    rows = reference.index.query(points).indices if closest is None else closest.to_reference.indices[::step]
    return shortest_width(reference.plane_offsets(points, rows))


def _offsets(
    reference: Surface, candidate: Surface, samples: Sequence[Sample], closest: ClosestPoints | None
) -> list[Offsets]:
    """Return the signed distances of both samples from the other cloud, along the reference's normals."""
    ours, theirs = samples
    if closest is None:
        back, forth = candidate.index.query(ours.points), reference.index.query(theirs.points)
    else:
        back, forth = closest.to_candidate.at(ours.rows), closest.to_reference.at(theirs.rows)
    own = _own_offsets(reference, ours)
    vectors = candidate.points[back.indices] - ours.points, theirs.points - reference.points[forth.indices]
    self_offsets = own[ours.index.query_index(theirs.index).indices]
    return [
        _signed(reference, ours.rows, vectors[0], back.distances, ours.side, own),
        _signed(reference, forth.indices, vectors[1], forth.distances, theirs.side, self_offsets),
    ]


def _signed(
    reference: Surface, rows: IntArray, vectors: FloatArray, distances: FloatArray, side: float, own: FloatArray
) -> Offsets:
    """Return the offsets of points along the reference's normals.

    Args:
        reference: the reference.
        rows: (N,) its points.
        vectors: (N, 3) from the reference to the candidate.
        distances: (N,) their lengths.
        side: length scale of the sample.
        own: (N,) absolute offset that the reference shows from itself.
    """
    normals, variation = _oriented(reference.normals(rows)), reference.variation(rows)
    signed = np.einsum("ni,ni->n", vectors, normals)
    tangential = np.sqrt(np.maximum(np.square(distances) - np.square(signed), 0))
    smooth = variation <= max(_MAX_SHEET_VARIATION, 4 * float(np.percentile(variation, 25)))
    return Offsets(signed, normals, smooth & (tangential <= _MAX_TANGENTIAL * side), own)


def _oriented(normals: FloatArray) -> FloatArray:
    """Return normals (N, 3) that point upwards, and on walls along the larger one of x and y.

    The sign of estimated normals is arbitrary on walls, where offsets of one cell would cancel.
    """
    axis = np.where(np.abs(normals[:, 2]) >= _MIN_UPWARD, 2, np.argmax(np.abs(normals[:, :2]), axis=1))
    signs = np.sign(np.take_along_axis(normals, axis[:, None], axis=1))
    return np.where(signs == 0, 1.0, signs) * normals


def _own_offsets(reference: Surface, sample: Sample) -> FloatArray:
    """Return (N,) absolute distances of a sample of the reference from planes at the nearest other points, smoothed."""
    nearest = reference.index.query(sample.points, 2).indices[:, 1]  # of copies the point itself, or another copy
    signed = np.einsum("ni,ni->n", sample.points - reference.points[nearest], _oriented(reference.normals(nearest)))
    return np.abs(sample.smooth(signed))
