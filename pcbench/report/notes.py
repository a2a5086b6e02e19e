"""Warnings above the numbers of a comparison, and detailed sentences below them."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence

from pcbench.geometry.arrays import bounds
from pcbench.measure.quantities import quantities
from pcbench.measure.results import (
    ARROWS,
    CANDIDATE_TO_REFERENCE,
    REFERENCE_TO_CANDIDATE,
    Candidate,
    Difference,
    LeftOut,
    Tiling,
)
from pcbench.measure.wording import pluralize, with_unit
from pcbench.registration.result import LOW_OVERLAP, UNOBSERVABLE, WEAKLY_OBSERVABLE
from pcbench.report.checked import check_point_remarks
from pcbench.report.inputs import FinishedComparison
from pcbench.report.layout import label_of
from pcbench.report.moved import motion_clause, place_sentence
from pcbench.report.pose import has_open_motion
from pcbench.report.words import interval_text, join_words, length, one_line, percentage, sample_count

CLAIMS = ("similarity", "affine", "non-affine")  # verdicts that assert a deformation
_OF_FITTED_POSES = (UNOBSERVABLE, WEAKLY_OBSERVABLE)  # codes of warnings that say nothing about a given pose
_MIN_OVERLAP = 0.8  # below it, points beyond the reference dominate the distances
_MIN_OUTSIDE_SHARE = 0.5  # of the points beyond the reference, for which its bounding box is recommended
_MAX_LISTED_FILES = 3
_REPORTED_DIFFERENCES = (  # all are squared lengths
    f"d1_mse/{CANDIDATE_TO_REFERENCE}",
    f"d1_mse/{REFERENCE_TO_CANDIDATE}",
    f"d2_mse/{CANDIDATE_TO_REFERENCE}",
    "chamfer/sum_squared",
)


def warnings(comparison: FinishedComparison) -> list[str]:
    """Return the warnings of a comparison, each text once with the names of its candidates."""
    names_by_text: dict[str, list[str]] = {}
    inputs = comparison.inputs
    if inputs is not None:
        names_by_text.update({text: [] for text in inputs.reference.warnings})
    names_by_text.update({str(notice): [] for notice in comparison.reference.warnings})
    if comparison.tiling is not None and comparison.tiling.left_out:
        names_by_text[_left_out_words(comparison.tiling.left_out)] = []
    for candidate in comparison:
        if inputs is not None:
            names_by_text.update({text: [] for text in inputs.candidates[candidate.name].warnings})
        for text in _of_candidate(comparison, candidate):
            names_by_text.setdefault(text, []).append(candidate.name)
    return _with_names(names_by_text)


def metric_warnings(comparison: FinishedComparison) -> list[str]:
    """Return those of the `warnings` that say why user-defined metrics are missing."""
    names_by_text: dict[str, list[str]] = {}
    for candidate in comparison:
        for text in candidate.failures:
            names_by_text.setdefault(text, []).append(candidate.name)
    return _with_names(names_by_text)


def _with_names(names_by_text: Mapping[str, Sequence[str]]) -> list[str]:
    return [f"{join_words(names)}: {text}" if names else text for text, names in names_by_text.items()]


def remarks(comparison: FinishedComparison) -> Iterator[str]:
    """Yield how tiles were used, doubts about given poses, residuals, motions that the answer omits, and samples.

    How heights at check points were found, and what limits their accuracy, follow.
    """
    yield from _remarks(comparison)
    yield from check_point_remarks(comparison)


def _remarks(comparison: FinishedComparison) -> Iterator[str]:
    if comparison.tiling is not None:
        yield tiling_sentence(comparison, comparison.tiling)
    if samples := list(_map_samples(comparison)):
        where = "; all points are in maps/" if comparison.has_map_files else ""
        yield f"Maps, charts and local statistics show a sample: {join_words(samples)}{where}."
    unit = comparison.reference.unit
    for candidate in comparison:
        for doubt in candidate.registration.notes:
            yield f"{candidate.name} is measured and ranked in the pose that you gave. Note: {doubt}."
        if lines := list(candidate.registration.residuals.rmse_lines(unit)):
            yield f"{candidate.name}: {'; '.join(lines)}"
        motion = candidate.registration.motion
        if motion is not None and motion.size > 0 and not place_sentence(comparison, candidate, candidate.name):
            yield f"{motion_clause(candidate.registration, motion, candidate.name, unit)}."
    if comparison.settings.tolerance is None:
        return
    for candidate in comparison:
        yield f"{candidate.name}: {_sample_words(comparison, candidate)}."


def tiling_sentence(comparison: FinishedComparison, tiling: Tiling) -> str:
    """Return how a comparison was computed in tiles, in one or two sentences."""
    text = (
        f"Computed in {pluralize(tiling.tiles, 'tile')} of at most {pluralize(tiling.tile_points, 'point')}: distances"
        " and their statistics are those of all points."
    )
    if tiling.max_distance is not None:
        limit = length(tiling.max_distance, comparison.reference.unit)
        text += f" Closest points were searched within {limit} (--max-distance)."
    if tiling.sampled_points is not None:
        text += (
            f" Registration is based on a sample of {tiling.sampled_points:,} of the reference's"
            f" {pluralize(comparison.reference.points, 'point')}."
        )
    computed = comparison.candidates[0].metrics.presets
    if missing := [name for name in comparison.settings.measured_presets if name not in computed]:
        text += f" Not computed in tiles: {'the preset' if len(missing) == 1 else 'the presets'} {join_words(missing)}."
    return text


def details(comparison: FinishedComparison) -> Iterator[str]:
    """Yield the verdict on each candidate, and the differences of each pair whose poses are right or vouched for."""
    for candidate in comparison:
        yield deformation_sentence(comparison, candidate, candidate.name)
    unranked = {c.name for c in comparison if not c.registration.is_ranked}
    labels = {}
    for quantity in quantities(comparison.candidates[0]):
        if quantity.difference in _REPORTED_DIFFERENCES and (label := label_of(quantity)) is not None:
            labels[quantity.difference] = f"{label.text} {ARROWS.get(quantity.direction, '')}".rstrip()
    for difference in comparison.differences:
        if difference.metric in labels and not {difference.a, difference.b} & unranked:
            yield _difference_words(difference, labels[difference.metric], comparison.reference.unit)


def deformation_sentence(comparison: FinishedComparison, candidate: Candidate, name: str) -> str:
    """Return the verdict on deformation as a sentence without a period.

    There is no verdict if a candidate looks deformed but the geometry does not determine its pose.
    """
    if is_open(candidate) and candidate.deformation.verdict in CLAIMS:
        return f"{name}: no verdict on deformation, because the geometry does not determine its pose"
    return candidate.deformation.sentence(name, comparison.reference.unit or "", is_noise=candidate.is_noise)


def is_open(candidate: Candidate) -> bool:
    """Return whether the geometry, from which a candidate's pose was found, leaves a motion unconstrained."""
    return has_open_motion(candidate.registration)


