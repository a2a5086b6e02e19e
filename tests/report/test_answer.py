"""The answer in words: its claims, when they are withheld, and the warnings before any number."""

from dataclasses import replace

import numpy as np
import pytest
import shapes
from wording import check_text

from pcbench import Cloud, Settings, compare
from pcbench.errors import Notice
from pcbench.measure.intervals import Interval
from pcbench.registration import result
from pcbench.report.answer import answer
from pcbench.report.notes import details, warnings
from pcbench.report.table import html, markdown
from pcbench.report.words import columns, join_words, length, pad, shorten_name

GIVEN = Settings(register="none")


@pytest.fixture(scope="module")
def measured():
    """Compare four candidates: a is near, b is noisy, c is near with outliers, d covers half."""
    reference = Cloud(shapes.terrain(3000, seed=1)[0], unit="m")
    a = shapes.terrain(2000, seed=2)[0]
    rng = np.random.default_rng(5)
    c = shapes.terrain(2000, seed=4)[0]
    c[:60, 2] += rng.uniform(3, 6, 60)
    d = shapes.terrain(2000, seed=6)[0]
    clouds = {"a": a, "b": a + rng.normal(0, 0.3, a.shape), "c": c, "d": d[d[:, 0] < np.median(d[:, 0])]}
    return compare(reference, clouds, GIVEN)


def some(comparison, *names):
    kept = tuple(comparison[name] for name in names)
    pairs = tuple(d for d in comparison.differences if {d.a, d.b} <= set(names))
    return replace(comparison, candidates=kept, differences=pairs)


def with_registration(comparison, name, *codes, **changed):
    candidates = []
    for c in comparison:
        if c.name == name:
            notices = tuple(Notice(code, f"{code} said") for code in codes)
            c = replace(c, registration=replace(c.registration, warnings=notices, **changed))
        candidates.append(c)
    return replace(comparison, candidates=tuple(candidates))


def test_answer_on_one_candidate(measured):
    far, complete, bend, pose = answer(some(measured, "b"))
    b = measured["b"]
    off = b.metrics.d2_rms.accuracy.value
    ends = b.metrics.d2_mse.accuracy.interval
    assert f"b lies {off:.3g} m [{ends.low**0.5:.3g}, {ends.high**0.5:.3g}] RMS" in check_text(far)
    assert f"{b.metrics.d2_mse.accuracy.floor**0.5:.3g} m" in far
    assert f"{b.metrics.mean_distance.completeness.value:.3g} m" in check_text(complete)
    assert check_text(bend) == f"{b.deformation.sentence('b', 'm')}."
    assert f"{b.registration.overlap:.1%}" in check_text(pose)


def test_missing_surface_is_reported_with_its_place(measured):
    complete = answer(some(measured, "d"))[1]
    worst = measured["d"].metrics.hausdorff.completeness
    assert f"({worst.worst_point[0]:.1f}, " in check_text(complete)
    check_text(answer(some(measured, "a"))[1])


def test_outliers_are_distinguished_from_an_inaccurate_surface(measured):
    assert "NMAD" in check_text(answer(some(measured, "c"))[0])
    assert "NMAD" not in answer(some(measured, "b"))[0]
    # c's outliers make its RMS the largest; all its other points are better than b's.
    assert "NMAD" in check_text(answer(some(measured, "b", "c"))[0])


def test_candidates_are_distinguished_by_paired_differences(measured):
    two = some(measured, "a", "b")
    check_text(answer(two)[0])
    # The intervals of both are unchanged; only the interval of the difference now contains 0.
    alike = [d._replace(interval=Interval(-1.0, 1.0)) for d in two.differences]
    check_text(answer(replace(two, differences=tuple(alike)))[0])
    four = replace(measured, differences=tuple(d._replace(interval=Interval(-1.0, 1.0)) for d in measured.differences))
    check_text(answer(four)[0])


def test_answer_on_many_candidates_names_the_best_and_the_last(measured):
    sentences = answer(measured)
    assert 2 <= len(sentences) <= 4
    check_text("\n".join(sentences))
    pairs = [*details(measured)]
    assert len(pairs) >= 6 * 4  # four metrics of each pair of four candidates
    assert not {*pairs} & {*sentences}
    check_text("\n".join(pairs))


def test_the_last_are_named_with_indistinguishable_ones(measured):
    """As for the first: no candidate is named last if chance could explain its rank."""

    def first(*alike):
        pairs = [
            d._replace(interval=Interval(-1.0, 1.0) if {d.a, d.b} in alike else Interval(1.0, 2.0))
            for d in measured.differences
        ]
        return answer(replace(some(measured, "a", "b", "c"), differences=tuple(pairs)))[0]

    check_text(first())
    check_text(first({"b", "c"}))
    by_chance = check_text(first({"a", "c"}))
    far = measured["c"].metrics.d2_rms.accuracy.value
    assert f" {far:.3g} m RMS" in by_chance


