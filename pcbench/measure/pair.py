"""A candidate aligned with the reference: the steps of a comparison before and beside its metrics."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcbench.changes import Changes, ClosestPoints
from pcbench.deformation import Deformation, Side, residual_deformation, separate_changes
from pcbench.errors import RegistrationError
from pcbench.geometry.arrays import IntArray
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.crop import points_inside
from pcbench.geometry.neighbors import Index, Matches
from pcbench.geometry.normals import Surface
from pcbench.geometry.quantisation import PlacedQuantisation
from pcbench.geometry.sampling import NeighborRange
from pcbench.geometry.transform import Similarity
from pcbench.measure import presets
from pcbench.measure.budget import D2Budget, FitFrame, budget, sum_queries
from pcbench.measure.directions import PLANE_METRIC, Direction, from_candidate, from_reference
from pcbench.measure.reference import Reference
from pcbench.measure.results import DirectedBudget
from pcbench.measure.settings import Settings
from pcbench.registration import Registration, register


@dataclass(frozen=True, eq=False)
class AlignedCandidate:
    """A candidate aligned with the reference.

    Attributes:
        cloud: the candidate as it was read.
        registration: its registration to the reference.
        surface: the aligned points, minus the reference's origin.
        inside: (N,) whether each point lies in the region.
    """

    cloud: Cloud
    registration: Registration
    surface: Surface
    inside: NDArray[np.bool_]

    @property
    def index(self) -> Index:
        """Search index over the aligned points."""
        return self.surface.index

    def rounding(self, reference: Reference) -> PlacedQuantisation | None:
        """Return how the points are rounded and then moved; None if rounding is negligible in both clouds."""
        clouds, extent = (reference.cloud, self.cloud), reference.target.extent
        if all(cloud.quantisation.is_negligible(extent) for cloud in clouds):
            return None
        shift = Similarity(np.eye(3), -reference.origin)
        return PlacedQuantisation(self.cloud.quantisation, self.registration.T_local @ shift)


class Matched(NamedTuple):
    """Closest points of the queries in the region, in both directions, and those of both cropped clouds."""

    forth: Matches
    back: Matches
    pair: presets.CroppedPair


def align(reference: Reference, name: str, cloud: Cloud, settings: Settings) -> AlignedCandidate:
    """Register a candidate and return it in the reference's coordinates.

    Raises:
        InputError: no aligned point lies in the region.
        RegistrationError: the clouds do not overlap.
    """
    try:
        registration = register(
            reference.cloud, cloud, settings.register, initial=settings.initial, target=reference.target
        )
    except RegistrationError as error:
        raise RegistrationError(f"{name}: {error}") from error
    points = registration.T_local.apply(cloud.points - reference.origin)
    inside = points_inside(points, reference.region, settings.crop, f"{name}'s", reference.origin)
    return AlignedCandidate(cloud, registration, Surface(Index(points), is_even=False), inside)


def match_pair(reference: Reference, aligned: AlignedCandidate) -> Matched:
    """Match in both directions; the region selects the queries, but the complete clouds are searched."""
    pair = _cropped_pair(reference, aligned.index, aligned.inside)
    if reference.region is None:
        return Matched(pair.to_reference, pair.to_candidate, pair)
    forth = reference.index.query(aligned.index.points[aligned.inside])
    return Matched(forth, aligned.index.query(reference.measured_points), pair)


def _cropped_pair(reference: Reference, candidate: Index, inside: NDArray[np.bool_]) -> presets.CroppedPair:
    """Crop both clouds to the region and match them, without normals; without a region they are matched as they are."""
    if reference.region is None:
        return presets.match(reference.index, candidate, reference.neighbors, None, None)
    cut = Index(reference.measured_points)
    return presets.match(cut, Index(candidate.points[inside]), NeighborRange.within(cut), None, None)


def measure_directions(
    reference: Reference, aligned: AlignedCandidate, matched: Matched, seed: int
) -> tuple[Direction, Direction]:
    """Return the distances candidate → reference and reference → candidate, with their sampling floors."""
    points = aligned.index.points
    queries = points if reference.region is None else points[aligned.inside]
    rounding = aligned.rounding(reference)
    forth = from_candidate(reference, queries, matched.forth, seed=seed, rounding=rounding)
    closest = np.full(len(aligned.cloud), -1)
    closest[aligned.inside] = matched.forth.indices
    return forth, from_reference(
        reference, aligned.surface, closest, matched.back, forth=forth, seed=seed, rounding=rounding
    )


def find_changes(reference: Reference, aligned: AlignedCandidate, matched: Matched) -> Changes:
    """Find the changes between the complete clouds, in the reference's local coordinates."""
    closest = None
    if reference.region is None and reference.neighbors is not None:
        closest = ClosestPoints(matched.back, matched.forth, has_duplicates=reference.neighbors.smallest == 0)
    changes = separate_changes(*_sides(reference, aligned), closest)
    return changes.of_points(reference.points, aligned.index.points)


def _sides(reference: Reference, aligned: AlignedCandidate) -> tuple[Side, Side]:
    ours = Side(reference.surface, reference.inside, reference.cloud)
    return ours, Side(aligned.surface, aligned.inside, aligned.cloud)


def assess_deformation(reference: Reference, aligned: AlignedCandidate, seed: int, changes: Changes) -> Deformation:
    """Assess the deformation of the part that did not change, with closest points found anew."""
    ours, theirs = _sides(reference, aligned)
    ours, theirs = ours.without(changes.of_reference), theirs.without(changes.of_candidate)
    return residual_deformation(ours, theirs, aligned.registration, reference.origin, seed=seed)


def split_into_budget(
    reference: Reference,
    aligned: AlignedCandidate,
    closest: IntArray,
    directions: tuple[Direction, Direction],
    changes: Changes,
    deformation: Deformation,
) -> DirectedBudget | None:
    """Return the budget of D2 in both directions; None if D2 is unknown or estimated from a sample.

    Args:
        reference: the prepared reference.
        aligned: the aligned candidate.
        closest: (M,) reference points closest to the candidate's points inside the region.
        directions: distances of both directions.
        changes: changes between the complete clouds.
        deformation: the deformation, for its noise.
    """
    frame = FitFrame.of(np.array(reference.surface.bounds))
    white = None if deformation.noise is None else deformation.noise.sigma_white

    def of(direction: Direction, rows: IntArray | None, labels: NDArray[np.int32]) -> D2Budget | None:
        if not isinstance(direction.distances.to_planes, np.ndarray):
            return None
        sums = sum_queries(
            direction.distances.to_planes,
            reference.points,
            reference.surface.compute_normals(rows),
            rows,
            labels,
            len(changes.found),
            frame,
        )
        return budget(sums, frame, floor=direction.floors[PLANE_METRIC], white=white)

    of_candidate, of_reference = changes.of_candidate, changes.of_reference
    if reference.region is not None:
        of_candidate, of_reference = of_candidate[aligned.inside], of_reference[reference.rows]
    accuracy = of(directions[0], closest, of_candidate)
    completeness = of(directions[1], reference.rows, of_reference)
    if accuracy is None or completeness is None:
        return None
    return DirectedBudget(accuracy, completeness, aligned.registration.keeps_pose)
