"""The answer in words: what is claimed, what is withheld, and what has to be said before any number."""

from dataclasses import replace

import numpy as np
import pytest
import shapes

from pcbench import Cloud, Settings, compare
from pcbench.errors import Notice
from pcbench.measure.intervals import Interval
from pcbench.registration import result
from pcbench.report.answer import answer
from pcbench.report.notes import details, warnings
from pcbench.report.table import html, markdown
from pcbench.report.words import columns, joined, length, padded, shortened

GIVEN = Settings(register="none")


@pytest.fixture(scope="module")
def measured():
    """a is near, b is noisy, c is near with strays, d covers half."""
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


def test_one_candidate_how_far_how_complete_bent_or_not_and_the_pose(measured):
    far, complete, bend, pose = answer(some(measured, "b"))
    b = measured["b"]
    off = b.metrics.d2_rms.accuracy.value
    ends = b.metrics.d2_mse.accuracy.interval
    assert far.startswith(
        f"b lies {off:.3g} m [{ends.low**0.5:.3g}, {ends.high**0.5:.3g}] RMS off the reference's surf"
    )
    assert f"error-free points would lie {b.metrics.d2_mse.accuracy.floor**0.5:.3g} m off" in far
    assert f"{b.metrics.mean_distance.completeness.value:.3g} m, as its density explains" in complete
    assert bend == f"{b.deformation.sentence('b', 'm')}."
    assert f"{b.registration.overlap:.1%} of it lies on the reference" in pose


def test_what_is_missing_is_said_with_its_place(measured):
    complete = answer(some(measured, "d"))[1]
    worst = measured["d"].metrics.hausdorff.completeness
    assert "it leaves parts out" in complete
    assert f"at ({worst.worst_point[0]:.1f}, " in complete
    assert "leaves parts out" not in answer(some(measured, "a"))[1]


def test_strays_do_not_pass_for_a_bad_surface(measured):
    assert "m by the NMAD, which strays do not move" in answer(some(measured, "c"))[0]
    assert "NMAD" not in answer(some(measured, "b"))[0]
    # c's strays make its RMS the largest; all its other points are better than b's.
    said = answer(some(measured, "b", "c"))[0]
    assert said.startswith("b is closer to the reference's surface than c")
    assert "but by the NMAD, which strays do not move, it is c (" in said


def test_candidates_are_told_apart_by_their_paired_differences(measured):
    two = some(measured, "a", "b")
    assert answer(two)[0].startswith("a is closer to the reference's surface than b")
    # The intervals of both stay as they are; only the difference now contains 0.
    alike = [d._replace(interval=Interval(-1.0, 1.0)) for d in two.differences]
    said = answer(replace(two, differences=tuple(alike)))[0]
    assert said.startswith("Which is closer to the reference's surface cannot be told: a has ")
    four = replace(measured, differences=tuple(d._replace(interval=Interval(-1.0, 1.0)) for d in measured.differences))
    assert answer(four)[0].startswith("Which is closest to the reference's surface cannot be told")


def test_of_many_the_best_and_the_last_are_named_and_no_pair_is_spelled_out(measured):
    said = answer(measured)
    assert 2 <= len(said) <= 4
    assert said[0].startswith("d and a are closest to the reference's surface and cannot be told apart: ")
    assert "c is last" in said[0]
    assert "d is last" in said[1]
    assert "d leaves parts of it out" in said[1]
    assert not any("is lower than" in sentence for sentence in said)
    assert sum("is lower than" in s or "cannot be told apart" in s for s in details(measured)) == 6 * 4
    assert "ot deformed: " in said[2]


def test_the_last_are_named_with_those_that_they_cannot_be_told_from(measured):
    """What is said of the first holds of the last: nobody is last by chance."""

    def said(*alike):
        pairs = [
            d._replace(interval=Interval(-1.0, 1.0) if {d.a, d.b} in alike else Interval(1.0, 2.0))
            for d in measured.differences
        ]
        return answer(replace(some(measured, "a", "b", "c"), differences=tuple(pairs)))[0]

    assert "then b" in said()
    assert "; c is last (" in said()
    assert "; b and c are last and cannot be told apart (" in said({"b", "c"})
    assert "then b" not in said({"b", "c"})
    by_chance = said({"a", "c"})
    assert by_chance.startswith("a and c are closest")
    assert "last" not in by_chance
    far = measured["c"].metrics.d2_rms.accuracy.value
    assert f" to {far:.3g} m RMS" in by_chance


def test_strays_are_no_matter_where_they_change_no_order():
    """A cloud of which all lies on the reference is best by any measure."""
    reference = shapes.terrain(1500, seed=1)[0]
    noisy = reference + np.random.default_rng(0).normal(0, 0.2, reference.shape)
    assert "NMAD" not in answer(compare(reference, {"same": reference, "noisy": noisy}, GIVEN))[0]


