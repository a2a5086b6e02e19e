"""The pipeline: register, match both ways, measure, map; one reference against any number of candidates."""

from __future__ import annotations

import resource
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pcbench.deformation import Deformation, Side, residual_deformation
from pcbench.errors import InputError, RegistrationError
from pcbench.geometry.arrays import FloatArray, IntArray, bounds
from pcbench.geometry.cloud import Cloud, as_cloud
from pcbench.geometry.crs import crs_name, same_crs
from pcbench.geometry.mesh import Mesh, MeshIndex
from pcbench.geometry.neighbors import Index, Matches
from pcbench.geometry.normals import Surface
from pcbench.geometry.regions import Region, parse_region
from pcbench.geometry.voxels import robust_extent, voxel_downsample_to
from pcbench.measure import intervals, metrics, presets
from pcbench.measure.deviation import DeviationMap, m3c2
from pcbench.measure.scores import Direction, Floor, measure, value_of
from pcbench.registration import Registration, Target, local_origin, register

MAPS = ("poisson", "m3c2")

_VOXELS_ALONG = 50  # of the scene's extent: the cells of area weighting
_MESH_SAMPLES = 1_000_000  # points that stand for a mesh as the reference
_POISSON_POINTS = 400_000  # that a Poisson mesh is made from: well under a minute
_CORES = 50_000  # M3C2 core points: the reference, thinned evenly
_CYLINDER_RADIUS = 6  # median spacings of the sparser cloud: about 30 of its points a cylinder
_CYLINDER_REACH = 1  # radii to either side: farther ones meet the other side of a house


@dataclass(frozen=True)
class Settings:
    """What a user may change; stored with every result.

    Attributes:
        register: how candidates are aligned, see `pcbench.registration.METHODS`.
        crop: which part is measured, see `pcbench.geometry.regions.parse_region`.
        thresholds: of the F-score, in the clouds' unit; None: 1, 2 and 5 times the reference's median spacing.
        presets: locked definitions to report beside ours; `gao2025` and `mpeg` are always there.
        maps: deviation maps beside those to the nearest point and to the tangent plane: `poisson` (to a Poisson mesh of
            the reference) and `m3c2`.
        seed: of the bootstrap.
        normal_neighbors: points a normal of the reference is estimated from where the file has none.
        classes, returns: which points of LAS files count, see `pcbench.read_cloud`.
    """

    register: str = "icp"
    crop: str = "none"
    thresholds: tuple[float, ...] | None = None
    presets: tuple[str, ...] = ("gao2025", "mpeg")
    maps: tuple[str, ...] = ()
    seed: int = 0
    normal_neighbors: int = 20
    classes: tuple[int, ...] | None = None
    returns: str | tuple[int, ...] | None = None

    def __post_init__(self) -> None:
        for name, text in (("register", self.register), ("crop", self.crop)):
            if not isinstance(text, str):
                raise InputError(f"expected {name} as text, got {text!r}")
        if self.thresholds is not None:
            object.__setattr__(self, "thresholds", tuple(dict.fromkeys(_positive(self.thresholds))))
        if not _is_whole(self.seed) or self.seed < 0:
            raise InputError(f"expected the seed as a whole number >= 0, got {self.seed!r}")
        if not _is_whole(self.normal_neighbors) or not 3 <= self.normal_neighbors <= 1000:
            raise InputError(f"expected 3 to 1000 neighbours for a normal, got {self.normal_neighbors!r}")
        if unknown := [name for name in self.presets if name not in presets.NAMES]:
            raise InputError(f"unknown preset {unknown[0]!r}: expected one of {', '.join(presets.NAMES)}")
        if unknown := [name for name in self.maps if name not in MAPS]:
            raise InputError(f"unknown map {unknown[0]!r}: expected {' or '.join(MAPS)}")
        always = [name for name in ("gao2025", "mpeg") if name not in self.presets]
        object.__setattr__(self, "presets", (*always, *dict.fromkeys(self.presets)))


