"""Sentences of the stress study, from studies with known counts."""

from dataclasses import replace

import pytest
from stress_studies import CASES, OVERLAP, registrations, study

from pcbench.studies.frame.rates import Rate, percent
from pcbench.studies.stress.descriptions import MissingMethod
from pcbench.studies.stress.results import StressSettings
from pcbench.studies.stress.subject import FALSE_ALARM, RIGHT, SILENT
from pcbench.studies.stress.verdicts import FALSE_BEND
from pcbench.studies.stress.words import (
    answer,
    metric_sentences,
    rate_text,
    registration_sentences,
    sentences,
    verdict_sentences,
    warnings,
)


def test_limits_and_failures_of_a_registration():
    assert [s for s in registration_sentences(study()) if s.startswith("icp")] == [
        "icp: safe up to 15 deg (rotation of the start), down to 60 % (overlap) and up to 4 spacings (Gaussian noise,"
        " the last level); beyond that it fails and says so in 67 %, is silently wrong in 11 % [2, 43], is right in"
        " 11 % and crashes or runs out of time in 11 % of 9 runs.",
        "icp: safe from starts within 20 deg and 5 % of the extent together (8 of 8 runs right); from others it fails"
        " and says so in 100 %, is silently wrong in 0 % [0, 28] and is right in 0 % of 10 runs.",
        "icp breaks under rotation of the start (beyond 15 deg) and overlap (below 60 %); it withstands all levels of"
        " Gaussian noise.",
        "icp is wrong with confidence in 2 of 49 runs, 4.1 % [1.1, 14]: rotation of the start (1) and half-turn"
        " building (1).",
        "icp doubts 1 of 28 right poses, 3.6 % [0.63, 18]; it refuses 2 poses that another local method found.",
        "icp runs out of time in 1 run: overlap (1).",
    ]


def test_methods_without_confident_errors_state_the_upper_bound():
    (found,) = [s for s in registration_sentences(study()) if s.startswith("global is wrong")]
    assert found == "global is wrong with confidence in 0 of 15 runs, 0 % [0, 20]."


def test_methods_that_are_never_safe_or_never_fail():
    cells = [*registrations(OVERLAP, 100, "icp", [SILENT] * 2), *registrations(OVERLAP, 60, "icp", [RIGHT] * 2),
             *registrations(OVERLAP, 20, "icp", [RIGHT] * 2)]  # fmt: skip
    first, second, *_ = registration_sentences(study(registrations=tuple(cells)))
    assert first == (
        "icp: not safe at any level of overlap; there it fails and says so in 0 %, is silently wrong in 33 % [9.7, 70]"
        " and is right in 67 % of 6 runs."
    )
    assert second == "icp breaks under overlap (safe at no level)."
    cells = [c for level in OVERLAP.levels for c in registrations(OVERLAP, level, "icp", [RIGHT, FALSE_ALARM])]
    assert list(registration_sentences(study(registrations=tuple(cells)))) == [
        "icp: safe down to 20 % (overlap, the last level).",
        "icp withstands all levels of overlap.",
        "icp is wrong with confidence in 0 of 6 runs, 0 % [0, 39].",
        "icp doubts 3 of 6 right poses, 50 % [19, 81].",
    ]


def test_silent_failures_with_another_warning_are_counted_beside():
    silent, warned, right = registrations(OVERLAP, 20, "icp", [SILENT, SILENT, RIGHT])
    warned = replace(warned, warned=True, codes=("low-overlap", "weakly-observable"))
    right = replace(right, warned=True, codes=("low-overlap",))
    (found,) = [
        sentence
        for sentence in registration_sentences(study(registrations=(silent, warned, right)))
        if "with confidence" in sentence
    ]
    assert found.endswith(
        ": overlap (2); 1 of them with a warning that does not make the pose doubtful: low-overlap (1) and"
        " weakly-observable (1)."
    )


def test_lists_of_cases_have_no_limit():
    cells = registrations(CASES, 1, "icp", [SILENT, RIGHT])
    first, *_ = registration_sentences(study(registrations=tuple(cells)))
    assert first == "icp is wrong with confidence in 1 of 2 runs, 50 % [9.5, 91]: half-turn building (1)."


