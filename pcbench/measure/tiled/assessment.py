"""Sampling floors and deformation of two aligned clouds in tiles: those of memory, from the points that matter."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pcbench.deformation import Deformation, SeparatedChanges, Side, residual_deformation, separate_changes
from pcbench.deformation.displacement import Displacement
from pcbench.deformation.sides import MIN_PAIRS, SPREAD_SIDE, extent
from pcbench.geometry.arrays import FloatArray, IntArray
from pcbench.geometry.quantisation import PlacedQuantisation
from pcbench.geometry.regions import Region
from pcbench.geometry.sampling import Sampling
from pcbench.geometry.transform import Similarity
from pcbench.geometry.voxels import robust_extent, voxel_thin_to
from pcbench.measure import floors
from pcbench.measure.budget import budget
from pcbench.measure.directions import PLANE_METRIC, error_share, mean_values
from pcbench.measure.floors import FloorSurface
from pcbench.measure.results import DirectedBudget
from pcbench.measure.tiled.directions import DistanceSums, MeasuredDirection, TiledPair
from pcbench.measure.tiled.even import Picker, PlacedRuns, even_points
from pcbench.measure.tiled.labels import PointLabels, StableRegion
from pcbench.measure.tiled.nearby import TiledIndex, TiledSurface
from pcbench.measure.tiled.stored import StoredCloud
from pcbench.measure.tiled.tiles import GIVEN_NORMALS, TiledCloud
from pcbench.registration import Registration
from pcbench.tasks import TaskRunner

Floors = Mapping[str, float | None]
"""Sampling floor of each mean metric by name; None if it does not exist."""


@dataclass(frozen=True, eq=False)
class AlignedCloud:
    """A cloud on disk in the coordinates in which everything is measured.

    Attributes:
        stored: the cloud as sorted runs.
        tiles: its tiles.
        origin: (3,) local origin of the reference.
        pose: motion that is applied after this was subtracted; None for the reference.
        region: measured region in local coordinates; None: everything.
        runner: runs tasks.
        stage: start of the names of the stages.
        key: identifies the cloud and its pose.
        file: file for the tiles, which tasks share.
        normal_neighbors: number of neighbours from which a normal is estimated.
        known_sampling: its sampling; None: it is measured when it is needed.
    """

    stored: StoredCloud
    tiles: TiledCloud
    origin: FloatArray
    pose: Similarity | None
    region: Region | None
    runner: TaskRunner
    stage: str
    key: str
    file: Path
    normal_neighbors: int = 20
    known_sampling: Sampling | None = None

    @cached_property
    def surface(self) -> TiledSurface:
        """Its points and normals."""
        index = TiledIndex(self.tiles, self.file, self.runner, self.stage, self.key)
        return TiledSurface(index, self.normal_neighbors, self.known_sampling)

    @cached_property
    def inside(self) -> Picker:
        """Picks points inside the region."""
        name = "stable" if isinstance(self.region, StableRegion) else "inside"
        placed = PlacedRuns(self.stored.runs, self.origin, self.pose, self.region)
        return Picker.of(placed, self.runner, f"{self.stage}-{name}", self.key)

    def displaced(self, displacement: Displacement) -> TiledSurface:
        """Return its points after a displacement was removed."""
        return TiledSurface(self.surface.index.displaced(displacement))

    def limited_to(self, region: Region) -> AlignedCloud:
        """Return the cloud with another region, in which points have been loaded already."""
        limited = replace(self, region=region)
        limited.__dict__["surface"] = self.surface
        return limited

    def rounding(self) -> PlacedQuantisation:
        """Return how the points are rounded, in local coordinates."""
        shift = Similarity(np.eye(3), -self.origin)
        return PlacedQuantisation(self.stored.quantisation, shift if self.pose is None else self.pose @ shift)


@dataclass(frozen=True, eq=False)
class TiledSide(Side):
    """One cloud of the pair of the test for deformation.

    Attributes:
        aligned: the cloud.
        farthest: largest distance of its points from the other cloud.
    """

    aligned: AlignedCloud
    farthest: float

    @classmethod
    def of(cls, aligned: AlignedCloud, farthest: float = np.inf) -> TiledSide:
        """Return the side of a cloud."""
        return cls(aligned.surface, np.zeros(0, bool), aligned.stored.thinned, aligned, farthest)

    @property
    def fresh_surface(self) -> TiledSurface:
        """The same points and normals; what one search for changes needs of them does not stay in memory."""
        surface = self.aligned.surface
        return TiledSurface(surface.index.fresh("changes"), self.aligned.normal_neighbors, surface.sampling)

    @property
    def corners(self) -> FloatArray:
        """Lowest and highest corner (2, 3) of the points."""
        return self.aligned.tiles.corners

    def classes(self, rows: IntArray) -> NDArray[Any] | None:
        """Return the LAS classes (M,) of points; None without classes."""
        classes = self.aligned.surface.index.classes
        return None if classes is None else classes[rows]

    def spread_rows(self, count: int) -> IntArray | None:
        """Return rows of about `count` evenly spread points that may be queries; None if there are too few."""
        aligned = self.aligned
        if aligned.inside.count < MIN_PAIRS:
            return None
        side = SPREAD_SIDE * extent(even_points(aligned.inside))
        if side == 0:
            return None
        index, inside = aligned.surface.index, aligned.inside
        corner = aligned.tiles.corners[0] if inside.lowest is None else inside.lowest
        picked = index.spread(side, aligned.region, corner)
        return index.numbers_of(*picked.select(voxel_thin_to(picked.points, count, side)))

    def lies_on(self, other: Side, within: float) -> bool:
        """Return whether every point lies within a distance of a point of the other cloud."""
        return self.farthest <= within

    def displaced(self, displacement: Displacement) -> TiledSurface:
        """Return the points after a displacement was removed."""
        return self.aligned.displaced(displacement)


def measure_floors(
    reference: AlignedCloud, candidate: AlignedCloud, forth: DistanceSums, spacing: float, seed: int
) -> tuple[Floors, Floors]:
    """Return the sampling floors of both directions, c→r and r→c.

    Args:
        reference: the reference.
        candidate: the aligned candidate.
        forth: sums of the distances c→r.
        spacing: spacing of the reference.
        seed: random seed.
    """
    surface = FloorSurface(
        reference.surface, spacing, reference.rounding(), reference.tiles.has_column(GIVEN_NORMALS), seed
    )
    extent_of_reference = robust_extent(reference.stored.even - reference.origin)
    clouds = reference.stored, candidate.stored
    is_negligible = all(cloud.quantisation.is_negligible(extent_of_reference) for cloud in clouds)
    rounding = None if is_negligible else candidate.rounding()
    queries = candidate.inside.pick(floors.even_sample(candidate.inside.count)).points
    to_reference = mean_values(floors.to_reference(surface, queries, rounding))
    score = forth.totals.by_cell.mean(PLANE_METRIC) if forth.totals.has_planes else forth.near.mean("square")
    error = error_share(score, to_reference[PLANE_METRIC])
    some = reference.inside.pick(floors.even_sample(reference.inside.count))
    rows = reference.surface.index.numbers_of(*some)

    def match(rows: IntArray) -> IntArray:
        points = candidate.surface.index.points[rows].reshape(-1, 3)
        closest = reference.surface.index.query(points).indices
        if reference.region is not None:
            closest[~reference.region.contains(points)] = -1
        return closest.reshape(rows.shape)

    to_candidate = floors.to_candidate(surface, rows, candidate.surface, match, error, rounding)
    return to_reference, mean_values(to_candidate)


def find_changes(reference: AlignedCloud, candidate: AlignedCloud) -> SeparatedChanges:
    """Find the changes between the complete clouds, as `pcbench.measure.pair.find_changes` does in memory."""
    return separate_changes(TiledSide.of(reference), TiledSide.of(candidate))


def split_into_budget(
    pair: TiledPair,
    directions: tuple[MeasuredDirection, MeasuredDirection],
    every_floor: tuple[Floors, Floors],
    deformation: Deformation,
    registration: Registration,
) -> DirectedBudget | None:
    """Return the budget of D2 in both directions; None if D2 is unknown.

    Args:
        pair: both clouds.
        directions: c→r and r→c.
        every_floor: their sampling floors.
        deformation: the deformation, whose white noise counts as noise.
        registration: registration of the candidate.
    """
    white = None if deformation.noise is None else deformation.noise.sigma_white
    budgets = []
    for direction, floors_of_direction in zip(directions, every_floor, strict=True):
        sums = direction.sums.budget_sums
        if sums is None or pair.frame is None or not direction.sums.totals.has_planes:
            return None
        budgets.append(budget(sums, pair.frame, floor=floors_of_direction[PLANE_METRIC], white=white))
    return DirectedBudget(budgets[0], budgets[1], registration.keeps_pose)


def assess_deformation(
    reference: AlignedCloud,
    candidate: AlignedCloud,
    registration: Registration,
    farthest: float,
    seed: int,
    changes: SeparatedChanges,
) -> Deformation:
    """Assess the deformation of the part that did not change, as in memory.

    Args:
        reference: the reference.
        candidate: the aligned candidate.
        registration: its registration.
        farthest: largest distance of its points from the reference.
        seed: random seed.
        changes: the changes.
    """
    stable = []
    for which, cloud in enumerate((reference, candidate)):
        region = StableRegion(cloud.region, PointLabels.of(changes, which))
        stable.append(cloud if changes.sampled.are_stable(which) else cloud.limited_to(region))
    sides = TiledSide.of(stable[0]), TiledSide.of(stable[1], farthest)
    return residual_deformation(*sides, registration, reference.origin, seed=seed)