def _positive(values: Any) -> list[float]:
    try:
        numbers = [] if isinstance(values, str) else [float(v) for v in values]
    except (TypeError, ValueError, OverflowError):
        numbers = []
    if not numbers or not all(np.isfinite(v) and v > 0 for v in numbers):
        raise InputError(f"expected positive thresholds, got {values!r}")
    return numbers


def _is_whole(value: Any) -> bool:
    return isinstance(value, int | np.integer) and not isinstance(value, bool)


@dataclass(frozen=True, eq=False)
class Candidate:
    """Everything measured about one candidate. `metrics` is documented in the README (comparison.json)."""

    name: str
    points: int
    points_in_region: int
    registration: Registration
    metrics: dict[str, Any]
    deviation: DeviationMap
    deformation: Deformation
    timings_s: dict[str, float]
    peak_rss_bytes: int
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class Comparison:
    """A reference, its candidates, and the differences between them."""

    settings: Settings
    reference: dict[str, Any]
    candidates: tuple[Candidate, ...]
    differences: list[dict[str, Any]] = field(default_factory=list)


def compare(
    reference: Cloud | Mesh | ArrayLike,
    candidates: Sequence[Cloud | ArrayLike] | Mapping[str, Cloud] | Mapping[str, ArrayLike] | Cloud | NDArray[Any],
    settings: Settings | None = None,
    *,
    on_step: Callable[[str], None] | None = None,
) -> Comparison:
    """Compare candidate clouds with a reference.

    Args:
        reference: what is taken as truth; a mesh is sampled by area, with its faces' normals.
        candidates: one cloud, several, or several by name.
        settings: see `Settings`.
        on_step: called with a few words before every step that takes time.

    Raises:
        InputError: a cloud, a setting or a region is not usable.
        RegistrationError: a candidate does not overlap the reference.
    """
    settings = Settings() if settings is None else settings
    if not isinstance(settings, Settings):
        raise InputError(f"expected settings as pcbench.Settings, got {type(settings).__name__}")
    if not isinstance(candidates, Cloud | np.ndarray | Mapping | Sequence) or isinstance(candidates, str):
        raise InputError(f"expected one or several clouds as candidates, got {type(candidates).__name__}")
    if isinstance(candidates, Cloud | np.ndarray):
        candidates = [candidates]
    named = (
        dict(candidates)
        if isinstance(candidates, Mapping)
        else {f"candidate_{number}": cloud for number, cloud in enumerate(candidates, 1)}
    )
    if not named:
        raise InputError("expected at least one candidate, got none")
    step = on_step or (lambda _: None)

    step("indexing the reference")
    shared: dict[str, float] = {}
    with _timed(shared, "reference"):
        truth = _Reference.prepare(reference if isinstance(reference, Mesh) else as_cloud(reference), settings)
    if "poisson" in settings.maps:
        step("reconstructing the reference's surface")
        truth = truth.with_poisson_mesh()
    results, replicates = [], []
    for name, cloud in named.items():
        result, means = _compare_one(truth, name, as_cloud(cloud), settings, step)
        result.timings_s.update(shared)
        results.append(result)
        replicates.append(means)
    return Comparison(settings, truth.describe(), tuple(results), _differences(results, replicates))


