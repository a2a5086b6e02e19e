"""Comparison pipeline: register, match in both directions, measure and map each candidate against one reference."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pcbench.errors import InputError, Notice
from pcbench.geometry.arrays import bounds
from pcbench.geometry.cloud import Cloud, as_cloud
from pcbench.geometry.crs import check_lengths, crs_argument, crs_name, same_crs
from pcbench.geometry.mesh import Mesh
from pcbench.geometry.mesh_samples import sample_candidate, sampling_notice, vertex_cloud
from pcbench.measure import intervals, presets
from pcbench.measure.budget import consistent_with
from pcbench.measure.deviation import DeviationMap
from pcbench.measure.directions import Direction
from pcbench.measure.m3c2 import compare_along_normals, m3c2_warnings
from pcbench.measure.m3c2_settings import M3C2Settings
from pcbench.measure.offset import signed_offset
from pcbench.measure.pair import (
    AlignedCandidate,
    align,
    assess_deformation,
    find_changes,
    match_pair,
    measure_directions,
    split_into_budget,
)
from pcbench.measure.reference import Reference
from pcbench.measure.results import Candidate, CandidateComparisons, Difference
from pcbench.measure.scores import Measurement, measure
from pcbench.measure.settings import Settings
from pcbench.measure.summaries import summarize
from pcbench.progress import ProgressPlan
from pcbench.systems import peak_memory


def compare(
    reference: Cloud | Mesh | ArrayLike,
    candidates: Sequence[Cloud | Mesh | ArrayLike] | Mapping[str, Any] | Cloud | Mesh | NDArray[Any],
    settings: Settings | None = None,
    *,
    on_step: Callable[[str], None] | None = None,
) -> CandidateComparisons:
    """Compare candidate clouds with a reference.

    Args:
        reference: reference cloud; a mesh is sampled uniformly by area, with the normals of its faces.
        candidates: one cloud, several clouds, or several clouds by name. A mesh is sampled like the reference, more
            densely than the reference's points; `Settings.vertices` selects its vertices instead.
        settings: settings of the comparison; None: the defaults of `Settings`.
        on_step: progress callback, called with a short description before each slow step.

    Raises:
        InputError: a cloud, a setting or a region is not usable.
        RegistrationError: a candidate does not overlap the reference.
    """
    settings = Settings() if settings is None else settings
    if not isinstance(settings, Settings):
        raise InputError(f"expected settings as pcbench.Settings, got {type(settings).__name__}")
    if not isinstance(candidates, Cloud | Mesh | np.ndarray | Mapping | Sequence) or isinstance(candidates, str):
        raise InputError(f"expected one or several clouds as candidates, got {type(candidates).__name__}")
    if isinstance(candidates, Cloud | Mesh | np.ndarray):
        candidates = [candidates]
    named = (
        dict(candidates)
        if isinstance(candidates, Mapping)
        else {f"candidate_{number}": cloud for number, cloud in enumerate(candidates, 1)}
    )
    if not named:
        raise InputError("expected at least one candidate, got none")
    read = replace(settings, m3c2=settings.m3c2.read()) if isinstance(settings.m3c2, M3C2Settings) else settings
    given = reference if isinstance(reference, Mesh) else as_cloud(reference)
    shapes = {name: shape if isinstance(shape, Mesh) else as_cloud(shape) for name, shape in named.items()}
    for name, shape in {"the reference": given, **shapes}.items():
        check_lengths(shape, name)
    if settings.vertices:
        shapes = {name: vertex_cloud(shape) for name, shape in shapes.items()}
    clouds = {name: sample_candidate(shape, given, settings.seed) for name, shape in shapes.items()}
    step = ProgressPlan(on_step or (lambda _: None), expected_seconds(given, clouds, settings))

    step("indexing the reference")
    shared: dict[str, float] = {}
    with record_time(shared, "reference"):
        prepared = Reference.prepare(given, settings)
    for name in _poisson_maps(settings):
        step("reconstructing the reference's surface")
        prepared = prepared.with_poisson_mesh(name)
    results, measured = [], []
    for name, cloud in clouds.items():
        result, measurement = _compare_one(prepared, name, cloud, read, step)
        result = _with_mesh(result, shapes[name], prepared, settings)
        results.append(replace(result, timings_s={**result.timings_s, **shared}))
        measured.append(measurement)
    return CandidateComparisons(
        settings, prepared.summary(), tuple(results), tuple(differences(prepared.cells, results, measured))
    )


def _with_mesh(result: Candidate, shape: Cloud | Mesh, reference: Reference, settings: Settings) -> Candidate:
    """Return a result with the number of faces and a notice if the candidate is a sampled mesh."""
    if not isinstance(shape, Mesh):
        return result
    scale = result.registration.T_reference_candidate.scale
    spacing = None if reference.target.is_sampled else reference.spacing
    notice = sampling_notice(shape, result.points, settings.seed, scale=scale, spacing=spacing)
    return replace(result, faces=len(shape), warnings=(notice, *result.warnings))


def expected_seconds(reference: Cloud | Mesh, candidates: Mapping[str, Cloud], settings: Settings) -> list[float]:
    """Estimate the duration of each announced step, in seconds, for progress bars."""
    first = len(reference) / 1e6 if isinstance(reference, Cloud) else 1.0
    expected = [0.2 + 2 * first, *(20.0 + 30 * first for _ in _poisson_maps(settings))]
    for cloud in candidates.values():
        both = first + len(cloud) / 1e6
        m3c2_too = 5.0 + 5 * both if "m3c2" in settings.maps else 0.0
        expected += [0.3 + 3 * both, 0.1 + 0.5 * both, 0.2 + 1 * both + m3c2_too, 1.0 + 4 * both]
    return expected


def _poisson_maps(settings: Settings) -> list[str]:
    return [name for name in settings.maps if name.startswith("poisson")]


def _compare_one(
    reference: Reference, name: str, cloud: Cloud, settings: Settings, step: Callable[[str], None]
) -> tuple[Candidate, Measurement]:
    timings: dict[str, float] = {}
    step(f"{name}: registering")
    with record_time(timings, "registration"):
        aligned = align(reference, name, cloud, settings)
    step(f"{name}: matching both ways")
    with record_time(timings, "matching"):
        matched = match_pair(reference, aligned)
    step(f"{name}: measuring")
    with record_time(timings, "changes"):
        changes = find_changes(reference, aligned)
    with record_time(timings, "floors"):
        forth, back = measure_directions(reference, aligned, matched, settings.seed)
    with record_time(timings, "metrics"):
        thresholds = settings.thresholds or default_thresholds(reference.spacing)
        measurement = _measurement(reference, forth, back, thresholds)
    with record_time(timings, "maps"):
        deviation = _deviation_map(reference, aligned, forth, settings)
        completeness = DeviationMap(*reference.measured, {"distance": back.distances.to_points})
    with record_time(timings, "presets"):
        to_poisson = deviation.scalars.get("poisson_distance")
        pair = matched.pair
        if not measurement.metrics.d2_samples:
            pair = _with_normals(pair, reference)
        quoted = {key: presets.measure_preset(key, pair, thresholds, to_poisson) for key in settings.presets}
    step(f"{name}: testing for deformation")
    with record_time(timings, "deformation"):
        deformation = assess_deformation(reference, aligned, settings.seed, changes)
    with record_time(timings, "budget"):
        budget = split_into_budget(reference, aligned, matched, (forth, back), changes, deformation)
    if budget is not None:
        deformation = consistent_with(budget.accuracy, deformation)
    return Candidate(
        name=name,
        points=len(cloud),
        points_in_region=int(np.count_nonzero(aligned.inside)),
        registration=aligned.registration,
        metrics=replace(measurement.metrics, presets=quoted),
        deviation=deviation,
        completeness=completeness,
        deformation=deformation,
        timings_s=timings,
        peak_rss_bytes=peak_memory(),
        steps=tuple(cloud.quantisation.steps.tolist()),
        warnings=tuple(_warnings(reference, cloud, measurement, deviation)),
        budget=budget,
        changes=changes.shifted(reference.origin),
        offset=signed_offset(forth.distances, forth.cells, reference.cells),
    ), measurement


def default_thresholds(spacing: float) -> tuple[float, ...]:
    """Return the thresholds of the F-score for a reference of this spacing."""
    return tuple(factor * spacing for factor in (1.0, 2.0, 5.0) if spacing > 0)


def _measurement(reference: Reference, forth: Direction, back: Direction, thresholds: tuple[float, ...]) -> Measurement:
    summary = partial(
        summarize,
        thresholds=thresholds,
        cells=reference.cells,
        voxel=reference.voxel,
        corner=bounds(reference.measured_points)[0],
        origin=reference.origin,
    )
    return measure(summary(forth), summary(back), thresholds, cells=reference.cells)


def _warnings(
    reference: Reference, cloud: Cloud, measurement: Measurement, deviation: DeviationMap
) -> Iterator[Notice]:
    yield from crs_warnings(reference.cloud.crs, cloud.crs)
    yield from measurement.warnings
    if deviation.m3c2 is not None:
        yield from m3c2_warnings(deviation.m3c2)


def _deviation_map(
    reference: Reference, aligned: AlignedCandidate, forth: Direction, settings: Settings
) -> DeviationMap:
    """Compute the deviation maps of one candidate at its points inside the region.

    The distances to points and planes were already measured and are reused. Sampled ones make no map.
    """
    scalars, unsigned = {"distance": forth.distances.to_points}, {"distance"}
    if isinstance(forth.distances.to_planes, np.ndarray):
        scalars["plane_distance"] = forth.distances.to_planes
    for name, mesh in reference.meshes.items():
        if not mesh.supports_signed_distance:
            unsigned.add(name)
        scalars[name] = mesh.query(forth.points, signed=mesh.supports_signed_distance).distances
    along_normals = None
    if "m3c2" in settings.maps:
        how = settings.m3c2 if isinstance(settings.m3c2, M3C2Settings) else M3C2Settings()
        along_normals = compare_along_normals(reference, aligned.index, aligned.registration, how)
    return DeviationMap(
        forth.points + reference.origin, np.flatnonzero(aligned.inside), scalars, along_normals, frozenset(unsigned)
    )


def _with_normals(pair: presets.CroppedPair, reference: Reference) -> presets.CroppedPair:
    """Return a cropped pair with the reference's normals, computed and as given, if there are any."""
    rows, given = reference.rows, reference.cloud.normals
    normals = reference.surface.compute_normals(rows) if reference.has_normals else None
    if rows is not None:
        normals, given = (None if n is None else n[rows] for n in (normals, given))
    return pair._replace(normals=normals, raw_normals=given)