def overlaps_little(comparison: FinishedComparison, candidate: Candidate) -> bool:
    """Return whether a large part of a candidate lies beyond the reference and is measured nevertheless."""
    return comparison.settings.crop == "none" and candidate.registration.overlap < _MIN_OVERLAP


def _of_candidate(comparison: FinishedComparison, candidate: Candidate) -> Iterator[str]:
    yield from map(str, candidate.warnings)
    if text := _censored_words(comparison, candidate):
        yield text
    registration, everywhere = candidate.registration, comparison.settings.crop == "none"
    for notice in registration.warnings:
        is_replaced = everywhere and notice.code == LOW_OVERLAP  # by the sentence below
        is_left_out = registration.keeps_pose and notice.code in _OF_FITTED_POSES
        if not (is_replaced or is_left_out or notice in registration.notes):
            yield str(notice)
    if overlaps_little(comparison, candidate):
        distance = length(registration.overlap_distance, comparison.reference.unit)
        yield (
            f"a large part of the cloud is farther than {distance} from the reference and counts in all distances;"
            f" {_crop_advice(candidate)}"
        )
    yield from map(str, candidate.deformation.further_warnings)


def _censored_words(comparison: FinishedComparison, candidate: Candidate) -> str:
    """Return which shares of the distances reach the maximum distance; empty if none does."""
    shares = [(ARROWS[way], share) for way, share in candidate.censored.items() if share > 0]
    if not shares or comparison.tiling is None:
        return ""
    limit = length(comparison.tiling.max_distance, comparison.reference.unit)
    parts = join_words([f"{percentage(share)} of the distances {arrow}" for arrow, share in shares])
    unknown = f"{join_words([f'D2 {arrow}' for arrow, _ in shares])} {'is' if len(shares) == 1 else 'are'} unknown"
    return (
        f"{parts} exceed --max-distance and count as {limit}: means, mean squares, Chamfer and Hausdorff distances, and"
        f" percentiles that reach {limit}, are lower bounds, and {unknown}; raise"
        " --max-distance, or leave out what one cloud lacks (--crop)"
    )


