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
from pcbench.report.notes import details, remarks, warnings
from pcbench.report.table import html, markdown
from pcbench.report.words import columns, join_words, length, pad, shorten_name

NO_REGISTRATION = Settings(register="none")


@pytest.fixture(scope="module")
def comparison():
    """Compare four candidates: a is near, b is noisy, c is near with outliers, d covers half."""
    reference = Cloud(shapes.terrain(3000, seed=1)[0], unit="m")
    a = shapes.terrain(2000, seed=2)[0]
    rng = np.random.default_rng(5)
    c = shapes.terrain(2000, seed=4)[0]
    c[:60, 2] += rng.uniform(3, 6, 60)
    d = shapes.terrain(2000, seed=6)[0]
    clouds = {"a": a, "b": a + rng.normal(0, 0.3, a.shape), "c": c, "d": d[d[:, 0] < np.median(d[:, 0])]}
    return compare(reference, clouds, NO_REGISTRATION)


def select_candidates(comparison, *names):
    candidates = tuple(comparison[name] for name in names)
    differences = tuple(d for d in comparison.differences if {d.a, d.b} <= set(names))
    return replace(comparison, candidates=candidates, differences=differences)


def with_registration(comparison, name, *codes, **fields):
    candidates = []
    for c in comparison:
        if c.name == name:
            notices = tuple(Notice(code, f"{code} said") for code in codes)
            c = replace(c, registration=replace(c.registration, warnings=notices, **{"method": "icp", **fields}))
        candidates.append(c)
    return replace(comparison, candidates=tuple(candidates))


def test_answer_on_one_candidate(comparison):
    accuracy, completeness, deformation, pose = answer(select_candidates(comparison, "b"))
    b = comparison["b"]
    rms = b.metrics.d2_rms.accuracy.value
    interval = b.metrics.d2_mse.accuracy.interval
    assert f"b lies {rms:.3g} m [{interval.low**0.5:.3g}, {interval.high**0.5:.3g}] RMS" in check_text(accuracy)
    assert f"{b.metrics.d2_mse.accuracy.floor**0.5:.3g} m" in accuracy
    assert f"{b.metrics.mean_distance.completeness.value:.3g} m" in check_text(completeness)
    assert check_text(deformation) == f"{b.deformation.sentence('b', 'm')}."
    assert f"{b.registration.overlap:.1%}" in check_text(pose)


def test_missing_surface_is_reported_with_its_place(comparison):
    completeness = answer(select_candidates(comparison, "d"))[1]
    hausdorff = comparison["d"].metrics.hausdorff.completeness
    assert f"({hausdorff.worst_point[0]:.1f}, " in check_text(completeness)
    check_text(answer(select_candidates(comparison, "a"))[1])


def test_outliers_are_distinguished_from_an_inaccurate_surface(comparison):
    assert "NMAD" in check_text(answer(select_candidates(comparison, "c"))[0])
    assert "NMAD" not in answer(select_candidates(comparison, "b"))[0]
    # c's outliers make its RMS the largest; all its other points are better than b's.
    assert "NMAD" in check_text(answer(select_candidates(comparison, "b", "c"))[0])


def test_candidates_are_distinguished_by_paired_differences(comparison):
    two_candidates = select_candidates(comparison, "a", "b")
    check_text(answer(two_candidates)[0])
    # The intervals of both are unchanged; only the interval of the difference now contains 0.
    differences = [d._replace(interval=Interval(-1.0, 1.0)) for d in two_candidates.differences]
    check_text(answer(replace(two_candidates, differences=tuple(differences)))[0])
    undecided = replace(
        comparison, differences=tuple(d._replace(interval=Interval(-1.0, 1.0)) for d in comparison.differences)
    )
    check_text(answer(undecided)[0])


def test_answer_on_many_candidates_names_the_best_and_the_last(comparison):
    sentences = answer(comparison)
    assert 2 <= len(sentences) <= 4
    check_text("\n".join(sentences))
    detail_sentences = [*details(comparison)]
    assert len(detail_sentences) >= 6 * 4  # four metrics of each pair of four candidates
    assert not {*detail_sentences} & {*sentences}
    check_text("\n".join(detail_sentences))


