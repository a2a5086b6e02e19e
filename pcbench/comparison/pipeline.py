"""The steps of a comparison: register, match in both directions, measure and map each candidate.

`in_memory` and `in_tiles` compute them.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import NamedTuple, Protocol

from pcbench.changes import Changes
from pcbench.deformation import Deformation
from pcbench.errors import Notice
from pcbench.geometry.crs import crs_argument, crs_name, same_crs, without_heights
from pcbench.measure.budget import consistent_with
from pcbench.measure.deviation import DeviationMap
from pcbench.measure.differences import paired_differences
from pcbench.measure.intervals import CorrelationCells
from pcbench.measure.offset import SignedOffset
from pcbench.measure.own_metrics import OwnResults
from pcbench.measure.presets import Preset
from pcbench.measure.results import Candidate, Difference, DirectedBudget
from pcbench.measure.scores import Measurement, measure
from pcbench.measure.summaries import DirectionSummary
from pcbench.registration import Registration
from pcbench.systems import peak_memory
from pcbench.threads import one_blas_thread


class PreparedReference(Protocol):
    """The reference with all that its candidates share."""

    @property
    def crs(self) -> str | None:
        """Coordinate system, if known."""

    @property
    def thresholds(self) -> tuple[float, ...]:
        """Distance thresholds of the F-score."""

    @property
    def correlation_cells(self) -> CorrelationCells:
        """Correlation cells of the intervals."""

    def register(self, name: str) -> AlignedPair:
        """Align the candidate of that name.

        Raises:
            InputError: no aligned point lies in the region.
            RegistrationError: the clouds do not overlap.
        """


class AlignedPair(Protocol):
    """A candidate aligned with the reference. Each result is computed from those before it, at its first use."""

    @property
    def registration(self) -> Registration:
        """Registration of the candidate."""

    @property
    def points(self) -> int:
        """Number of points of the candidate."""

    @property
    def points_in_region(self) -> int:
        """Number of aligned points inside the region."""

    @property
    def faces(self) -> int | None:
        """Number of faces if the candidate is a mesh, whose points are samples."""

    @property
    def steps(self) -> tuple[float, ...]:
        """Steps in which the candidate's own x, y and z are rounded."""

    @property
    def crs(self) -> str | None:
        """Coordinate system of the candidate, if known."""

    @property
    def sampling_notices(self) -> Sequence[Notice]:
        """Notices of how the candidate's points were made."""

    def match(self) -> None:
        """Prepare the search of closest points in both directions, inside the region."""

    @property
    def changes(self) -> Changes:
        """Changes between the complete clouds, in the reference's coordinates."""

    def measure_distances(self) -> None:
        """Measure the distances of both directions."""

    def summaries(self) -> tuple[DirectionSummary, DirectionSummary]:
        """Return all that the metrics need to know about the distances c→r and r→c, with their sampling floors."""

    def maps(self) -> tuple[DeviationMap, DeviationMap]:
        """Return the deviation map and the completeness map."""

    def presets(self, deviation: DeviationMap) -> Mapping[str, Preset]:
        """Return the metrics as other tools define them, by name."""

    def own_metrics(self) -> OwnResults:
        """Return the user-defined metrics."""

    def release_matches(self) -> None:
        """Release what only the metrics and maps need, which takes as much memory as the points."""

    def assess_deformation(self) -> Deformation:
        """Assess the deformation of the part that did not change."""

    def split_into_budget(self, deformation: Deformation) -> DirectedBudget | None:
        """Return what D2 consists of; None if it is unknown or estimated from a sample."""

    @property
    def offset(self) -> SignedOffset | None:
        """Signed offset from the reference's surface; None without normals."""

    @property
    def censored(self) -> Mapping[str, float]:
        """Share of the points of each direction beyond the maximum distance; empty if there is no maximum."""

    def warnings(self, deviation: DeviationMap) -> Sequence[Notice]:
        """Return the warnings of this back end about the results."""


class ComparedCandidates(NamedTuple):
    """The results of all candidates, and the differences between them."""

    candidates: tuple[Candidate, ...]
    differences: tuple[Difference, ...]


