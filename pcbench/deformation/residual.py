"""From two aligned clouds to a `Deformation`."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from pcbench.deformation.answer import describe
from pcbench.deformation.breaks import find_break
from pcbench.deformation.displacement import Displacement, projected_share
from pcbench.deformation.field import local_changes
from pcbench.deformation.model import Noise
from pcbench.deformation.pairs import Pairs, PairSearch, tile_sums
from pcbench.deformation.parts import Wave
from pcbench.deformation.result import BOTH_FROM_PHOTOGRAPHS, POSE_NOT_FIXED, RESOLUTION_SHARE, Deformation
from pcbench.deformation.sides import MIN_PAIRS, Side, extent
from pcbench.deformation.size import widened
from pcbench.deformation.verdict import Finding, PairEvidence, decide, negligible_rms
from pcbench.deformation.waves import find_waves
from pcbench.errors import Notice, RegistrationError
from pcbench.geometry.arrays import FloatArray, rounding_bound
from pcbench.geometry.crs import euclidean_offsets
from pcbench.geometry.order_statistics import robust_sigma
from pcbench.geometry.transform import Similarity
from pcbench.registration import Registration, Target
from pcbench.registration.quality import assess_given
from pcbench.registration.result import DOUBTFUL_POSE, FEW_POINTS, UNOBSERVABLE
from pcbench.threads import one_blas_thread

_MIN_DISTANCE_GAIN = 0.1  # relative decrease of the median distance at which the pairs disagree
_MAX_MOVED_SHARE = 0.1  # maximum share of the cells to exclude as moved
_MOVED_SIGMAS, _MAX_EXCLUSION_PASSES = 3.0, 3  # standard deviations of a pair's noise, and maximum number of passes
# A place of adjacent cells, and its share in what the models explain: up to 0.38 in 12 domes of a city.
_ADJACENT_CELLS, _MIN_DOMINANT_SHARE = 2.0, 0.8
_MAX_ROUGH_SHARE = 0.9  # share of rough pairs: at a spacing of metres, most of a city is corners and edges
# Pairs of registered clouds have more inliers or a smaller median distance.
_MIN_INLIER_SHARE, _MAX_DISTANCE_SPACINGS = 0.85, 1.25
_MIN_MAP_COORDINATE = 1e5  # larger coordinates are probably those of a map projection
_EARTH_RADIUS = 6.37e6  # metres
_DOUBTFUL = "doubtful-registration"
_POSE_CODES = (_DOUBTFUL, POSE_NOT_FIXED)


@one_blas_thread()
def residual_deformation(
    reference: Side, candidate: Side, registration: Registration, origin: FloatArray, *, seed: int = 0
) -> Deformation:
    """Test what a rigid, a similarity or an affine motion leaves between two registered clouds.

    Args:
        reference: the reference, in its coordinates minus `origin`.
        candidate: the aligned candidate, in the same coordinates.
        registration: registration of the candidate; a scale that it solved for is not a deformation.
        origin: (3,) local origin.
        seed: random seed for the folds of the cross-validation.
    """
    search = PairSearch.of(reference, candidate)
    pairs = None if search is None else search.find(follow=True)
    if (
        search is None
        or pairs is None
        or np.count_nonzero(pairs.weights) < MIN_PAIRS
        or extent(pairs.places[pairs.weights > 0]) == 0
    ):
        count = 0 if pairs is None else int(np.count_nonzero(pairs.weights))
        text = f"only {count} pairs of points: too few to distinguish a deformation from noise"
        return Deformation.undecided_because(Notice("few-pairs", text))
    pairs, notes = _without_map_projection(pairs, reference, candidate, registration, origin)
    if reference.is_from_photographs and candidate.is_from_photographs:
        notes = [*notes, Notice(BOTH_FROM_PHOTOGRAPHS, "both clouds were reconstructed from photographs")]
    unit = _unit_text(reference)
    metric = reference.is_metric and candidate.is_metric and not registration.solved_scale
    resolution = RESOLUTION_SHARE * pairs.plane_spacing
    waves = find_waves(pairs)  # before the models, which take as much memory
    wholes = [PairEvidence.of(tile_sums(pairs))]
    evidence = [exclude_moved_cells(wholes[0], resolution)]
    finding = decide(evidence, metric=metric, resolution=resolution, unit=unit)
    if finding.verdict != "none":
        kept, places = exclude_dominant_place(evidence[0], origin, unit)
        if places:
            evidence, notes = [kept], [*notes, *places]
            finding = decide(evidence, metric=metric, resolution=resolution, unit=unit)
    if finding.verdict != "none":
        # A claim has to hold without the model being assumed.
        plain = search.find(follow=False)
        if plain is not None:
            plain, _ = _without_map_projection(plain, reference, candidate, registration, origin)
            wholes.append(PairEvidence.of(tile_sums(plain)))
            kept, more = exclude_dominant_place(exclude_moved_cells(wholes[1], resolution), origin, unit)
            evidence, notes = [*evidence, kept], [*notes, *(more if not places else ())]
            finding = decide(evidence, metric=metric, resolution=resolution, unit=unit)
            if finding.verdict == "none" and pairs.distance < (1 - _MIN_DISTANCE_GAIN) * plain.distance:
                text = (
                    "a deformation brings the clouds closer together, but unmodified closest points do not show it; use"
                    " denser clouds, or a better initial pose"
                )
                finding = finding.as_undecided(Notice("pairs-disagree", text))
    if finding.verdict == "undecided" and pairs.rough > _MAX_ROUGH_SHARE:
        text = (
            f"{pairs.rough:.0%} of the pairs lie in rough areas, where no surface constrains a displacement; use denser"
            " clouds, or classes without vegetation (--classes)"
        )
        finding = finding.as_undecided(Notice("rough-places", text))
    wave = _stated_wave(waves.wave, evidence[0].noise, resolution)
    if wave is not None:
        plain = search.find(follow=False)  # as for the other models
        wave = None if plain is None or find_waves(plain).wave is None else wave
    if wave is not None and finding.is_open_to_waves:
        finding = finding._replace(verdict="non-affine", warnings=())
    broken = find_break(evidence[-1])
    if broken is not None:
        finding = finding.as_undecided(Notice("parts-displaced", broken.text(origin, unit)))
    if registration.doubtful and _bend_explains_doubt(finding, registration, search, pairs.field):
        settled = [notice for notice in registration.warnings if notice not in registration.doubts]
        registration = replace(registration, warnings=tuple(settled))
    finding = _with_registration(finding, registration, pairs)
    # A claim is described by the pairs that follow the model; if these claimed too much, by the others.
    which = -1 if (finding.conditional or finding.verdict) == "none" else 0
    described, whole = evidence[which], wholes[which]
    answer = describe(described, finding, resolution=resolution, seed=seed)
    answer = answer.with_waves(wave, waves.limit).without_empty_denial()
    if described is not whole:
        answer = answer.with_changes(describe(whole, finding, resolution=resolution, seed=seed))
    if finding.verdict == "undecided" and finding.conditional is None and finding.warnings[0].code in _POSE_CODES:
        answer = answer.withheld()
    share = pairs.share * float(described.sums.counts.sum() / whole.sums.counts.sum())
    answer = replace(answer, surface_share=float(f"{share:.6g}"))
    if search.coincides(rounding_bound(reference.corners, origin)):
        answer = answer.without_rounding()
    return answer.shifted(origin).with_warnings(notes)


def exclude_moved_cells(whole: PairEvidence, resolution: float) -> PairEvidence:
    """Exclude the few cells that clearly moved by themselves: a smooth model would bend towards them."""
    evidence, most = whole, (1 - _MAX_MOVED_SHARE) * len(whole.sums.counts)
    for _ in range(_MAX_EXCLUSION_PASSES):  # once some are excluded, more may stand out
        changed, length, _ = local_changes(evidence.geometry, evidence.noise, evidence.sums, resolution)
        moved = changed & (length > _MOVED_SIGMAS * math.sqrt(evidence.noise.white + evidence.noise.correlated))
        if not moved.any():
            break
        if len(moved) - np.count_nonzero(moved) < most:
            return whole
        evidence = PairEvidence.of(evidence.sums.without(moved))
    return evidence


def exclude_dominant_place(evidence: PairEvidence, origin: FloatArray, unit: str) -> tuple[PairEvidence, list[Notice]]:
    """Exclude one place that alone explains what the models fit: an object that moved, not a deformation of the scene.

    An object with many more points than its surroundings draws the models towards it, and so stands out from none.

    Args:
        evidence: the evidence.
        origin: (3,) local origin, for the notice.
        unit: unit of lengths after a space; empty if it is unknown.

    Returns:
        The evidence without the place, and a notice that names it; the same evidence and none if there is no such
        place.
    """
    modes = evidence.geometry.step("rigid", "cubic").modes
    fitted = evidence.scores.cells @ modes  # (C, K)
    shares = fitted @ fitted.sum(axis=0)  # of each cell in the sum of squares that the models explain
    means, middle = evidence.geometry.means, int(np.argmax(shares))
    apart = np.abs(means - means[middle]).max(axis=1)
    place = apart < _ADJACENT_CELLS * evidence.sums.side
    is_small = np.count_nonzero(place) <= _MAX_MOVED_SHARE * len(place)
    if not is_small or shares[place].sum() <= _MIN_DOMINANT_SHARE * shares.sum():
        return evidence, []
    x, y, z = means[middle] + origin
    rms = math.sqrt(float(evidence.scores.energy[place].sum() / evidence.geometry.weights[place].sum()))
    text = (
        f"the surroundings of ({x:.1f}, {y:.1f}, {z:.1f}), where the clouds lie {rms:.2g}{unit} RMS apart along the"
        " normals, alone explain what a deformation would, and are left out: look there for an object that moved"
    )
    return PairEvidence.of(evidence.sums.without(place)), [Notice("dominant-place", text)]


def _bend_explains_doubt(finding: Finding, registration: Registration, search: PairSearch, field: Displacement) -> bool:
    """Return whether the pose is doubted only for its fit, and is not once the deformation found is removed.

    A bend of many spacings worsens the fit of a right pose as a wrong pose does.
    """
    if finding.verdict != "non-affine" or {notice.code for notice in registration.doubts} != {DOUBTFUL_POSE}:
        return False
    points = search.candidate.surface.points
    target, straightened = Target(search.reference.surface), points - field(points)
    try:
        fit = assess_given(target, straightened, Similarity.identity(), np.zeros(3), registration.method)
    except RegistrationError:
        return False
    return not any(notice.code in (DOUBTFUL_POSE, FEW_POINTS) for notice in fit.quality.warnings)


def _stated_wave(wave: Wave | None, noise: Noise, resolution: float) -> Wave | None:
    """Return a wave with systematic errors in its interval, if that lies above the negligible size."""
    if wave is None:
        return None
    wave = replace(wave, ci=widened(wave.rms, wave.ci, noise))
    return wave if wave.ci[0] > max(resolution, negligible_rms(noise)) else None


def _with_registration(finding: Finding, registration: Registration, pairs: Pairs) -> Finding:
    """Return the finding as undecided if the pose behind it is wrong or may be."""
    if registration.doubtful:
        text = f"the registration is doubtful: {registration.doubts[0]}"
        return finding.as_conditional(Notice(_DOUBTFUL, text))
    if pairs.inliers < _MIN_INLIER_SHARE and pairs.distance > _MAX_DISTANCE_SPACINGS * pairs.spacing:
        text = (
            f"{1 - pairs.inliers:.0%} of the closest points do not correspond, and clouds of this spacing should lie"
            f" closer: {_cause_of_distance(registration)}"
        )
        return finding.as_undecided(Notice("not-registered", text))
    if finding.verdict != "undecided" and UNOBSERVABLE in {notice.code for notice in registration.warnings}:
        if finding.verdict != "none" and registration.converged is not None:
            text = (
                "the geometry does not fix the pose, and the apparent deformation may be a sliding registration: see"
                " the registration's warnings; a pose from another source settles it (--register matrix:FILE)"
            )
            return finding.as_undecided(Notice(POSE_NOT_FIXED, text))
        notice = Notice(POSE_NOT_FIXED, "as far as the geometry determines the pose")
        return finding._replace(warnings=(notice, *finding.warnings))
    return finding


def _cause_of_distance(registration: Registration) -> str:
    """Return why the clouds may lie far from each other, and what to do about it."""
    if registration.method == "none":
        return "they are not registered (use --register icp), or much has changed"
    if registration.method.startswith(("matrix:", "points:")):
        return (
            f"the pose of {registration.method} is inaccurate (write the aligned candidate with pcbench register --out,"
            " and register it by icp), or much has changed"
        )
    return (
        f"much has changed, or {registration.method} found a wrong pose (--register points:FILE or matrix:FILE gives"
        " another one)"
    )


def _unit_text(reference: Side) -> str:
    """Return the unit of all lengths after a space; empty if it is unknown."""
    return f" {reference.cloud.unit}" if reference.cloud.unit else ""


def _without_map_projection(
    pairs: Pairs, reference: Side, candidate: Side, registration: Registration, origin: FloatArray
) -> tuple[Pairs, list[Notice]]:
    """Transform the pairs to a Euclidean frame if one cloud alone is on a map grid and the residuals agree with that.

    Heights on a map follow the Earth's curvature, and its scale varies: relative to a Euclidean cloud it is deformed (2
    cm at 500 m).
    """
    ours, theirs = reference.cloud.crs, candidate.cloud.crs
    noise = robust_sigma(pairs.remainders)
    if ours is None and theirs is None and float(np.abs(origin).max()) > _MIN_MAP_COORDINATE:
        sagitta = extent(pairs.places) ** 2 / (8 * _EARTH_RADIUS)
        if sagitta > 0.2 * noise and noise > rounding_bound(reference.corners, origin):
            text = (
                "coordinates look like those of a map, but no file names its projection: relative to a Euclidean cloud"
                f" the Earth's curvature alone deforms it by {sagitta:.2g} (if the unit is the metre)"
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
    # A point at q on the map is at q + offset in space, so a Euclidean candidate seems displaced by the offset.
    expected = np.einsum("ni,ni->n", offsets if theirs is None else -offsets @ T.linear.T, pairs.normals)
    gauge = "similarity" if registration.solved_scale else "rigid"
    share, size = projected_share(pairs.places, pairs.normals, pairs.residuals, pairs.weights, expected, gauge)
    if share < 0.5 or size < 0.1 * noise:
        return pairs, []
    text = (
        f"one cloud is on a map grid: its deformation of {size:.2g}{_unit_text(reference)} RMS relative to Euclidean"
        " space was removed"
    )
    return replace(pairs, residuals=pairs.residuals - expected), [Notice("map-bend-taken-off", text)]