def test_each_floor_is_stated_if_they_differ(comparison):
    """The half cloud d has another floor of completeness than a."""
    floors = [comparison[name].metrics.mean_distance.completeness.floor for name in ("a", "d")]
    named = dict(zip(("a", "d"), (f"{floor:.3g} m" for floor in floors), strict=True))
    sentences = " ".join(answer(select_candidates(comparison, "a", "d")))
    assert f"mean distance from the reference (floors {named['a']} and {named['d']})" in sentences
    every = [c.metrics.mean_distance.completeness.floor for c in comparison]
    assert f"(floors {min(every):.3g} m to {max(every):.3g} m)" in " ".join(answer(comparison))
    equal = tuple(replace(comparison["a"], name=name) for name in ("a", "d"))
    (ranking,) = [s for s in answer(replace(comparison, candidates=equal)) if "mean distance from" in s]
    assert f"(floor {named['a']})" in ranking


def test_candidates_indistinguishable_from_the_last_are_named_with_it(comparison):
    """As for the first: no candidate is named last if chance could explain its rank."""

    def describe_accuracy(*indistinguishable_pairs):
        differences = [
            d._replace(interval=Interval(-1.0, 1.0) if {d.a, d.b} in indistinguishable_pairs else Interval(1.0, 2.0))
            for d in comparison.differences
        ]
        return answer(replace(select_candidates(comparison, "a", "b", "c"), differences=tuple(differences)))[0]

    check_text(describe_accuracy())
    check_text(describe_accuracy({"b", "c"}))
    # c is worse than b, and not distinguished from a only because its interval is wide.
    sentence = check_text(describe_accuracy({"a", "c"}))
    assert f"c ({comparison['c'].metrics.d2_rms.accuracy.value:.3g} m) cannot be ranked" in sentence


def test_outliers_are_not_mentioned_if_they_change_no_rank():
    """A cloud that lies entirely on the reference is best by any metric."""
    reference = shapes.terrain(1500, seed=1)[0]
    noisy = reference + np.random.default_rng(0).normal(0, 0.2, reference.shape)
    assert "NMAD" not in answer(compare(reference, {"same": reference, "noisy": noisy}, NO_REGISTRATION))[0]


def test_no_verdict_on_a_doubtful_registration(comparison):
    one_candidate = with_registration(select_candidates(comparison, "a"), "a", result.DOUBTFUL_POSE)
    statement, advice = answer(one_candidate)
    check_text(statement)
    assert "--register global" in check_text(advice)
    assert "points:FILE" in advice
    advice_after_global = answer(
        with_registration(select_candidates(comparison, "a"), "a", result.DOUBTFUL_POSE, method="global")
    )[1]
    assert "matrix" in advice_after_global and "global (" not in advice_after_global  # it was used already
    assert "deformed" not in statement + advice
    assert "a: doubtful-pose said" in warnings(one_candidate)
    detail_text = " ".join(details(with_registration(comparison, "a", result.FAR_OFF)))
    assert "b is lower than c" in detail_text
    assert "a is lower" not in detail_text
    assert "lower than a" not in detail_text
    three_candidates = with_registration(select_candidates(comparison, "a", "b", "c"), "a", result.DOUBTFUL_POSE)
    statement, accuracy, completeness, deformation = answer(three_candidates)
    check_text("\n".join((statement, accuracy, completeness, deformation)))
    for sentence in (accuracy, completeness, deformation):
        assert "a " not in sentence.split("(")[0].split()


@pytest.mark.parametrize("method", ["none", "matrix:T.txt"])
def test_a_given_pose_is_ranked_and_its_doubt_is_a_note(comparison, method):
    """The user vouches for it, as in a benchmark; only what cannot be meant stays a warning."""
    codes = (result.DOUBTFUL_POSE, result.UNOBSERVABLE)
    doubted = with_registration(select_candidates(comparison, "a", "b"), "a", *codes, method=method)
    assert doubted["a"].registration.doubtful and doubted["a"].registration.is_ranked
    plain = select_candidates(comparison, "a", "b")
    assert answer(doubted) == answer(plain)
    assert answer(select_candidates(doubted, "a"))[0] == answer(select_candidates(comparison, "a"))[0]
    assert any("b by" in text for text in details(doubted))
    assert not any("said" in text for text in warnings(doubted))
    notes = [text for text in remarks(doubted) if "said" in text]
    assert "doubtful-pose said" in check_text("\n".join(notes))
    far_off = with_registration(plain, "a", result.FAR_OFF, method=method)
    assert answer(far_off) == answer(plain)
    assert "a: far-off said" in warnings(far_off)


