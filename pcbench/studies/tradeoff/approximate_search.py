"""A comparison whose closest points are approximate: the steps of `pcbench.comparison` with scipy's tree."""

from __future__ import annotations

from functools import partial

import numpy as np

from pcbench.deformation import Side, residual_deformation
from pcbench.errors import InputError
from pcbench.geometry.arrays import FloatArray, bounds
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.mesh import Mesh
from pcbench.geometry.neighbors import Index, Matches
from pcbench.geometry.normals import Surface
from pcbench.measure.deviation import DeviationMap
from pcbench.measure.directions import from_candidate, from_reference
from pcbench.measure.reference import Reference
from pcbench.measure.results import Candidate
from pcbench.measure.scores import measure
from pcbench.measure.settings import Settings
from pcbench.measure.summaries import summarize
from pcbench.registration import register
from pcbench.systems import peak_memory


def compare_by_approximate_search(
    given: Cloud | Mesh, candidate: Cloud, settings: Settings, excess: float
) -> Candidate:
    """Compare a candidate, without presets and maps, by points that need not be the closest.

    Each match is at most 1 + `excess` times as far as the closest point (Arya et al. 1998). Registration, floors and
    the test for deformation search exactly.

    Raises:
        InputError: the settings have a region.
        RegistrationError: the clouds do not overlap.
    """
    reference = Reference.prepare(given, settings)
    if reference.region is not None:
        raise InputError("expected a comparison without a region, got one: approximate search needs complete clouds")
    registration = register(reference.cloud, candidate, settings.register, target=reference.target)
    index = Index(registration.T_local.apply(candidate.points - reference.origin))
    to_reference = _approximate_matches(reference.points, index.points, excess)
    to_candidate = _approximate_matches(index.points, reference.points, excess)
    forth = from_candidate(reference, index.points, to_reference, seed=settings.seed)
    surface = Surface(index, is_even=False)
    back = from_reference(reference, surface, to_reference.indices, to_candidate, forth=forth, seed=settings.seed)
    thresholds = settings.thresholds or ()
    summary = partial(
        summarize,
        thresholds=thresholds,
        cells=reference.cells,
        voxel=reference.voxel,
        corner=bounds(reference.points)[0],
        origin=reference.origin,
    )
    measurement = measure(summary(forth), summary(back), thresholds, cells=reference.cells)
    inside = np.ones(len(index), bool)
    ours = Side(reference.surface, reference.inside, reference.cloud)
    theirs = Side(surface, inside, candidate)
    return Candidate(
        name="candidate",
        points=len(candidate),
        points_in_region=len(candidate),
        registration=registration,
        metrics=measurement.metrics,
        deviation=DeviationMap(
            forth.points + reference.origin, np.arange(len(index)), {"distance": to_reference.distances}
        ),
        completeness=DeviationMap(*reference.measured, {"distance": to_candidate.distances}),
        deformation=residual_deformation(ours, theirs, registration, reference.origin, seed=settings.seed),
        timings_s={},
        peak_rss_bytes=peak_memory(),
        steps=tuple(candidate.quantisation.steps.tolist()),
    )


def _approximate_matches(points: FloatArray, queries: FloatArray, excess: float) -> Matches:
    from scipy.spatial import cKDTree

    distances, indices = cKDTree(points).query(queries, eps=excess)
    return Matches(np.asarray(distances), np.asarray(indices, np.int64))
