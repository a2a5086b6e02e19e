"""The verdict on two aligned clouds."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from pcbench.deformation.answer import describe
from pcbench.deformation.breaks import find_offset_parts
from pcbench.deformation.displacement import projected_share
from pcbench.deformation.field import local_changes
from pcbench.deformation.pairs import MIN_PAIRS, Pairs, Side, extent, find_pairs, tile_sums
from pcbench.deformation.result import POSE_NOT_FIXED, Deformation
from pcbench.deformation.verdict import Finding, PairEvidence, decide
from pcbench.errors import Notice
from pcbench.geometry.arrays import FloatArray, rounding_of
from pcbench.geometry.crs import euclidean_offsets
from pcbench.registration import Registration
from pcbench.registration.result import UNOBSERVABLE

_RESOLUTION_SPACINGS = 5e-3  # smallest deformation, in spacings of the points of the tangent planes
_MIN_GAIN_SHARE = 0.1  # of the median distance, by which the assumed deformation brings the clouds closer
_MAX_MOVED_SHARE = 0.1  # of the cells; if more moved, they are not exceptions
_MIN_MOVED_SIGMAS = 3.0  # displacement of a moved cell, in standard deviations of a pair's noise
_MAX_REMOVALS = 3
_MAX_ROUGH_SHARE = 0.9  # of the pairs; a city sampled at metres consists mostly of corners and edges
_MIN_INLIER_SHARE = 0.85
_MAX_DISTANCE_SPACINGS = 1.25  # median distance of closest points
_MIN_MAP_COORDINATE = 1e5  # larger coordinates look like those of a map
_EARTH_RADIUS_M = 6.37e6
_DOUBTFUL_REGISTRATION = "doubtful-registration"


def residual_deformation(
    reference: Side, candidate: Side, registration: Registration, origin: FloatArray, *, seed: int = 0
) -> Deformation:
    """Return the deformation between two registered clouds.

    Args:
        reference: the reference, in its coordinates minus `origin`.
        candidate: the registered candidate, in the same coordinates.
        registration: the registration of the candidate; a scale that it estimated is no deformation.
        origin: (3,) the local origin.
        seed: random seed for the folds of cross-validation.
    """
    pairs = find_pairs(reference, candidate)
    if pairs is None or np.count_nonzero(pairs.weights) < MIN_PAIRS or extent(pairs.places[pairs.weights > 0]) == 0:
        count = 0 if pairs is None else int(np.count_nonzero(pairs.weights))
        text = f"{count} pairs of points are too few to distinguish a deformation from noise"
        return Deformation.without_evidence(Notice("few-pairs", text))
    pairs, notes = _without_map_projection(pairs, reference, candidate, registration, origin)
    metric = reference.is_metric and candidate.is_metric and not registration.solved_scale
    resolution = _RESOLUTION_SPACINGS * pairs.spacing
    complete = [PairEvidence.of(tile_sums(pairs))]
    views = [without_moved(complete[0], resolution)]
    finding = decide(views, metric=metric, resolution=resolution)
    if finding.verdict != "none":
        # The deformation must also appear without having been assumed.
        unassumed = find_pairs(reference, candidate, follow=False)
        if unassumed is not None:
            unassumed, _ = _without_map_projection(unassumed, reference, candidate, registration, origin)
            complete.append(PairEvidence.of(tile_sums(unassumed)))
            views.append(without_moved(complete[1], resolution))
            finding = decide(views, metric=metric, resolution=resolution)
            if finding.verdict == "none" and pairs.distance < (1 - _MIN_GAIN_SHARE) * unassumed.distance:
                text = "an assumed deformation brings the clouds closer, but closest points alone do not show it"
                finding = finding.undecided(Notice("pairs-disagree", text))
    if finding.verdict == "undecided" and pairs.rough > _MAX_ROUGH_SHARE:
        text = f"{pairs.rough:.0%} of the pairs are on rough surface, where displacements cannot be observed"
        finding = finding.undecided(Notice("rough-places", text))
    offset_parts = find_offset_parts(views[-1])
    if offset_parts is not None:
        finding = finding.undecided(Notice("parts-displaced", offset_parts.text(origin)))
    finding = _with_registration(finding, registration, pairs)
    # A deformation is described by the pairs found under it; if these were wrong, the other pairs are right.
    index = -1 if finding.verdict == "none" else 0
    described, whole = views[index], complete[index]
    answer = describe(described, finding, resolution=resolution, seed=seed)
    if described is not whole:
        answer = answer.with_changes(describe(whole, finding, resolution=resolution, seed=seed))
    if finding.verdict == "undecided" and finding.warnings[0].code in (_DOUBTFUL_REGISTRATION, POSE_NOT_FIXED):
        answer = answer.without_sizes()
    answer = answer.without_rounding(rounding_of(reference.surface.points, origin))
    return answer.shifted(origin).with_warnings(notes)


def without_moved(whole: PairEvidence, resolution: float) -> PairEvidence:
    """Return the evidence without the few cells that moved separately, which would distort a smooth model."""
    view, min_cells = whole, (1 - _MAX_MOVED_SHARE) * len(whole.sums.counts)
    for _ in range(_MAX_REMOVALS):  # more moved cells appear after the first are removed
        changed, length, _ = local_changes(view.geometry, view.noise, view.sums, resolution)
        moved = changed & (length > _MIN_MOVED_SIGMAS * math.sqrt(view.noise.white + view.noise.correlated))
        if not moved.any():
            break
        if len(moved) - np.count_nonzero(moved) < min_cells:
            return whole
        view = PairEvidence.of(view.sums.without(moved))
    return view


def _with_registration(finding: Finding, registration: Registration, pairs: Pairs) -> Finding:
    """Return the finding, undecided if the registration is doubtful or does not determine the pose."""
    if registration.doubtful:
        text = "the registration is doubtful: see its warnings"
        return finding.undecided(Notice(_DOUBTFUL_REGISTRATION, text))
    if pairs.inliers < _MIN_INLIER_SHARE and pairs.distance > _MAX_DISTANCE_SPACINGS * pairs.spacing:
        text = (
            f"{1 - pairs.inliers:.0%} of the closest points do not belong together, and the clouds are farther apart"
            " than their spacing explains: register them (--register icp), unless much has changed"
        )
        return finding.undecided(Notice("not-registered", text))
    if UNOBSERVABLE in {notice.code for notice in registration.warnings}:
        if finding.verdict in ("similarity", "affine", "non-affine") and registration.converged is not None:
            text = (
                "the geometry does not determine the pose, and the apparent deformation may be a slip: see the"
                " registration's warnings; a known pose would settle it (--register matrix:FILE)"
            )
            return finding.undecided(Notice(POSE_NOT_FIXED, text))
        notice = Notice(POSE_NOT_FIXED, "as far as the geometry determines the pose")
        return finding._replace(warnings=(notice, *finding.warnings))
    return finding


def _without_map_projection(
    pairs: Pairs, reference: Side, candidate: Side, registration: Registration, origin: FloatArray
) -> tuple[Pairs, list[Notice]]:
    """Return the pairs in a Euclidean frame if only one cloud is on a map grid and the residuals agree with that.

    Heights on a map follow the Earth's curvature, and its scale varies: relative to a Euclidean cloud the map is
    deformed (2 cm at 500 m).

    Returns:
        The pairs, and notes on the correction.
    """
    ours, theirs = reference.cloud.crs, candidate.cloud.crs
    noise = 1.4826 * float(np.median(np.abs(pairs.left)))
    if ours is None and theirs is None and float(np.abs(origin).max()) > _MIN_MAP_COORDINATE:
        sagitta = extent(pairs.places) ** 2 / (8 * _EARTH_RADIUS_M)
        if sagitta > 0.2 * noise and noise > rounding_of(reference.surface.points, origin):
            text = (
                "the coordinates look like those of a map, but no file names its coordinate system: relative to a"
                f" Euclidean cloud, the Earth's curvature alone deforms a map by {sagitta:.2g} (if the unit is m)"
            )
            return pairs, [Notice("map-not-named", text)]
    name = ours if theirs is None else theirs
    if name is None or (ours is not None and theirs is not None):
        return pairs, []
    T = registration.T_reference_candidate
    places = pairs.places + origin
    offsets = euclidean_offsets(name, places if theirs is None else T.inverse().apply(places))
    if offsets is None:
        return pairs, []
    # A point q of the map is at q + offset in space. A Euclidean candidate lies there and seems displaced by it.
    displacement = np.einsum("ni,ni->n", offsets if theirs is None else -offsets @ T.linear.T, pairs.normals)
    gauge = "similarity" if registration.solved_scale else "rigid"
    share, size = projected_share(pairs.places, pairs.normals, pairs.residuals, pairs.weights, displacement, gauge)
    if share < 0.5 or size < 0.1 * noise:
        return pairs, []
    text = f"one cloud is on a map grid: its deformation of {size:.2g} RMS against Euclidean space was removed first"
    return replace(pairs, residuals=pairs.residuals - displacement), [Notice("map-bend-taken-off", text)]