def test_no_verdict_on_a_doubtful_registration(measured):
    one = with_registration(some(measured, "a"), "a", result.DOUBTFUL_POSE)
    first, then = answer(one)
    assert first.startswith("The registration of a is doubtful")
    assert "no verdict is given" in first
    assert "--register global" in then
    assert "points:FILE" in then
    given = answer(with_registration(some(measured, "a"), "a", result.DOUBTFUL_POSE, method="matrix:T.txt"))[1]
    assert "global" in given and "matrix" not in given  # it was tried
    assert "deformed" not in first + then
    assert "a: doubtful-pose said" in warnings(one)
    pairs = " ".join(details(with_registration(measured, "a", result.FAR_OFF)))
    assert "b is lower than c" in pairs
    assert "a is lower" not in pairs
    assert "lower than a" not in pairs
    three = with_registration(some(measured, "a", "b", "c"), "a", result.DOUBTFUL_POSE)
    first, accuracy, complete, bend = answer(three)
    assert first.startswith("The registration of a is doubtful")
    assert "what follows leaves it out" in first
    assert accuracy.startswith("b is closer")
    for sentence in (accuracy, complete, bend):
        assert "a " not in sentence.split("(")[0].split()


def test_no_bend_is_claimed_where_the_geometry_leaves_the_pose_open(measured):
    bent = replace(measured["a"].deformation, verdict="non-affine", model="quadratic", p_value=0.001)
    comparison = replace(measured, candidates=(replace(measured["a"], deformation=bent), measured["b"]))
    assert "Bent: a" in " ".join(answer(comparison))
    left_open = with_registration(comparison, "a", result.UNOBSERVABLE)
    first, *_, bends = answer(left_open)
    assert first.startswith("The geometry does not fix the pose of a")
    assert "ndecided whether deformed: a" in bends
    assert "Bent" not in bends
    alone = answer(some(left_open, "a"))
    assert len(alone) == 4
    for said in (alone, details(left_open), [markdown(left_open)]):
        assert "is bent" not in " ".join(said)


def test_a_small_overlap_is_said_and_names_the_crop(measured):
    little = with_registration(some(measured, "a"), "a", result.LOW_OVERLAP, overlap=0.42)
    (said,) = [text for text in warnings(little) if text.startswith("a: the distances are those of all of it")]
    assert "--crop reference" in said
    assert "low-overlap said" not in " ".join(warnings(little))  # once is enough
    assert answer(little)[0].startswith("Only 42% of a lies on the reference, and all of it lies ")
    assert " ".join([*answer(little), *warnings(little)]).count("42") == 1  # the share too
    assert answer(little)[-1].startswith("Taken in the pose as it is; ")
    by_icp = with_registration(little, "a", overlap=0.42, method="icp", weakest_sigma=0.1)
    assert answer(by_icp)[-1].startswith("Registered by icp: the pose is known to 0.1")
    cropped = replace(little, settings=replace(GIVEN, crop="reference"))  # what it asks for was done
    assert "a: low-overlap said" in warnings(cropped)
    assert "--crop reference" not in " ".join(warnings(cropped))


def test_a_cloud_against_itself_coincides():
    points = shapes.terrain(2000, seed=1)[0]
    said = answer(compare(points, {"same": points + 1e-13}, GIVEN))
    assert said[0] == "same coincides with the reference: all distances are rounding."
    assert len(said) == 2
    assert "e-1" not in " ".join(said)


def test_too_few_points_for_a_surface():
    comparison = compare([[0, 0, 0], [1, 0, 0]], [[[0, 0, 1], [1, 0, 1]]], GIVEN)
    assert answer(comparison)[0].startswith("The registration of candidate_1 is doubtful")
    (name,) = (c.name for c in comparison)
    far = answer(with_registration(comparison, name))[0]
    assert far.startswith("candidate_1 lies 1 [1, 1] on average off the reference's points")


def test_warnings_of_several_stand_once(measured):
    two = with_registration(some(measured, "a", "b"), "a", result.WEAKLY_OBSERVABLE)
    two = with_registration(two, "b", result.WEAKLY_OBSERVABLE)
    assert "a and b: weakly-observable said" in warnings(two)


def test_files_and_notebooks_start_with_the_answer_and_keep_everything(measured):
    text, page = markdown(measured), html(measured)
    for said in (text, page):
        assert said.index("d and a are closest to the reference") < said.index("D1 MSE")
        assert said.index("is lower than") > said.index("D1 MSE")
        for label in ("median, signed", "standard deviation", "NMAD"):
            assert label in said
    (line,) = [line for line in text.splitlines() if line.startswith("| D1 MSE |")]
    assert line.count("[") == 8  # an interval of each number


def test_words():
    assert joined(["a"]) == "a"
    assert joined(["a", "b", "c"]) == "a, b and c"
    assert joined([*"abcdefghij"]) == "a, b, c, d, e, f, g and 3 others"
    assert (length(0.12345, "m"), length(1234.5, None), length(None, "m")) == ("0.123 m", "1,234", "–")
    assert shortened("reconstruction_2024-05-17", 15) == "reconst…4-05-17"
    assert shortened("short", 15) == "short"
    assert shortened("two\nlines\udcff", 15) == "two?lines?"
    assert shortened("測量點雲的名字", 9) == "測量…名字"
    assert (columns("a測é"), columns("e\u0301")) == (4, 1)
    assert padded("測", 4, right=True) == "  測"