def test_metrics_are_right_explained_or_silently_wrong():
    assert list(metric_sentences(study())) == [
        "pcbench, RMS off the surface: within 10 % of the exact value in 75 % [47, 91] of 12 runs; further off, but"
        " explained by its floor or its interval, in 17 % [4.7, 45]; silently wrong in 8.3 % [1.5, 35].",
        "pcbench, RMS off the surface: the 95 % interval contains the exact value in 92 % [65, 99] of 12 intervals, as"
        " stated.",
        "pcbench, RMS off the surface breaks under Gaussian noise (beyond 1 spacing).",
        "Open3D, RMS off the surface: within 10 % of the exact value in 33 % [14, 61] of 12 runs; further off, but"
        " explained by its floor or its interval, in 0 % [0, 24]; silently wrong in 67 % [39, 86].",
        "Open3D, RMS off the surface breaks under Gaussian noise (safe at no level).",
    ]


def test_verdicts_count_confident_errors_apart_from_withheld_ones():
    assert list(verdict_sentences(study())) == [
        "deform: right in 83 % [55, 95] of 12 verdicts, wrong with confidence in 8.3 % [1.5, 35], withheld in 8.3 %"
        " [1.5, 35].",
        "deform finds a deformation in 0 of 4 undeformed clouds, 0 % [0, 49]; it misses 1 of 8 deformed clouds, 12 %"
        " [2.2, 47]; it withholds its verdict on 1 of 12 right poses, 8.3 % [1.5, 35].",
        "deform is wrong with confidence under dome (1).",
        "deform: the median of the measured sizes is 1.1 times the true one at 1 times the noise and 1.1 times the true"
        " one at 4 times the noise.",
        "deform: the 95 % interval contains the true size in 86 % [49, 97] of 7 intervals, as stated.",
        "deform breaks under dome (safe at no level).",
        "naive BIC: right in 75 % [47, 91] of 12 verdicts, wrong with confidence in 25 % [8.9, 53], withheld in 0 % [0,"
        " 24].",
        "naive BIC finds a deformation in 3 of 4 undeformed clouds, 75 % [30, 95]; it misses 0 of 8 deformed clouds,"
        " 0 % [0, 32]; it withholds its verdict on 0 of 12 right poses, 0 % [0, 24].",
        "naive BIC is wrong with confidence under dome (3).",
        "naive BIC: the median of the measured sizes is 1.1 times the true one at 1 times the noise and 1.1 times the"
        " true one at 4 times the noise.",
        "naive BIC breaks under dome (safe at no level).",
    ]
    assert sum(cell.failure == FALSE_BEND for cell in study().verdicts) == 3


def test_intervals_that_cover_too_rarely_are_said_to_do_so():
    metrics = [c for _ in range(3) for c in study().metrics if c.method == "pcbench" and c.level == 4]
    narrow = [c for c in metrics if c.covers is False] * 10 + metrics
    texts = list(metric_sentences(study(metrics=tuple(narrow))))
    assert "contains the exact value in 21 % [12, 36] of 42 intervals, less often than stated." in texts[1]


def test_the_answer_is_of_our_methods_alone():
    found = list(answer(study()))
    assert [s.split(" ")[0].strip(",:") for s in found] == [
        "icp",
        "icp",
        "global",
        "global",
        "pcbench",
        "deform",
        "changes",
    ]
    assert set(found) <= set(sentences(study()))


def test_what_was_left_out_is_named_with_its_reason():
    left = (MissingMethod("Open3D plane", "no wheel"), MissingMethod("robust ICP", "no wheel"))
    assert list(warnings(study(missing=left, settings=StressSettings(quick=True)))) == [
        "These are the results of the quick plan: few levels and seeds; without --quick the limits are finer.",
        "Other libraries state no doubt about a pose: it counts as doubtful if the method has not converged or matches"
        " too few points.",
        "Left out: Open3D plane and robust ICP (no wheel).",
    ]
    assert sentences(study())[-1].startswith("Left out: KISS-Matcher")


@pytest.mark.parametrize(
    ("share", "text"),
    [
        (0, "0 %"),
        (0.004, "0.4 %"),
        (0.0996, "10 %"),
        (0.5, "50 %"),
        (0.996, "99.6 %"),
        (0.9999, "99.9 %"),
        (1, "100 %"),
    ],
)
def test_percentages(share, text):
    assert percent(share) == text


def test_rates_have_wilson_intervals():
    assert rate_text(Rate(2, 500)) == "0.4 % [0.11, 1.4]"  # Wilson 1927, computed by hand
    assert rate_text(Rate(0, 0)) == "–"
