"""A cloud in tiles as a search index and as a surface: the same answers as in memory, from the points that matter.

What the assessment of two clouds asks of them are the neighbourhoods of some thousand places. The points nearest to
each place are searched in all tiles and kept. A later search is answered by the points that are kept if these certainly
include the result; otherwise, it is another place. So every answer is that of the complete cloud, to the last bit.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pcbench.deformation.displacement import Displacement
from pcbench.geometry.arrays import FloatArray, IntArray, bounds
from pcbench.geometry.neighbors import Index, LocalPlanes, Matches, is_kept
from pcbench.geometry.normals import Surface
from pcbench.geometry.regions import Region
from pcbench.geometry.sampling import Sampling, sampling_of
from pcbench.geometry.voxels import cells
from pcbench.measure.tiled.even import PickedPoints
from pcbench.measure.tiled.lattice import Lattice
from pcbench.measure.tiled.search import nearest_in_tiles
from pcbench.measure.tiled.tiles import CLASSES, TiledCloud, TileSummary, save_points
from pcbench.tasks import Task, TaskRunner
from pcbench.tasks.codec import fingerprint
from pcbench.tasks.results import read_shared, write_result

# Smallest number of points kept around a place, and their ratio to those asked for: closest points move while a
# deformation is followed.
_MIN_NEAR_POINTS, _NEAR_GROWTH = 16, 2
_PLACES_AT_ONCE = 4_096  # of a task
_MAX_GROWTH = 1.25  # of the points in memory, after which they are indexed again
_CENTERS = 4  # places nearest to a query that may show that its result is complete
_SLACK = 1e-9  # share of distances, far above their rounding


class NearPoints(NamedTuple):
    """Points of a cloud around places.

    Attributes:
        points: (N, 3) points.
        rows: (N,) their rows in the cloud, ascending.
        normals: (N, 3) their normals, if the cloud has any.
        variation: (N,) surface variation around them, if the cloud has it.
        classes: (N,) their LAS classes, if the cloud has any.
        reach: (M,) all points that are nearer to a place than this are among them.
        matches: the k nearest points of each place, with positions among these points.
    """

    points: FloatArray
    rows: IntArray
    normals: FloatArray | None
    variation: FloatArray | None
    classes: NDArray[np.uint8] | None
    reach: FloatArray
    matches: Matches


def near_points(file: Path, key: str, places: FloatArray, count: int, k: int) -> NearPoints:
    """Return the points nearest to places (M, 3).

    Args:
        file: the shared `TiledCloud` of the cloud, with at least `count` points.
        key: identifies its content.
        places: the places.
        count: number of points around each place.
        k: number of these points that are its matches.
    """
    cloud = read_shared(file, key, TiledCloud)
    matches = nearest_in_tiles(places, cloud, count)
    rows, first, positions = np.unique(matches.rows, return_index=True, return_inverse=True)

    def column(name: str) -> Any:
        shown = cloud.has_column(name)
        values = matches.column(cloud, name) if shown else None
        return None if values is None else values.reshape(-1, *values.shape[2:])[first]

    classes = column(CLASSES)
    reach = np.full(len(places), np.inf) if count == cloud.count else matches.distances[:, -1]
    return NearPoints(
        column("points"),
        rows,
        column(cloud.normals),
        column(cloud.variation),
        None if classes is None else classes.astype(np.uint8),
        reach,
        Matches(matches.distances[:, :k], positions.reshape(len(places), -1)[:, :k]),
    )


def thin_tile(file: Path, key: str, number: int, share: float, seed: int, folder: Path) -> TileSummary:
    """Store a random share of the points of a tile as a tile of another folder; see `pcbench.geometry.neighbors`."""
    cloud = read_shared(file, key, TiledCloud)
    rows = cloud.load(number, "rows")
    kept = np.flatnonzero(is_kept(rows, share, seed))
    if not len(kept):
        return TileSummary.empty(number)
    points = cloud.load(number, "points")[kept]
    save_points(folder, number, points, rows[kept])
    return TileSummary.of(number, points, points)


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
    classes = cloud.load(number, CLASSES) if cloud.file(number, CLASSES).exists() else None
    points = PickedPoints(cloud.load(number, "points"), cloud.load(number, "rows"), classes)
    if region is not None:
        points = points.select(np.flatnonzero(region.contains(points.points)))
    return points.select(cells(points.points, side, corner).first) if len(points.rows) else points


def displace_tile(file: Path, key: str, number: int, displacement: Displacement, folder: Path) -> TileSummary:
    """Store the points of a tile as a tile of another folder, after a displacement was removed."""
    cloud = read_shared(file, key, TiledCloud)
    points = cloud.load(number, "points")
    points = points - displacement(points)
    save_points(folder, number, points, cloud.load(number, "rows"))
    return TileSummary.of(number, points, points)


def every_of_tile(file: Path, key: str, number: int, step: int) -> PickedPoints:
    """Return the points of a tile whose rows in the cloud are multiples of a step."""
    cloud = read_shared(file, key, TiledCloud)
    rows = cloud.open(number, "rows")
    some = np.flatnonzero(rows % step == 0)
    return PickedPoints(cloud.open(number, "points").take(some, axis=0), rows.take(some), None)


class _KeptPoints(NamedTuple):
    """Points in memory, which answer queries near earlier ones.

    Attributes:
        tree: index of the points, in the order of rows, which decides between equal distances.
        numbers: (N,) numbers of these points.
        centers: index of the earlier queries.
        reach: all points of the cloud that are nearer to an earlier query than this are among them.
    """

    tree: Index
    numbers: IntArray
    centers: Index
    reach: FloatArray

    @classmethod
    def of(cls, points: FloatArray, order: IntArray, centers: FloatArray, reach: FloatArray) -> _KeptPoints:
        """Index points (N, 3), given their order by rows, and the queries (M, 3) with their reach (M,)."""
        return cls(Index(points[order]), order, Index(centers), reach)

    def query(self, places: FloatArray, k: int) -> tuple[Matches, NDArray[np.bool_]]:
        """Return the k nearest points (M, k) of places (M, 3), and whether none of the cloud is nearer (M,)."""
        matches = self.tree.query(places, k)
        distances = matches.distances.reshape(len(places), k)
        near = self.centers.query(places, min(_CENTERS, len(self.centers)))
        away, centers = (values.reshape(len(places), -1) for values in near)
        is_inside: NDArray[np.bool_] = (away + distances[:, -1:]) * (1 + _SLACK) < self.reach[centers]
        numbers = self.numbers[matches.indices.reshape(len(places), k)]
        return Matches(distances, numbers), np.asarray(is_inside.any(axis=1))


class TiledIndex(Index):
    """An index of a cloud in tiles, of which only the points around earlier queries are in memory.

    Numbers of points refer to `points`, to which searches append what they find; they are not the rows of the cloud.

    Args:
        cloud: the cloud in tiles.
        file: file for it, which tasks share.
        runner: runs the searches.
        stage: start of the names of the stages.
        key: identifies the cloud.
        is_reused: whether later queries are near to earlier ones, so that more points are kept than asked for.
    """

    def __init__(
        self,
        cloud: TiledCloud,
        file: Path,
        runner: TaskRunner,
        stage: str,
        key: str,
        *,
        is_reused: bool = True,
    ) -> None:
        self._is_reused = is_reused
        self._cloud, self._file = cloud, file
        self._runner, self._stage, self._key = runner, stage, key
        write_result(file, key, cloud)
        self.points = np.zeros((0, 3))
        self.rows = np.zeros(0, np.int64)
        self.normals: FloatArray | None = np.zeros((0, 3)) if cloud.has_column(cloud.normals) else None
        self.variation: FloatArray | None = np.zeros(0) if cloud.has_column(cloud.variation) else None
        self.classes: NDArray[np.uint8] | None = np.zeros(0, np.uint8) if cloud.has_column(CLASSES) else None
        self._order = np.zeros(0, np.int64)  # numbers in the order of rows
        self._centers, self._reach = np.zeros((0, 3)), np.zeros(0)
        self._kept_points: _KeptPoints | None = None
        self._searches = self._spreads = 0

    def __len__(self) -> int:
        """Return the number of points of the complete cloud."""
        return self._cloud.count

    @property
    def corner(self) -> FloatArray:
        """Lowest corner (3,) of the points."""
        corner: FloatArray = self._cloud.corners[0]
        return corner

    def every(self, step: int) -> FloatArray:
        """Return every `step`-th point (M, 3) of the complete cloud, from the first one on."""
        tasks, title = self._tile_tasks(step), "picking points"
        results = self._runner.run(f"{self._stage}-every-{step}", every_of_tile, tasks, key=self._key, title=title)
        parts = [picked for _, picked in results]
        order = np.argsort(np.concatenate([part.rows for part in parts]))
        points: FloatArray = np.concatenate([part.points for part in parts])[order]
        return points

    def thinned(self, share: float, seed: int) -> TiledIndex:
        """Return an index of a random share of the complete cloud; see `Index.thinned`."""
        name, key = f"{self._stage}-thinned", f"{self._key}{share}"
        cloud = self._other_tiles(name, key, thin_tile, share, seed)
        return TiledIndex(cloud, cloud.folder / "cloud.tiles", self._runner, name, key)

    def nearest_other(self) -> Matches:
        """Find the nearest other point of each point of the complete cloud, in the order of rows."""
        distances, numbers = self.query(self.every(1), 2)
        return Matches(distances[:, 1], numbers[:, 1])

    def neighbors_in_share(self, queries: FloatArray, k: int, share: float, seed: int) -> FloatArray:
        """Find neighbours as `Index.neighbors_in_share` does, in an index of the share."""
        return self._neighbors_in_thinned(queries, k, share, seed)

    def displaced(self, displacement: Displacement) -> TiledIndex:
        """Return an index of the cloud after a displacement was removed."""
        name, key = f"{self._stage}-displaced", f"{self._key}{fingerprint(displacement)}"
        cloud = self._other_tiles(name, key, displace_tile, displacement)
        file = cloud.folder / "cloud.tiles"
        return TiledIndex(cloud, file, self._runner, name, key, is_reused=False)

    def _other_tiles(self, name: str, key: str, function: Callable[..., TileSummary], *arguments: Any) -> TiledCloud:
        """Store points of all tiles as those of another cloud, which has no normals."""
        folder = self._file.with_suffix("") / name
        folder.mkdir(parents=True, exist_ok=True)
        tasks = self._tile_tasks(*arguments, folder)
        results = self._runner.run(name, function, tasks, key=key, title="preparing the assessment")
        summaries = {tile.number: tile for _, tile in results}
        every = (summaries.get(number) or TileSummary.empty(number) for number in range(len(self._cloud)))
        return replace(TiledCloud.of(folder, every), normals="")

    def _tile_tasks(self, *arguments: Any) -> list[Task]:
        return [
            Task(f"{number:06d}", (self._file, self._key, number, *arguments), int(self._cloud.counts[number]))
            for number in self._cloud.occupied
        ]

    def spread(self, side: float, region: Region | None, corner: FloatArray) -> PickedPoints:
        """Return the first point inside a region in each occupied cell of an edge length, counted from a corner."""
        self._spreads += 1
        stage, title = f"{self._stage}-spread-{self._spreads}", "spreading points evenly"
        tasks, key = self._tile_tasks(region, side, corner), f"{self._key}{side}{fingerprint(region)}"
        parts = [picked for _, picked in self._runner.run(stage, spread_tile, tasks, key=key, title=title)]
        rows = np.concatenate([part.rows for part in parts])
        order = np.argsort(rows)
        points, rows = np.concatenate([part.points for part in parts])[order], rows[order]
        classes = None
        if self.classes is not None:
            classes = np.concatenate([part.classes for part in parts if part.classes is not None])[order]
        del parts  # as much memory as the points
        picked = PickedPoints(points, rows, classes)
        return picked.select(cells(picked.points, side, corner).first)

    def first_in_cells(self, side: float, region: Region | None) -> IntArray:
        """Return the numbers of the first point inside a region in each occupied cell of an edge length.

        They are in the order of rows.
        """
        return self.numbers_of(*self.spread(side, region, self._cloud.corners[0]))

    def fresh(self, name: str) -> TiledIndex:
        """Return an index of the same cloud with no point in memory, for places far from each other.

        Args:
            name: what they are for, which is in the names of its stages.
        """
        stage = f"{self._stage}-{name}"
        return TiledIndex(self._cloud, self._file, self._runner, stage, self._key, is_reused=False)

    def numbers_of(self, points: FloatArray, rows: IntArray, classes: NDArray[np.uint8] | None) -> IntArray:
        """Return the numbers (M,) of points (M, 3) with these rows of the cloud, without their surroundings."""
        no_place = Matches(np.zeros((0, 1)), np.zeros((0, 1), np.int64))
        self._add([NearPoints(points, rows, None, None, classes, np.zeros(0), no_place)])
        return self._numbers(rows)

    def query(self, queries: ArrayLike, k: int = 1, hint: ArrayLike | None = None) -> Matches:
        """Find the k nearest points of each query (M, 3); see `Index.query`."""
        places = np.ascontiguousarray(queries, np.float64)
        matches = Matches(np.empty((len(places), k)), np.empty((len(places), k), np.int64))
        missing = np.arange(len(places))
        if self._is_reused and len(self._reach) and len(places):
            if self._kept_points is None or len(self.points) > _MAX_GROWTH * len(self._kept_points.numbers):
                self._kept_points = _KeptPoints.of(self.points, self._order, self._centers, self._reach)
            if len(self._kept_points.numbers) >= k:
                nearest, is_complete = self._kept_points.query(places, k)
                matches.distances[:], matches.indices[:] = nearest
                missing = np.flatnonzero(~is_complete)
        if len(missing):
            matches.distances[missing], matches.indices[missing] = self._load_around(places[missing], k)
        return Matches(matches.distances[:, 0], matches.indices[:, 0]) if k == 1 else matches

    def local_planes(self, k: int, rows: ArrayLike | None = None) -> LocalPlanes:
        """Fit planes to the k nearest points of the points with these numbers (M,); see `Index.local_planes`."""
        numbers = np.asarray(rows)
        near = self.query(self.points[numbers], k).indices
        every = np.unique(np.append(near.ravel(), numbers))
        every = every[np.argsort(self.rows[every])]
        positions = np.argsort(every)[np.searchsorted(np.sort(every), numbers)]
        planes = Index(self.points[every]).local_planes(k, positions)
        other = planes.nearest_other
        return planes._replace(nearest_other=Matches(other.distances, every[other.indices]))

    def _load_around(self, places: FloatArray, k: int) -> Matches:
        """Load the points around places (M, 3), and return the k nearest ones (M, k) of each."""
        count = min(max(_NEAR_GROWTH * k, _MIN_NEAR_POINTS) if self._is_reused else k, len(self))
        order = np.argsort(Lattice.around(*bounds(places)).codes(places), kind="stable")
        tasks = []
        for number, start in enumerate(range(0, len(order), _PLACES_AT_ONCE)):
            some = places[order[start : start + _PLACES_AT_ONCE]]
            tasks.append(Task(f"{number:06d}", (self._file, self._key, some, count, k), len(some)))
        self._searches += 1
        stage, key = f"{self._stage}-near-{self._searches}", f"{self._key}{fingerprint(places)}{count}-{k}"
        results = self._runner.run(stage, near_points, tasks, key=key, title="searching the surroundings of a sample")
        near = [part for _, part in results]
        self._add(near)
        if self._is_reused:
            self._centers = np.concatenate([self._centers, places[order]])
            self._reach = np.concatenate([self._reach, *(part.reach for part in near)])
        matches = Matches(np.empty((len(places), k)), np.empty((len(places), k), np.int64))
        rows = np.concatenate([part.rows[part.matches.indices] for part in near])
        matches.distances[order] = np.concatenate([part.matches.distances for part in near])
        matches.indices[order] = self._numbers(rows)
        return matches

    def _numbers(self, rows: IntArray) -> IntArray:
        """Return the numbers of points in memory with these rows of the cloud."""
        numbers: IntArray = self._order[np.searchsorted(self.rows, rows, sorter=self._order)]
        return numbers

    def _add(self, near: Sequence[NearPoints]) -> None:
        """Append the points that are not in memory, and keep the normals and the variation of those that are."""
        rows, first = np.unique(np.concatenate([part.rows for part in near]), return_index=True)

        def column(name: str) -> NDArray[Any] | None:
            parts = [getattr(part, name) for part in near]
            return None if any(part is None for part in parts) else np.concatenate(parts)[first]

        sorted_rows = self.rows[self._order]
        positions = np.minimum(np.searchsorted(sorted_rows, rows), max(len(sorted_rows) - 1, 0))
        is_loaded = sorted_rows[positions] == rows if len(sorted_rows) else np.zeros(len(rows), bool)
        loaded, new = self._order[positions[is_loaded]], np.flatnonzero(~is_loaded)
        for name in ("normals", "variation"):
            kept, values = getattr(self, name), column(name)
            if kept is None:
                continue
            if values is None:
                values = np.full((len(rows), *kept.shape[1:]), np.nan)
            else:
                kept[loaded] = values[is_loaded]
            setattr(self, name, np.concatenate([kept, values[new]]))
        if self.classes is not None and (classes := column("classes")) is not None:
            self.classes = np.concatenate([self.classes, classes[new]])
        if not len(new):
            return
        points = column("points")
        assert points is not None
        self.points = np.concatenate([self.points, points[new]])
        self.rows = np.concatenate([self.rows, rows[new]])
        self._order = np.argsort(self.rows, kind="stable")


class TiledSurface(Surface):
    """A cloud in tiles as a surface: normals and surface variation at points around earlier queries.

    Args:
        index: its index.
        k: number of neighbours from which a normal is estimated.
        sampling: its sampling if it is known.
    """

    index: TiledIndex

    def __init__(self, index: TiledIndex, k: int = 20, sampling: Sampling | None = None) -> None:
        self.index = index
        if sampling is not None:
            self.sampling = sampling
        self._positions, self._is_even = k, False
        self._is_complete = index.normals is not None
        self._fitted = np.zeros(0, bool)
        # Of fitted planes, with the precision of those in memory.
        self._fits: dict[str, NDArray[Any]] = {"normals": np.zeros((0, 3)), "variation": np.zeros(0, np.float32)}

    @cached_property
    def sampling(self) -> Sampling:
        """Sampling of the complete cloud; what it is measured from does not stay in memory."""
        return sampling_of(self.index.fresh("sampling"))

    def normals(self, rows: IntArray) -> FloatArray:
        """Return unit normals (M, 3) at the points with these numbers (M,): those of the cloud, or estimated ones."""
        return self._stored_or_fitted("normals", rows)

    def variation(self, rows: IntArray) -> FloatArray:
        """Return surface variation (M,) at the points with these numbers (M,)."""
        return self._stored_or_fitted("variation", rows).astype(np.float64)

    def _stored_or_fitted(self, name: str, rows: IntArray) -> FloatArray:
        """Return a column of the cloud at the points with these numbers (M,), or its values from planes fitted here."""
        if getattr(self.index, name) is None:
            self._fit(rows)
            fitted: FloatArray = self._fits[name][rows]
            return fitted
        values: FloatArray = getattr(self.index, name)[rows]
        if (unknown := np.isnan(values.reshape(len(rows), -1)[:, 0])).any():  # only the points are in memory
            copies = min(_MIN_NEAR_POINTS, len(self.index))  # at one position, of which the first may be another one
            self.index.query(self.index.points[rows[unknown]], copies)
            values = getattr(self.index, name)[rows]
            if (unknown := np.isnan(values.reshape(len(rows), -1)[:, 0])).any():  # too many points at one position
                self._fit(rows[unknown])
                values[unknown] = self._fits[name][rows[unknown]]
        return values

    @property
    def corner(self) -> FloatArray:
        """Lowest corner (3,) of the points."""
        return self.index.corner

    def first_in_cells(self, side: float, region: Region | None = None) -> IntArray:
        """Return the numbers of the first point inside a region in each occupied cell of an edge length."""
        return self.index.first_in_cells(side, region)

    def _fit(self, rows: IntArray) -> None:
        """Fit planes at the points with these numbers (M,) unless they are known."""
        more = len(self.index.points) - len(self._fitted)
        self._fitted = np.append(self._fitted, np.zeros(more, bool))
        for name, values in self._fits.items():
            self._fits[name] = np.concatenate([values, np.full((more, *values.shape[1:]), np.nan, values.dtype)])
        missing = np.unique(rows[~self._fitted[rows]])
        if len(missing):
            planes = self.index.local_planes(self.k, missing)
            self._fits["normals"][missing], self._fits["variation"][missing] = planes.normals, planes.variation
            self._fitted[missing] = True