def test_no_deformation_is_claimed_if_the_pose_is_undetermined(comparison):
    deformation = replace(comparison["a"].deformation, verdict="non-affine", model="quadratic", p_value=0.001)
    bent_comparison = replace(
        comparison, candidates=(replace(comparison["a"], deformation=deformation), comparison["b"])
    )
    check_text("\n".join(answer(bent_comparison)))
    undetermined = with_registration(bent_comparison, "a", result.UNOBSERVABLE)
    first, *_, deformation_sentence = answer(undetermined)
    check_text(first)
    check_text(deformation_sentence)
    sentences = answer(select_candidates(undetermined, "a"))
    assert len(sentences) == 4
    check_text("\n".join(sentences))
    for text in (*sentences, *details(undetermined), markdown(undetermined)):
        assert "is bent" not in text


def test_the_bounding_box_is_recommended_only_if_points_are_outside():
    points = shapes.terrain(3000, seed=1)[0]
    wide = points * [2.0, 2.0, 1.0]
    tall = np.concatenate([points, points + [0, 0, 3.0]])  # another surface above, inside the box of its highest point
    reference = np.concatenate([points, [[*points[0, :2], 100.0]]])
    text = " ".join(warnings(compare(points, {"wide": wide}, NO_REGISTRATION)))
    assert "--crop reference" in text
    text = " ".join(warnings(compare(reference, {"tall": tall}, NO_REGISTRATION)))
    assert "--crop polygon:FILE measures only" in check_text(text)
    assert "--crop reference" not in text


@pytest.mark.with_deformation
def test_a_small_overlap_is_reported_with_the_crop_option():
    points = shapes.terrain(3000, seed=1)[0]
    wide = compare(points, {"a": shapes.terrain(3000, seed=2)[0] * [2.0, 2.0, 1.0]}, NO_REGISTRATION)
    small_overlap = with_registration(wide, "a", result.LOW_OVERLAP, overlap=0.42)
    check_text("\n".join(warnings(small_overlap)))
    assert "--crop reference" in " ".join(warnings(small_overlap))
    assert "low-overlap said" not in warnings(small_overlap)  # not repeated
    check_text("\n".join(answer(small_overlap)))
    assert " ".join([*answer(small_overlap), *warnings(small_overlap)]).count("42") == 1  # the share too
    with_icp = with_registration(small_overlap, "a", overlap=0.42, method="icp", weakest_sigma=0.1)
    check_text(answer(with_icp)[-1])
    # The recommended crop was applied.
    cropped = replace(small_overlap, settings=replace(NO_REGISTRATION, crop="reference"))
    assert "a: low-overlap said" in warnings(cropped)
    assert "--crop reference" not in " ".join(warnings(cropped))


def test_a_cloud_coincides_with_itself():
    points = shapes.terrain(2000, seed=1)[0]
    sentences = answer(compare(points, {"same": points + 1e-13}, NO_REGISTRATION))
    assert len(sentences) == 2
    assert "e-1" not in check_text("\n".join(sentences))


def test_too_few_points_for_a_surface():
    comparison = compare([[0, 0, 0], [1, 0, 0]], [[[0, 0, 1], [1, 0, 1]]], NO_REGISTRATION)
    check_text(answer(comparison)[0])
    (name,) = (c.name for c in comparison)
    accuracy = answer(with_registration(comparison, name))[0]
    assert "1 [1, 1]" in check_text(accuracy)


def test_repeated_warnings_are_merged(comparison):
    two_candidates = with_registration(select_candidates(comparison, "a", "b"), "a", result.WEAKLY_OBSERVABLE)
    two_candidates = with_registration(two_candidates, "b", result.WEAKLY_OBSERVABLE)
    assert "a and b: weakly-observable said" in warnings(two_candidates)


def test_files_and_notebooks_start_with_the_answer_and_have_all_details(comparison):
    text, page = markdown(comparison), html(comparison)
    for table in (text, page):
        assert table.index("d and a are closest") < table.index("D1 MSE")
        assert table.index("is lower than") > table.index("D1 MSE")
        for label in ("median, signed", "standard deviation", "NMAD"):
            assert label in table
    (line,) = [line for line in text.splitlines() if line.startswith("| D1 MSE |")]
    assert line.count("[") == 8  # one interval per number


def test_lists_lengths_and_names_are_formatted():
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