@dataclass(frozen=True, eq=False)
class _Reference:
    """The reference, recentred, with all that every candidate needs, computed once."""

    cloud: Cloud
    origin: FloatArray
    target: Target  # of registrations
    region: Region | None  # in recentred coordinates
    inside: NDArray[np.bool_]
    rows: IntArray | None  # of the points inside; None for all
    nearest_other: Matches | None
    spacing: float
    blocks: intervals.Blocks
    voxel: float
    meshes: Mapping[str, MeshIndex]  # by the name of the map, recentred

    @classmethod
    def prepare(cls, given: Cloud | Mesh, settings: Settings) -> _Reference:
        cloud = given.sample(_MESH_SAMPLES, settings.seed) if isinstance(given, Mesh) else given
        origin = local_origin(cloud)
        points = cloud.points - origin
        region = parse_region(settings.crop, cloud)
        region = None if region is None else region.shifted(origin)
        inside = np.ones(len(points), bool) if region is None else region.contains(points)
        if not inside.any():
            raise InputError(f"the crop {settings.crop!r} leaves none of the reference's {len(points)} points")
        surface = Surface(Index(points), settings.normal_neighbors, cloud.normals)
        rows = None if region is None else np.flatnonzero(inside)
        if len(surface) >= 3:
            surface.with_normals_at(rows)  # all that D2 needs: registration takes what it wants from them
        nearest_other = surface.nearest_other() if len(surface) > 1 else None
        return cls(
            cloud=cloud,
            origin=origin,
            target=Target(surface),
            region=region,
            inside=inside,
            rows=rows,
            nearest_other=nearest_other,
            # Of a cloud that was merged with itself the nearest other points are twins: those do not count then.
            spacing=0.0 if nearest_other is None else float(np.median(nearest_other.distances)) or surface.spacing,
            blocks=intervals.partition(points, settings.seed),
            voxel=robust_extent(points if rows is None else points[rows]) / _VOXELS_ALONG or 1.0,
            meshes={"mesh_distance": MeshIndex(given.shifted(origin))} if isinstance(given, Mesh) else {},
        )

    def with_poisson_mesh(self) -> _Reference:
        """The same with a Poisson mesh of the (thinned) reference to measure distances to.

        Raises:
            InputError: the reference is too small for normals.
        """
        from pcbench.geometry.poisson import oriented, poisson_mesh

        if not self.has_normals:
            raise InputError("expected at least 3 reference points for the map `poisson`: it needs normals")
        rows = voxel_downsample_to(self.points, _POISSON_POINTS, start=self.spacing)
        cloud = Cloud(self.points[rows], normals=self.surface.normals(rows))
        mesh = poisson_mesh(cloud if self.cloud.normals is not None else oriented(cloud))
        return replace(self, meshes={**self.meshes, "poisson_distance": MeshIndex(mesh)})

    @property
    def surface(self) -> Surface:
        return self.target.surface

    @property
    def index(self) -> Index:
        return self.surface.index

    @property
    def points(self) -> FloatArray:
        return self.surface.points

    @property
    def measured_points(self) -> FloatArray:
        """Those inside the region."""
        return self.points if self.rows is None else self.points[self.rows]

    @property
    def has_normals(self) -> bool:
        return len(self.points) >= 3 or self.surface.is_complete

    def describe(self) -> dict[str, Any]:
        return {
            "points": len(self.points),
            "points_in_region": int(np.count_nonzero(self.inside)),
            "spacing_median": self.spacing,
            "crs": self.cloud.crs,
            "unit": self.cloud.unit,
            "normals": "given" if self.cloud.normals is not None else "estimated" if self.has_normals else None,
            "faces": len(self.meshes["mesh_distance"].mesh.faces) if "mesh_distance" in self.meshes else None,
            "block_side": self.blocks.side,
            "voxel_side": self.voxel,
        }