@one_blas_thread()
def compare_candidates(
    reference: PreparedReference,
    names: Sequence[str],
    preparation_s: float,
    step: Callable[[str], None],
    *,
    tests_deformation: bool,
) -> ComparedCandidates:
    """Compare candidates with a prepared reference.

    Args:
        reference: the reference.
        names: names of the candidates.
        preparation_s: seconds that the preparation of the reference took.
        step: called with a short text before each step that takes time.
        tests_deformation: whether to test the candidates for deformation.

    Raises:
        InputError: no point of a candidate lies in the region.
        RegistrationError: a candidate does not overlap the reference.
    """
    candidates, measurements = [], []
    for name in names:
        candidate, measurement = _compare_one(reference, name, step, tests_deformation=tests_deformation)
        candidates.append(replace(candidate, timings_s={**candidate.timings_s, "reference": preparation_s}))
        measurements.append(measurement)
    differences = paired_differences(reference.correlation_cells, dict(zip(names, measurements, strict=True)))
    return ComparedCandidates(tuple(candidates), tuple(differences))


def _compare_one(
    reference: PreparedReference, name: str, step: Callable[[str], None], *, tests_deformation: bool
) -> tuple[Candidate, Measurement]:
    timings: dict[str, float] = {}
    step(f"{name}: registering")
    with record_time(timings, "registration"):
        pair = reference.register(name)
    step(f"{name}: matching both ways")
    with record_time(timings, "matching"):
        pair.match()
    step(f"{name}: measuring")
    with record_time(timings, "changes"):
        changes = pair.changes
    with record_time(timings, "distances"):
        pair.measure_distances()
    with record_time(timings, "metrics"):
        forth, back = pair.summaries()
        measurement = measure(forth, back, reference.thresholds, cells=reference.correlation_cells)
    with record_time(timings, "maps"):
        deviation, completeness = pair.maps()
    with record_time(timings, "presets"):
        presets = pair.presets(deviation)
    with record_time(timings, "own_metrics"):
        own = pair.own_metrics()
    pair.release_matches()
    deformation = Deformation.not_tested()
    if tests_deformation:
        step(f"{name}: testing for deformation")
        with record_time(timings, "deformation"):
            deformation = pair.assess_deformation()
    with record_time(timings, "budget"):
        budget = pair.split_into_budget(deformation)
    if budget is not None:
        deformation = consistent_with(budget.accuracy, deformation)
    candidate = Candidate(
        name=name,
        points=pair.points,
        points_in_region=pair.points_in_region,
        registration=pair.registration,
        metrics=replace(measurement.metrics, presets=presets, own=own.by_name),
        deviation=deviation,
        completeness=completeness,
        deformation=deformation,
        timings_s=timings,
        peak_rss_bytes=peak_memory(),
        steps=pair.steps,
        warnings=(
            *pair.sampling_notices,
            *crs_warnings(reference.crs, pair.crs),
            *measurement.warnings,
            *changes.warnings,
            *pair.warnings(deviation),
            *own.warnings,
        ),
        censored=pair.censored,
        offset=pair.offset,
        faces=pair.faces,
        budget=budget,
        changes=changes,
    )
    return candidate, measurement


def crs_warnings(reference: str | None, candidate: str | None) -> Iterator[Notice]:
    """Yield a warning if the coordinate systems of two clouds differ."""
    if not (reference and candidate) or same_crs(reference, candidate):
        return
    planes = without_heights(reference), without_heights(candidate)
    if same_crs(*planes) and (reference == planes[0] or candidate == planes[1]):
        lacking, stating, crs = "candidate", "reference", reference
        if reference == planes[0]:
            lacking, stating, crs = "reference", "candidate", candidate
        yield Notice(
            "other-crs",
            f"the datum of the {lacking}'s heights is not stated, the {stating} is in {crs_name(crs)}: if their heights"
            f" have one datum, state it with pcbench convert FILE OUT --crs {crs_argument(crs)}",
        )
    else:
        yield Notice(
            "other-crs",
            f"the candidate's coordinate system ({crs_name(candidate)}) is not the reference's"
            f" ({crs_name(reference)}): convert the candidate with pcbench convert FILE OUT --to-crs"
            f" {crs_argument(reference)}",
        )


@contextmanager
def record_time(timings: dict[str, float], name: str) -> Iterator[None]:
    """Store the seconds that a `with` block takes."""
    start = time.perf_counter()
    yield
    timings[name] = time.perf_counter() - start
