"""The pipeline: register, match both ways, measure, map; one reference against any number of candidates."""

from __future__ import annotations

import resource
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pcbench.deformation import Side, residual_deformation
from pcbench.errors import InputError, Notice, RegistrationError
from pcbench.geometry.arrays import IntArray, bounds
from pcbench.geometry.cloud import Cloud, as_cloud
from pcbench.geometry.crop import points_inside
from pcbench.geometry.crs import crs_name, same_crs
from pcbench.geometry.mesh import Mesh
from pcbench.geometry.neighbors import Index
from pcbench.geometry.normals import Surface
from pcbench.measure import intervals, presets
from pcbench.measure.deviation import DeviationMap
from pcbench.measure.directions import Direction, from_candidate, from_reference
from pcbench.measure.m3c2 import M3C2Settings, compare_along_normals, m3c2_warnings
from pcbench.measure.reference import Reference
from pcbench.measure.results import Candidate, CandidateComparisons, Difference
from pcbench.measure.scores import Measurement, measure
from pcbench.measure.settings import Settings
from pcbench.progress import Plan
from pcbench.registration import Registration, register


def compare(
    reference: Cloud | Mesh | ArrayLike,
    candidates: Sequence[Cloud | ArrayLike] | Mapping[str, Cloud] | Mapping[str, ArrayLike] | Cloud | NDArray[Any],
    settings: Settings | None = None,
    *,
    on_step: Callable[[str], None] | None = None,
) -> CandidateComparisons:
    """Compare candidate clouds with a reference.

    Args:
        reference: what is compared with; a mesh is sampled by area, with its faces' normals.
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
    read = replace(settings, m3c2=settings.m3c2.read()) if isinstance(settings.m3c2, M3C2Settings) else settings
    clouds = {name: as_cloud(cloud) for name, cloud in named.items()}
    given = reference if isinstance(reference, Mesh) else as_cloud(reference)
    step = Plan(on_step or (lambda _: None), expected_seconds(given, clouds, settings))

    step("indexing the reference")
    shared: dict[str, float] = {}
    with _timed(shared, "reference"):
        prepared = Reference.prepare(given, settings)
    if "poisson" in settings.maps:
        step("reconstructing the reference's surface")
        prepared = prepared.with_poisson_mesh()
    results, measured = [], []
    for name, cloud in clouds.items():
        result, measurement = _compare_one(prepared, name, cloud, read, step)
        results.append(replace(result, timings_s={**result.timings_s, **shared}))
        measured.append(measurement)
    return CandidateComparisons(
        settings, prepared.summary(), tuple(results), tuple(_differences(prepared, results, measured))
    )


def expected_seconds(reference: Cloud | Mesh, candidates: Mapping[str, Cloud], settings: Settings) -> list[float]:
    """Of each step that is announced, roughly, for progress bars."""
    first = len(reference) / 1e6 if isinstance(reference, Cloud) else 1.0
    expected = [0.2 + 2 * first, *([20.0 + 30 * first] if "poisson" in settings.maps else [])]
    for cloud in candidates.values():
        both = first + len(cloud) / 1e6
        m3c2_too = 5.0 + 5 * both if "m3c2" in settings.maps else 0.0
        expected += [0.3 + 3 * both, 0.1 + 0.5 * both, 0.2 + 1 * both + m3c2_too, 1.0 + 4 * both]
    return expected


def _compare_one(
    reference: Reference, name: str, cloud: Cloud, settings: Settings, step: Callable[[str], None]
) -> tuple[Candidate, Measurement]:
    timings: dict[str, float] = {}

    step(f"{name}: registering")
    with _timed(timings, "registration"):
        try:
            registration = register(
                reference.cloud, cloud, settings.register, initial=settings.initial, target=reference.target
            )
        except RegistrationError as error:
            raise RegistrationError(f"{name}: {error}") from error
        aligned = registration.T_local.apply(cloud.points - reference.origin)
        inside = points_inside(aligned, reference.region, settings.crop, f"{name}'s")
        queries = aligned if reference.region is None else aligned[inside]

    step(f"{name}: matching both ways")
    with _timed(timings, "matching"):
        index = Index(aligned)
        pair = _hard_pair(reference, index, inside)
        if reference.region is None:
            forth, back = pair.to_reference, pair.to_candidate
        else:
            forth, back = reference.index.query(queries), index.query(reference.measured_points)

    step(f"{name}: measuring")
    with _timed(timings, "floors"):
        accuracy = from_candidate(reference, queries, forth)
        matched = np.full(len(cloud), -1)
        matched[inside] = forth.indices
        completeness = from_reference(reference, index, matched, back, forth=accuracy, seed=settings.seed)
    with _timed(timings, "metrics"):
        spacing = reference.spacing
        thresholds = settings.thresholds or tuple(f * spacing for f in (1.0, 2.0, 5.0) if spacing > 0)
        measurement = measure(
            accuracy,
            completeness,
            thresholds,
            cells=reference.cells,
            voxel=reference.voxel,
            corner=bounds(reference.measured_points)[0],
            origin=reference.origin,
        )
    with _timed(timings, "maps"):
        deviation = _deviation_map(reference, index, np.flatnonzero(inside), accuracy, registration, settings)
        missing = DeviationMap(*reference.measured, {"distance": completeness.distances.to_points})
    step(f"{name}: looking for a bend")
    with _timed(timings, "deformation"):
        sides = Side(reference.surface, reference.inside, reference.cloud), Side(Surface(index), inside, cloud)
        deformation = residual_deformation(*sides, registration, reference.origin, seed=settings.seed)
    with _timed(timings, "presets"):
        to_poisson = deviation.scalars.get("poisson_distance")
        presented = {name: presets.measure_preset(name, pair, thresholds, to_poisson) for name in settings.presets}

    result = Candidate(
        name=name,
        points=len(cloud),
        points_in_region=int(np.count_nonzero(inside)),
        registration=registration,
        metrics=replace(measurement.metrics, presets=presented),
        deviation=deviation,
        completeness=missing,
        deformation=deformation,
        timings_s=timings,
        peak_rss_bytes=_peak_rss(),
        warnings=(
            *_crs_warnings(reference.cloud, cloud),
            *measurement.warnings,
            *(() if deviation.m3c2 is None else m3c2_warnings(deviation.m3c2)),
        ),
    )
    return result, measurement


def _deviation_map(
    reference: Reference,
    candidate: Index,
    measured: IntArray,
    forth: Direction,
    registration: Registration,
    settings: Settings,
) -> DeviationMap:
    """All maps of one candidate at its points inside the region, the rows `measured` (M,); the distances to points and
    planes are those that were measured already.
    """
    scalars = {"distance": forth.distances.to_points}
    if forth.distances.to_planes is not None:
        scalars["plane_distance"] = forth.distances.to_planes
    for name, mesh in reference.meshes.items():
        scalars[name] = mesh.query(forth.points, signed=mesh.has_inside).distances
    along_normals = None
    if "m3c2" in settings.maps:
        how = settings.m3c2 if isinstance(settings.m3c2, M3C2Settings) else M3C2Settings()
        along_normals = compare_along_normals(reference, candidate, registration, how)
    return DeviationMap(forth.points + reference.origin, measured, scalars, along_normals)


def _hard_pair(reference: Reference, candidate: Index, inside: NDArray[np.bool_]) -> presets.CroppedPair:
    """Both clouds cut to the region: where there is none, matched as they are."""
    rows, given = reference.rows, reference.cloud.normals
    normals = reference.surface.with_normals_at(rows) if reference.has_normals else None
    if rows is None:
        return presets.match(reference.index, candidate, reference.nearest_other, normals, given)
    normals, given = (None if n is None else n[rows] for n in (normals, given))
    cut = Index(reference.measured_points)
    nearest_other = cut.nearest_other() if len(cut) > 1 else None
    return presets.match(cut, Index(candidate.points[inside]), nearest_other, normals, given)


def _differences(
    reference: Reference, results: Sequence[Candidate], measured: Sequence[Measurement]
) -> Iterator[Difference]:
    """Every score's difference a - b, cell by cell: what both have in common is no doubt about it."""
    for (a, of_a), (b, of_b) in combinations(zip(results, measured, strict=True), 2):
        apart = {
            name: intervals.Sampled(one.value - other.value, one.influence - other.influence)
            for name, one in of_a.sampled.items()
            if (other := of_b.sampled.get(name)) is not None
        }
        spreads = intervals.spreads(apart, reference.cells, 0.5 * (of_a.shares + of_b.shares))
        for name, score in apart.items():
            found = intervals.difference(score.value, spreads[name])
            yield Difference(a.name, b.name, name, score.value, found)


def _crs_warnings(reference: Cloud, candidate: Cloud) -> Iterator[Notice]:
    if reference.crs and candidate.crs and not same_crs(reference.crs, candidate.crs):
        yield Notice(
            "other-crs",
            f"the candidate's coordinate system ({crs_name(candidate.crs)}) is not the reference's"
            f" ({crs_name(reference.crs)}): nothing was converted",
        )


@contextmanager
def _timed(timings: dict[str, float], name: str) -> Iterator[None]:
    start = time.perf_counter()
    yield
    timings[name] = time.perf_counter() - start


def _peak_rss() -> int:
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit
