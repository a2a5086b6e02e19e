"""Headlines of the stress study, from studies with known counts: at most three for each subject."""

from dataclasses import replace

import pytest
from photo_studies import photo_study
from stress_studies import CASES, OVERLAP, registrations, searches, study

from pcbench.studies.stress.descriptions import MissingMethod
from pcbench.studies.stress.reconstructors.reconstruction import UNPERTURBED
from pcbench.studies.stress.results import StressSettings
from pcbench.studies.stress.subject import FALSE_ALARM, REFUSED, RIGHT, SILENT, UNNAMED
from pcbench.studies.stress.words import (
    answer,
    change_headlines,
    metric_headlines,
    reconstruction_headlines,
    registration_headlines,
    verdict_headlines,
    warnings,
)


def poses(*cells):
    """Return the headlines of registrations."""
    return list(registration_headlines(study(registrations=cells)))


def test_limits_and_confident_errors_of_registrations():
    assert list(registration_headlines(study())) == [
        "icp: safe up to 15 deg (rotation of the start), down to 60 % (overlap) and up to 4 spacings (Gaussian noise,"
        " the last level); beyond that it fails and says so in 67 %, is silently wrong in 11 % [2, 43], is right in"
        " 11 % and crashes or runs out of time in 11 % of 9 runs.",
        "global: safe down to 60 % (overlap) and up to 4 spacings (Gaussian noise, the last level); beyond that it"
        " fails and says so in 67 %, is silently wrong in 0 % [0, 56], is right in 0 % and crashes or runs out of time"
        " in 33 % of 3 runs.",
        "Wrong with confidence: icp in 2 of 49 runs, 4.1 % [1.1, 14] (rotation of the start (1) and half-turn building"
        " (1)); global in 0 of 15 runs, 0 % [0, 20].",
    ]


def test_methods_that_are_never_safe_or_never_fail():
    never = [(100, [SILENT] * 2), (60, [RIGHT] * 2), (20, [RIGHT] * 2)]
    first, _ = poses(*(cell for level, ends in never for cell in registrations(OVERLAP, level, "icp", ends)))
    assert first == (
        "icp: not safe at any level of overlap; there it fails and says so in 0 %, is silently wrong in 33 % [9.7, 70]"
        " and is right in 67 % of 6 runs."
    )
    cells = [cell for level in OVERLAP.levels for cell in registrations(OVERLAP, level, "icp", [RIGHT, FALSE_ALARM])]
    assert poses(*cells) == [
        "icp: safe down to 20 % (overlap, the last level).",
        "Wrong with confidence: icp in 0 of 6 runs, 0 % [0, 39].",
    ]


def test_lists_of_cases_have_no_limit():
    assert poses(*registrations(CASES, 1, "icp", [SILENT, RIGHT])) == [
        "Wrong with confidence: icp in 1 of 2 runs, 50 % [9.5, 91] (half-turn building (1))."
    ]


def test_metrics_are_right_explained_or_silently_wrong():
    assert list(metric_headlines(study())) == [
        "pcbench, RMS off the surface: within 10 % of the exact value in 75 % [47, 91] of 12 runs; further off, but"
        " explained by its floor or its interval, in 17 % [4.7, 45]; silently wrong in 8.3 % [1.5, 35].",
        "pcbench: the 95 % interval contains the exact value in 92 % [65, 99] of 12 intervals, as stated.",
    ]


def test_intervals_that_cover_too_rarely_are_said_to_do_so():
    metrics = [c for _ in range(3) for c in study().metrics if c.method == "pcbench" and c.level == 4]
    narrow = [c for c in metrics if c.covers is False] * 10 + metrics
    texts = list(metric_headlines(study(metrics=tuple(narrow))))
    assert "contains the exact value in 21 % [12, 36] of 42 intervals, less often than stated." in texts[1]


def test_verdicts_count_confident_errors_apart_from_withheld_ones():
    assert list(verdict_headlines(study())) == [
        "deform: right in 83 % [55, 95] of 12 verdicts, wrong with confidence in 8.3 % [1.5, 35], withheld in 8.3 %"
        " [1.5, 35].",
        "deform finds a deformation in 0 of 4 undeformed clouds, 0 % [0, 49]; it misses 1 of 8 deformed clouds, 12 %"
        " [2.2, 47]; it withholds its verdict on 1 of 12 right poses, 8.3 % [1.5, 35].",
        "deform: the 95 % interval contains the true size in 86 % [49, 97] of 7 intervals, as stated.",
    ]


def test_changes_are_named_or_not():
    assert list(change_headlines(study())) == [
        "changes: names what changed, or that nothing did, in 79 % [52, 92] of 14 runs, leaves a large change out in"
        " 7.1 % [1.3, 31], and names another kind or place in 14 % [4, 40].",
        "changes does not name 1 of 8 large changes, 12 % [2.2, 47]; it reports a change where there is none in 1 of 14"
        " runs, 7.1 % [1.3, 31].",
    ]


def test_a_change_of_exactly_the_least_size_counts_in_spite_of_rounding():
    (cell,) = searches(10, [UNNAMED])
    made = study(changes=(replace(cell, noise=0.0424264, true_size=0.424263),))
    assert list(change_headlines(made))[1].startswith("changes does not name 1 of 1 large change, 100 %")


def test_reconstructors_keep_half_of_their_score_or_say_so():
    assert list(reconstruction_headlines(photo_study())) == [
        "F-score at 2.4 m on the unperturbed scene: sfm 0.2; mvs 0.96.",
        "At least half of it is kept by sfm down to 60 % (images kept) and up to 1 px (blur); mvs down to 20 % (images"
        " kept, the last level).",
        "Less than half of it without a warning: sfm in 2 of 15 runs, 13 % [3.7, 38] (blur (1) and hard city (1)); mvs"
        " in 2 of 15 runs, 13 % [3.7, 38] (blur (1) and hard city (1)).",
    ]


def test_a_method_without_an_unperturbed_score_cannot_be_judged():
    made = photo_study({"sfm": {UNPERTURBED: [REFUSED], "blur": [0.2, 0.2, 0.2, 0.2, 0.2]}})
    assert list(answer(made)) == ["F-score at 2.4 m on the unperturbed scene: sfm none, so its clouds are not judged."]


@pytest.mark.parametrize("made", [study(), photo_study()], ids=["pairs", "photographs"])
def test_subjects_have_at_most_three_headlines(made):
    headlines = list(answer(made))
    assert 0 < len(headlines) <= 3 * len(made.subjects())
    assert not any("peer" in headline or "naive" in headline or "Open3D" in headline for headline in headlines)


def test_what_was_left_out_is_named_with_its_reason():
    left = (MissingMethod("Open3D plane", "no wheel"), MissingMethod("robust ICP", "no wheel"))
    assert list(warnings(study(missing=left, settings=StressSettings(quick=True)))) == [
        "These are the results of the quick plan: few levels and seeds; without --quick the limits are finer.",
        "Other libraries state no doubt about a pose: it counts as doubtful if the method has not converged or matches"
        " too few points.",
        "Left out: Open3D plane and robust ICP (no wheel).",
    ]