def _compare_one(
    truth: _Reference, name: str, cloud: Cloud, settings: Settings, step: Callable[[str], None]
) -> tuple[Candidate, dict[str, FloatArray]]:
    timings: dict[str, float] = {}

    step(f"{name}: registering")
    with _timed(timings, "registration"):
        try:
            registration = register(truth.cloud, cloud, settings.register, target=truth.target)
        except RegistrationError as error:
            raise RegistrationError(f"{name}: {error}") from error
        aligned = registration.T_local.apply(cloud.points - truth.origin)
        inside = np.ones(len(aligned), bool) if truth.region is None else truth.region.contains(aligned)
        if not inside.any():
            raise InputError(f"{name}: the crop {settings.crop!r} leaves none of its {len(aligned)} points")
        queries = aligned if truth.region is None else aligned[inside]

    step(f"{name}: matching both ways")
    with _timed(timings, "matching"):
        index = Index(aligned)
        pair = _hard_pair(truth, index, inside)
        if truth.region is None:
            forth, back = pair.to_reference, pair.to_candidate
        else:
            forth, back = truth.index.query(queries), index.query(truth.measured_points)

    step(f"{name}: measuring")
    with _timed(timings, "floors"):
        candidate_to_reference = _from_candidate(truth, queries, forth)
        reference_to_candidate = _from_reference(truth, index, forth, back)
    with _timed(timings, "metrics"):
        thresholds = settings.thresholds or tuple(f * truth.spacing for f in (1.0, 2.0, 5.0) if truth.spacing > 0)
        values, replicates = measure(
            candidate_to_reference,
            reference_to_candidate,
            thresholds,
            block_weights=truth.blocks.weights,
            voxel=truth.voxel,
            corner=bounds(truth.measured_points)[0],
            origin=truth.origin,
        )
    with _timed(timings, "maps"):
        deviation = _deviation_map(truth, index, candidate_to_reference, registration, settings)
    step(f"{name}: looking for a bend")
    with _timed(timings, "deformation"):
        sides = Side(truth.surface, truth.inside, truth.cloud), Side(Surface(index), inside, cloud)
        deformation = residual_deformation(*sides, registration, truth.origin, seed=settings.seed)
    with _timed(timings, "presets"):
        to_poisson = deviation.scalars.get("poisson_distance")
        values["presets"] = _presets(truth, pair, to_poisson, settings.presets, thresholds)

    result = Candidate(
        name=name,
        points=len(cloud),
        points_in_region=int(np.count_nonzero(inside)),
        registration=registration,
        metrics=values,
        deviation=replace(deviation, rows=np.flatnonzero(inside)),
        deformation=deformation,
        timings_s=timings,
        peak_rss_bytes=_peak_rss(),
        warnings=tuple(_crs_warnings(truth.cloud, cloud)),
    )
    return result, replicates


def _deviation_map(
    truth: _Reference, candidate: Index, forth: Direction, registration: Registration, settings: Settings
) -> DeviationMap:
    """All maps of one candidate; the distances to points and planes are those that were measured already."""
    scalars = {"distance": forth.distances}
    if forth.plane is not None:
        scalars["plane_distance"] = forth.plane
    for name, mesh in truth.meshes.items():
        scalars[name] = mesh.query(forth.points, signed=mesh.has_inside).distances
    along_normals = None
    if "m3c2" in settings.maps and truth.has_normals:
        radius = _CYLINDER_RADIUS * max(truth.spacing, Surface(candidate).spacing)
        rows = np.flatnonzero(truth.inside)
        rows = rows[voxel_downsample_to(truth.points[rows], _CORES, start=radius / 2)]
        error = registration.weakest_sigma
        along_normals = m3c2(
            truth.index,
            candidate,
            truth.points[rows],
            truth.surface.normals(rows),
            radius=radius,
            half_length=_CYLINDER_REACH * radius,
            registration_error=registration.rmse if error is None else error,
        ).shifted(-truth.origin)
    return DeviationMap(forth.points + truth.origin, np.empty(0, np.int64), scalars, along_normals)


def _from_candidate(truth: _Reference, queries: FloatArray, matches: Matches) -> Direction:
    """Candidate -> reference. Floor: leave-one-out distances inside the reference at the matched places."""
    distances, feet = matches
    n = truth.surface.with_normals_at(feet) if truth.has_normals else None
    plane = None if n is None else metrics.plane_distances(queries, truth.points, n, feet_rows=feet, normal_rows=feet)
    floor = Floor()
    if truth.nearest_other is not None:
        other = truth.nearest_other.indices[feet]
        floor_plane = None
        if n is not None:
            n, a = truth.surface.with_normals_at(other), truth.points
            floor_plane = metrics.plane_distances(a, a, n, query_rows=feet, feet_rows=other, normal_rows=other)
        floor = Floor.of(truth.nearest_other.distances[feet], floor_plane)
    return Direction(queries, distances, plane, floor, truth.blocks.of_point[feet])