def _left_out_words(left_out: Sequence[LeftOut]) -> str:
    """Return the damaged files that are missing in all numbers; the first ones with their reasons."""
    counts = [file.points for file in left_out]
    lost = sum(count for count in counts if count is not None)
    points = f" with {'at least ' if None in counts else ''}{pluralize(lost, 'point')}"
    listed = "; ".join(f"{file.path} ({one_line(file.reason)})" for file in left_out[:_MAX_LISTED_FILES])
    unlisted = len(left_out) - _MAX_LISTED_FILES
    ending = f"; and {pluralize(unlisted, 'other')} (comparison.json lists all)" if unlisted > 0 else ""
    files = pluralize(len(left_out), "damaged file")
    return f"left out {files}{points if lost else ''}, which {'is' if len(left_out) == 1 else 'are'} missing in all" + (
        f" numbers: {listed}{ending}"
    )


def _map_samples(comparison: FinishedComparison) -> Iterator[str]:
    """Yield how many points are in each map that is a sample; those of the reference are named once."""
    for candidate in comparison:
        if candidate.deviation.sampled_from is not None:
            yield f"{sample_count(candidate.deviation)} of {candidate.name}"
    reference_map = comparison.candidates[0].completeness
    if reference_map.sampled_from is not None:
        yield f"{sample_count(reference_map)} of the reference"


def _crop_advice(candidate: Candidate) -> str:
    """Return the options that exclude points beyond the reference; its bounding box only if many are outside."""
    points, (lower, upper) = (
        candidate.deviation.points[candidate.deviation.is_even],
        bounds(candidate.completeness.points),
    )
    outside = float(((points < lower) | (points > upper)).any(axis=1).mean())
    if outside < _MIN_OUTSIDE_SHARE * (1 - candidate.registration.overlap):
        return "--crop polygon:FILE measures only points inside a region"
    return "--crop reference measures only points inside the reference's bounding box, --crop polygon:FILE any region"


def _sample_words(comparison: FinishedComparison, candidate: Candidate) -> str:
    """Return from how many points D2 was estimated, with the 95 % confidence intervals."""
    samples = candidate.metrics.d2_samples
    if not samples:
        return "all distances are exact, because a sample would save no time"
    points = {
        CANDIDATE_TO_REFERENCE: candidate.points_in_region,
        REFERENCE_TO_CANDIDATE: comparison.reference.points_in_region,
    }
    parts = []
    for way, sample in samples.items():
        value = candidate.metrics.d2_mse[way].value or math.nan
        parts.append(
            f"D2 {ARROWS[way]} is estimated from {sample.points:,} of {points[way]:,} points"
            f" (mean square ± {sample.half_width / value:.2%}, 95 % confidence)"
        )
    return (
        f"{' and '.join(parts)}. The median and the NMAD of distances to planes come from the same sample. Distances to"
        " points are exact. Area-weighted D2 and the presets' D2 need all points and are left out"
    )


def _difference_words(difference: Difference, label: str, unit: str | None) -> str:
    """Return which of two candidates has the lower mean square, and by how much."""
    a, b, interval = difference.a, difference.b, difference.interval
    square_unit = f"{unit}²" if unit else None
    if interval.low <= 0 <= interval.high:
        bounds = with_unit(interval_text(interval), square_unit)
        return f"{label}: no significant difference between {a} and {b} ({bounds})"
    better, worse = (a, b) if interval.high < 0 else (b, a)
    amount = f"{abs(difference.difference):.3g} {interval_text(sorted(map(abs, interval)))}"
    return f"{label}: {better} is lower than {worse} by {with_unit(amount, square_unit)}"