def differences(
    cells: intervals.CorrelationCells, results: Sequence[Candidate], measured: Sequence[Measurement]
) -> Iterator[Difference]:
    """Yield the paired difference a - b of each score, cell by cell: errors common to both candidates cancel."""
    for (a, of_a), (b, of_b) in combinations(zip(results, measured, strict=True), 2):
        apart = {
            name: intervals.LinearizedScore(one.value - other.value, one.influence - other.influence)
            for name, one in of_a.sampled.items()
            if (other := of_b.sampled.get(name)) is not None
        }
        spreads = intervals.spreads(apart, cells, 0.5 * (of_a.shares + of_b.shares))
        for name, score in apart.items():
            found = intervals.difference(score.value, spreads[name])
            yield Difference(a.name, b.name, name, score.value, found)


def crs_warnings(reference: str | None, candidate: str | None) -> Iterator[Notice]:
    """Yield a warning if the coordinate systems of two clouds differ."""
    if reference and candidate and not same_crs(reference, candidate):
        yield Notice(
            "other-crs",
            f"the candidate's coordinate system ({crs_name(candidate)}) is not the reference's"
            f" ({crs_name(reference)}): convert the candidate with pcbench convert FILE OUT --crs"
            f" {crs_argument(reference)}",
        )


@contextmanager
def record_time(timings: dict[str, float], name: str) -> Iterator[None]:
    """Store the seconds that a `with` block takes."""
    start = time.perf_counter()
    yield
    timings[name] = time.perf_counter() - start