def _from_reference(truth: _Reference, index: Index, forth: Matches, back: Matches) -> Direction:
    """Reference -> candidate. Floor: distances to the pseudo-candidate of the matched reference points."""
    rows, queries = truth.rows, truth.measured_points
    chosen = np.zeros(len(truth.points), bool)
    chosen[forth.indices] = True
    pseudo = Index(truth.points[chosen])
    floor, nearest = pseudo.nearest_of(truth.index) if rows is None else pseudo.query(queries)
    plane = floor_plane = None
    if truth.has_normals:
        n = truth.surface.with_normals_at(rows)
        plane = metrics.plane_distances(queries, index.points, n, feet_rows=back.indices, normal_rows=rows)
        floor_plane = metrics.plane_distances(queries, pseudo.points, n, feet_rows=nearest, normal_rows=rows)
    blocks = truth.blocks.of_point if rows is None else truth.blocks.of_point[rows]
    return Direction(queries, back.distances, plane, Floor.of(floor, floor_plane), blocks)


def _hard_pair(truth: _Reference, candidate: Index, inside: NDArray[np.bool_]) -> presets.Pair:
    """Both clouds cut to the region: where there is none, matched as they are."""
    normals, given = truth.surface.with_normals_at(truth.rows) if truth.has_normals else None, truth.cloud.normals
    if truth.rows is None:
        return presets.match(truth.index, candidate, truth.nearest_other, normals, given)
    normals, given = (None if n is None else n[truth.rows] for n in (normals, given))
    reference = Index(truth.measured_points)
    nearest_other = reference.nearest_other() if len(reference) > 1 else None
    return presets.match(reference, Index(candidate.points[inside]), nearest_other, normals, given)


def _presets(
    truth: _Reference,
    pair: presets.Pair,
    to_poisson: FloatArray | None,
    names: tuple[str, ...],
    thresholds: tuple[float, ...],
) -> dict[str, Any]:
    known: dict[str, Callable[[], dict[str, Any]]] = {
        "gao2025": lambda: presets.gao2025(pair, to_poisson),
        "mpeg": lambda: presets.mpeg(pair),
        "open3d": lambda: presets.open3d(pair, thresholds),
        "pdal": lambda: presets.pdal(pair),
        "tnt": lambda: presets.tnt(pair, thresholds),
    }
    return {name: known[name]() for name in names}


def _differences(results: list[Candidate], replicates: list[dict[str, FloatArray]]) -> list[dict[str, Any]]:
    """Is a better than b? Every mean's difference a - b with its interval over the same replicates."""
    rows = []
    for (a, of_a), (b, of_b) in combinations(zip(results, replicates, strict=True), 2):
        for metric in of_a:
            if metric in of_b:
                difference = value_of(a.metrics, metric) - value_of(b.metrics, metric)
                ci = intervals.interval(of_a[metric] - of_b[metric])
                rows.append({"a": a.name, "b": b.name, "metric": metric, "difference": difference, "ci": ci})
    return rows


def _crs_warnings(reference: Cloud, candidate: Cloud) -> Iterator[str]:
    if reference.crs and candidate.crs and not same_crs(reference.crs, candidate.crs):
        yield (
            f"the candidate's coordinate system ({crs_name(candidate.crs)}) is not the reference's"
            f" ({crs_name(reference.crs)}): nothing was converted"
        )


@contextmanager
def _timed(timings: dict[str, float], name: str) -> Iterator[None]:
    start = time.perf_counter()
    yield
    timings[name] = time.perf_counter() - start


def _peak_rss() -> int:
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit
