"""Sampling floors and deformation of two aligned clouds in tiles: those of memory, from the points that matter."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pcbench.deformation import Deformation, Side, residual_deformation
from pcbench.deformation.pairs import MIN_PAIRS, SPREAD_SIDE, extent
from pcbench.geometry.arrays import FloatArray, IntArray
from pcbench.geometry.quantisation import PlacedQuantisation
from pcbench.geometry.regions import Region
from pcbench.geometry.sampling import Sampling
from pcbench.geometry.transform import Similarity
from pcbench.geometry.voxels import cells, robust_extent, voxel_thin_to
from pcbench.measure import floors
from pcbench.measure.directions import PLANE_METRIC, error_share, mean_values
from pcbench.measure.floors import FloorSurface
from pcbench.measure.tiled.directions import DistanceSums
from pcbench.measure.tiled.even import PickedPoints, Picker, PlacedRuns, even_points
from pcbench.measure.tiled.nearby import TiledIndex, TiledSurface
from pcbench.measure.tiled.stored import StoredCloud
from pcbench.measure.tiled.tiles import GIVEN_NORMALS, TiledCloud
from pcbench.registration import Registration
from pcbench.tasks import Task, TaskRunner
from pcbench.tasks.results import read_shared

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
        lowest: (3,) lowest coordinates of the points inside the region.
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
    lowest: FloatArray
    runner: TaskRunner
    stage: str
    key: str
    file: Path
    normal_neighbors: int = 20
    known_sampling: Sampling | None = None

    @cached_property
    def surface(self) -> TiledSurface:
        """Its points and normals."""
        picker = self._picker(None, "rows")
        index = TiledIndex(self.tiles, self.file, picker, self.runner, self.stage, self.key)
        return TiledSurface(index, self.normal_neighbors, self.known_sampling)

    @cached_property
    def inside(self) -> Picker:
        """Picks points inside the region."""
        return self._picker(self.region, "inside")

    def _picker(self, region: Region | None, name: str) -> Picker:
        placed = PlacedRuns(self.stored.runs, self.origin, self.pose, region)
        return Picker.of(placed, self.runner, f"{self.stage}-{name}", self.key)

    def rounding(self) -> PlacedQuantisation:
        """Return how the points are rounded, in local coordinates."""
        shift = Similarity(np.eye(3), -self.origin)
        return PlacedQuantisation(self.stored.quantisation, shift if self.pose is None else self.pose @ shift)


@dataclass(frozen=True, eq=False)
class TiledSide(Side):
    """One cloud of the pair of the test for deformation.

    Attributes:
        aligned: the cloud.
    """

    aligned: AlignedCloud

    @classmethod
    def of(cls, aligned: AlignedCloud) -> TiledSide:
        """Return the side of a cloud."""
        return cls(aligned.surface, np.zeros(0, bool), aligned.stored.thinned, aligned)

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
        index = aligned.surface.index  # which has stored the tiles in their file
        tasks = [
            Task(
                f"{number:06d}",
                (aligned.file, aligned.key, number, aligned.region, side, aligned.lowest),
                int(aligned.tiles.counts[number]),
            )
            for number in aligned.tiles.occupied
        ]
        title = "spreading points evenly"
        results = aligned.runner.run(f"{aligned.stage}-spread", spread_tile, tasks, key=aligned.key, title=title)
        found = [tile for _, tile in results if len(tile.rows)]
        rows = np.concatenate([tile.rows for tile in found])
        order = np.argsort(rows)
        rows, points = rows[order], np.concatenate([tile.points for tile in found])[order]
        first = cells(points, side, aligned.lowest).first
        first = first[voxel_thin_to(points[first], count, side)]
        classes = None
        if index.classes is not None:
            classes = np.concatenate([tile.classes for tile in found if tile.classes is not None])[order][first]
        return index.numbers_of(rows[first], points[first], classes)


def spread_tile(
    file: Path, key: str, number: int, region: Region | None, side: float, corner: FloatArray
) -> PickedPoints:
    """Return the first point of a tile in each cell of an edge length, counted from a corner.

    Args:
        file: the shared `TiledCloud` of the cloud.
        key: identifies its content.
        number: number of the tile.
        region: measured region in local coordinates; None: everything.
        side: edge length of a cell.
        corner: (3,) origin of the cells.
    """
    cloud = read_shared(file, key, TiledCloud)
    classes = cloud.load(number, "classes") if cloud.file(number, "classes").exists() else None
    found = PickedPoints(cloud.load(number, "points"), cloud.load(number, "rows"), classes)
    if region is not None:
        found = found.select(np.flatnonzero(region.contains(found.points)))
    return found.select(cells(found.points, side, corner).first) if len(found.rows) else found


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
    rows = reference.surface.index.numbers_of(some.rows, some.points, some.classes)

    def match(rows: IntArray) -> IntArray:
        points = candidate.surface.index.points[rows].reshape(-1, 3)
        closest = reference.surface.index.query(points).indices
        if reference.region is not None:
            closest[~reference.region.contains(points)] = -1
        return closest.reshape(rows.shape)

    found = floors.to_candidate(surface, rows, candidate.surface, match, error, rounding)
    return to_reference, mean_values(found)


def assess_deformation(
    reference: AlignedCloud, candidate: AlignedCloud, registration: Registration, seed: int
) -> Deformation:
    """Assess deformation, as `pcbench.measure.pair.assess_deformation` does in memory."""
    sides = TiledSide.of(reference), TiledSide.of(candidate)
    return residual_deformation(*sides, registration, reference.origin, seed=seed)