def test_outliers_are_not_mentioned_if_they_change_no_rank():
    """A cloud that lies entirely on the reference is best by any metric."""
    reference = shapes.terrain(1500, seed=1)[0]
    noisy = reference + np.random.default_rng(0).normal(0, 0.2, reference.shape)
    assert "NMAD" not in answer(compare(reference, {"same": reference, "noisy": noisy}, GIVEN))[0]


def test_no_verdict_on_a_doubtful_registration(measured):
    one = with_registration(some(measured, "a"), "a", result.DOUBTFUL_POSE)
    first, then = answer(one)
    check_text(first)
    assert "--register global" in check_text(then)
    assert "points:FILE" in then
    given = answer(with_registration(some(measured, "a"), "a", result.DOUBTFUL_POSE, method="matrix:T.txt"))[1]
    assert "global" in given and "matrix" not in given  # it was used already
    assert "deformed" not in first + then
    assert "a: doubtful-pose said" in warnings(one)
    pairs = " ".join(details(with_registration(measured, "a", result.FAR_OFF)))
    assert "b is lower than c" in pairs
    assert "a is lower" not in pairs
    assert "lower than a" not in pairs
    three = with_registration(some(measured, "a", "b", "c"), "a", result.DOUBTFUL_POSE)
    first, accuracy, complete, bend = answer(three)
    check_text("\n".join((first, accuracy, complete, bend)))
    for sentence in (accuracy, complete, bend):
        assert "a " not in sentence.split("(")[0].split()


def test_no_bend_is_claimed_if_the_pose_is_undetermined(measured):
    bent = replace(measured["a"].deformation, verdict="non-affine", model="quadratic", p_value=0.001)
    comparison = replace(measured, candidates=(replace(measured["a"], deformation=bent), measured["b"]))
    check_text("\n".join(answer(comparison)))
    left_open = with_registration(comparison, "a", result.UNOBSERVABLE)
    first, *_, bends = answer(left_open)
    check_text(first)
    check_text(bends)
    alone = answer(some(left_open, "a"))
    assert len(alone) == 4
    check_text("\n".join(alone))
    for text in (*alone, *details(left_open), markdown(left_open)):
        assert "is bent" not in text


def test_a_small_overlap_is_reported_with_the_crop_option(measured):
    little = with_registration(some(measured, "a"), "a", result.LOW_OVERLAP, overlap=0.42)
    check_text("\n".join(warnings(little)))
    assert "--crop reference" in " ".join(warnings(little))
    assert "low-overlap said" not in warnings(little)  # not repeated
    check_text("\n".join(answer(little)))
    assert " ".join([*answer(little), *warnings(little)]).count("42") == 1  # the share too
    by_icp = with_registration(little, "a", overlap=0.42, method="icp", weakest_sigma=0.1)
    check_text(answer(by_icp)[-1])
    cropped = replace(little, settings=replace(GIVEN, crop="reference"))  # the recommended crop was applied
    assert "a: low-overlap said" in warnings(cropped)
    assert "--crop reference" not in " ".join(warnings(cropped))


def test_a_cloud_against_itself_coincides():
    points = shapes.terrain(2000, seed=1)[0]
    sentences = answer(compare(points, {"same": points + 1e-13}, GIVEN))
    assert len(sentences) == 2
    assert "e-1" not in check_text("\n".join(sentences))


def test_too_few_points_for_a_surface():
    comparison = compare([[0, 0, 0], [1, 0, 0]], [[[0, 0, 1], [1, 0, 1]]], GIVEN)
    check_text(answer(comparison)[0])
    (name,) = (c.name for c in comparison)
    far = answer(with_registration(comparison, name))[0]
    assert "1 [1, 1]" in check_text(far)


def test_repeated_warnings_are_merged(measured):
    two = with_registration(some(measured, "a", "b"), "a", result.WEAKLY_OBSERVABLE)
    two = with_registration(two, "b", result.WEAKLY_OBSERVABLE)
    assert "a and b: weakly-observable said" in warnings(two)


def test_files_and_notebooks_start_with_the_answer_and_have_all_details(measured):
    text, page = markdown(measured), html(measured)
    for table in (text, page):
        assert table.index("d and a are closest") < table.index("D1 MSE")
        assert table.index("is lower than") > table.index("D1 MSE")
        for label in ("median, signed", "standard deviation", "NMAD"):
            assert label in table
    (line,) = [line for line in text.splitlines() if line.startswith("| D1 MSE |")]
    assert line.count("[") == 8  # one interval per number


def test_words():
    assert join_words(["a"]) == "a"
    assert join_words(["a", "b", "c"]) == "a, b and c"
    assert join_words([*"abcdefghij"]) == "a, b, c, d, e, f, g and 3 others"
    assert (length(0.12345, "m"), length(1234.5, None), length(None, "m")) == ("0.123 m", "1,234", "–")
    assert shorten_name("reconstruction_2024-05-17", 15) == "reconst…4-05-17"
    assert shorten_name("short", 15) == "short"
    assert shorten_name("two\nlines\udcff", 15) == "two?lines?"
    assert shorten_name("測量點雲的名字", 9) == "測量…名字"
    assert (columns("a測é"), columns("e\u0301")) == (4, 1)
    assert pad("測", 4, right=True) == "  測"
