"""Registration of clouds on disk, from samples at full density."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from pcbench.errors import Notice, RegistrationError
from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.transform import Similarity
from pcbench.measure.metrics import Distances, plane_distances
from pcbench.measure.offset import SignedOffset, signed_offset
from pcbench.measure.pair import align
from pcbench.measure.reference import Reference
from pcbench.measure.results import ReferenceSummary
from pcbench.measure.settings import Settings
from pcbench.measure.tiled import windows
from pcbench.measure.tiled.prepared import TiledReference
from pcbench.measure.tiled.steps import Steps
from pcbench.measure.tiled.stored import StoredCloud
from pcbench.measure.tiled.sums import GroupSums
from pcbench.registration import (
    FeatureSettings,
    IcpSettings,
    Registration,
    as_method,
    register,
)

_MAX_SHARE_DIFFERENCE = 0.1  # of the points on the reference, between the sample and all points
_MAX_RMS_RATIO = 1.5  # of the distances to planes of these points
UNREPRESENTATIVE_SAMPLE = "sample-differs"
"""Code of the warning that the pose fits all points worse than the sample from which it was found."""


@dataclass(frozen=True)
class NearFit:
    """Fit of points to the reference: share within the overlap distance, and RMS distance of these to planes."""

    share: float
    plane_rms: float | None

    @classmethod
    def of(cls, reference: Reference, points: FloatArray, overlap_distance: float) -> NearFit:
        """Measure the fit of points (M, 3)."""
        distances, closest = reference.index.query(points)
        near = np.flatnonzero(distances <= overlap_distance)
        rms = None
        if reference.has_normals and len(near):
            normals = reference.surface.normals(closest[near])
            planes = np.einsum("ni,ni->n", points[near] - reference.points[closest[near]], normals)
            rms = float(np.sqrt(np.mean(np.square(planes))))
        return cls(len(near) / len(points), rms)

    @classmethod
    def of_sums(cls, near: GroupSums, count: int) -> NearFit:
        """Return the fit of `count` queries from the sums over those within the overlap distance."""
        rms = math.sqrt(near.mean("square")) if near.count else None
        return cls(near.count / count, rms)

    def warning(self, of_all: NearFit) -> Notice | None:
        """Return a warning if all points fit clearly worse than this sample."""
        worse = self.plane_rms and of_all.plane_rms and of_all.plane_rms > _MAX_RMS_RATIO * self.plane_rms
        if self.share - of_all.share <= _MAX_SHARE_DIFFERENCE and not worse:
            return None
        spread = "" if not worse else f", {of_all.plane_rms:.3g} off its planes instead of {self.plane_rms:.3g}"
        return Notice(
            UNREPRESENTATIVE_SAMPLE,
            f"the pose was found on a sample of which {self.share:.0%} lies on the reference; of all points"
            f" {of_all.share:.0%} do{spread}: check the registration where the map shows large distances",
        )


@dataclass(frozen=True, eq=False)
class SampleResults:
    """Registration from samples of a reference and a candidate.

    Attributes:
        registration: the registration, with `T_local` between coordinates minus the local origin of the reference.
        offset: signed offset from the reference's surface; None without normals.
        near: fit of the sample, to compare with that of all points; None if the sample is all points.
        reference: the reference's sample in short: its normals and warnings.
    """

    registration: Registration
    offset: SignedOffset | None
    near: NearFit | None
    reference: ReferenceSummary


def find_pose(reference: Cloud, candidate: Cloud, name: str, settings: Settings) -> Similarity:
    """Return the pose of a candidate from evenly thinned clouds, to be refined at full density.

    Raises:
        RegistrationError: the clouds do not overlap.
    """
    given = settings.known_pose
    if given is not None and settings.initial is None:
        return given
    try:
        return register(reference, candidate, settings.register, initial=settings.initial).T_reference_candidate
    except RegistrationError as error:
        raise RegistrationError(f"{name}: {error}") from error


def refine_settings(settings: Settings, pose: Similarity) -> Settings:
    """Return settings that refine a pose by ICP, or that assess a given one, with the method's residuals and scale."""
    method = as_method(settings.register)
    if isinstance(method, FeatureSettings):
        return replace(settings, register=IcpSettings(with_scale=method.with_scale), initial=pose)
    if isinstance(method, IcpSettings):
        return replace(settings, initial=pose)
    return settings


def register_on_disk(
    steps: Steps, reference: TiledReference, stage: str, name: str, cloud: StoredCloud
) -> SampleResults:
    """Register a candidate: small clouds as they are, larger ones thinned, then in windows at full density."""
    if reference.complete is not None:
        steps.report(f"{name}: registering")
        complete = windows.complete_cloud(cloud)
        return register_samples(reference.complete, complete, name, steps.settings, reference.origin, is_complete=True)
    steps.report(f"{name}: registering thinned clouds")
    stored, thinned = reference.stored, cloud.thinned
    pose = find_pose(stored.thinned, thinned, name, steps.settings)
    places = pose.apply(cloud.even)
    region = None if reference.region is None else reference.region.shifted(-reference.origin)
    if region is not None and (inside := region.contains(places)).any():
        places = places[inside]
    chosen = windows.Windows.of(stored, places, cloud.count)
    step = windows.thinning_step(cloud, chosen, pose)
    sample = windows.candidate_in_windows(cloud, chosen, pose, step, steps.runner, f"{stage}-sample", steps.key)
    steps.report(f"{name}: registering")
    settings = replace(refine_settings(steps.settings, pose), crop="none")
    if sample is None:  # the candidate has few points, or does not overlap the reference
        prepared = Reference.prepare(stored.thinned, settings)
        return register_samples(prepared, thinned, name, settings, reference.origin, is_complete=False)
    sampled, aligned = windows.reference_in_windows(stored, chosen), pose.apply(sample.points)
    # The region may be smaller than a window, and few windows may have no points in their inner parts.
    for limit in (None, region):
        inner = windows.WindowRegion(chosen, limit, np.zeros(3))
        if inner.contains(sampled.points).any() and inner.contains(aligned).any():
            settings = replace(settings, crop=inner)
    prepared = Reference.prepare(sampled, settings)
    return register_samples(prepared, sample, name, settings, reference.origin, is_complete=False)


def register_samples(
    reference: Reference, candidate: Cloud, name: str, settings: Settings, origin: FloatArray, *, is_complete: bool
) -> SampleResults:
    """Register the samples of two clouds.

    Args:
        reference: the prepared sample of the reference.
        candidate: sample of the candidate.
        name: name of the candidate.
        settings: the settings, for samples as from `refine_settings`.
        origin: (3,) local origin of the complete reference.
        is_complete: whether the samples are all points.
    """
    aligned = align(reference, name, candidate, settings)
    registration, points = aligned.registration, aligned.index.points[aligned.inside]
    offset = _offset(reference, points)
    if is_complete:
        return SampleResults(registration, offset, None, reference.summary())
    registration = replace(registration, T_local=registration.T_reference_candidate.about(-origin))
    near = NearFit.of(reference, points, registration.overlap_distance)
    return SampleResults(registration, offset, near, reference.summary())


def _offset(reference: Reference, points: FloatArray) -> SignedOffset | None:
    """Return the signed offset of aligned points (M, 3) of a sample; None if there are too few points for normals."""
    if not reference.has_normals:
        return None
    distances, closest = reference.index.query(points)
    normals = reference.surface.compute_normals(closest)
    planes = plane_distances(points, reference.points, normals, closest_rows=closest, normal_rows=closest)
    return signed_offset(Distances(distances, planes), reference.cells.of_point[closest], reference.cells)
