"""The budget and the changes in the answer, on the page and in comparison.json."""

from dataclasses import replace

import numpy as np
import pytest
from wording import check_text

from pcbench import Cloud, Settings, compare
from pcbench.changes import ADDED, MOVED, REMOVED, Change, Changes
from pcbench.measure.results import ARROWS
from pcbench.report.answer import answer
from pcbench.report.html.budget import bars, change_rows
from pcbench.report.notes import details
from pcbench.report.read import read_report

OUTLINE = ((0.0, 0.0), (2.0, 0.0), (2.0, 2.0))
RAISED = Change(MOVED, (1.0, 2.0, 0.5), OUTLINE, 12.4, 3.8, 0.31, 0.35, (0.0, 0.01, 0.31), 40, 38, 1e-9)
LOWERED = replace(RAISED, motion=(0.0, 0.0, -0.2))
SHIFTED = replace(RAISED, motion=(3.0, 4.0, 0.0))
ALONG_NORMALS = replace(RAISED, motion=None, mean=-0.1)
NEW = replace(RAISED, kind=ADDED, volume=None, mean=None, peak=None, motion=None, points_reference=0)
GONE = replace(NEW, kind=REMOVED, points_reference=40, points_candidate=0)
CLAIMS = ("not deformed", "equals the reference", "about as far as error-free points")


def ground(seed, size=1600):
    x, y = np.random.default_rng(seed).uniform(-10, 10, (2, size))
    noise = np.random.default_rng(seed + 100).normal(0, 0.02, size)
    return np.column_stack([x, y, 0.5 * np.sin(x / 3) + 0.4 * np.cos(y / 4) + noise])


@pytest.fixture(scope="module")
def comparison():
    """Compare ground with itself sampled anew, lowered, with outliers, and with a raised disc."""
    lowered, outliers, raised = ground(2), ground(3), ground(4)
    lowered[:, 2] -= 0.05
    outliers[::40, 2] += np.random.default_rng(5).uniform(0.2, 0.6, 40)
    raised[np.hypot(*raised[:, :2].T) < 2, 2] += 0.5
    clouds = {"anew": ground(1), "lowered": lowered, "outliers": outliers, "raised": raised}
    return compare(Cloud(ground(0), unit="m"), clouds, Settings(register="none"))


def only(comparison, name, **fields):
    return replace(comparison, candidates=(replace(comparison[name], **fields),), differences=())


def with_changes(comparison, name, *found):
    return only(comparison, name, changes=Changes(found, np.zeros(0, np.int32), np.zeros(0, np.int32)))


@pytest.mark.parametrize("name", ["anew", "lowered", "outliers", "raised"])
def test_first_line_names_the_largest_parts(comparison, name):
    check_text(answer(only(comparison, name))[0])


def test_several_candidates_name_their_largest_part(comparison):
    check_text("\n".join(answer(comparison)))


def test_no_claim_of_equality_where_noise_does_not_explain_the_distances(comparison):
    """Whatever the verdict: the words for equality need a budget that is noise, and no changes."""
    for candidate in comparison:
        verdicts = [
            candidate.deformation,
            replace(candidate.deformation, verdict="none", conditional_verdict=None, warnings=()),
            replace(candidate.deformation, verdict="none", conditional_verdict=None, warnings=(), remaining_rms=0.0),
            replace(candidate.deformation, verdict="undecided", conditional_verdict="none"),
        ]
        for deformation in verdicts:
            trusted = replace(candidate.registration, warnings=())
            one = only(comparison, candidate.name, deformation=deformation, registration=trusted)
            two = replace(comparison, candidates=(comparison["raised"], *one.candidates))
            for texts in (answer(one), list(details(one)), answer(two)):
                said = any(claim in " ".join(texts) for claim in CLAIMS)
                assert not said or candidate.is_noise
    assert [candidate.is_noise for candidate in comparison] == [True, False, False, False]
    assert "about as far as error-free points" in answer(only(comparison, "anew"))[0]
    assert "about as far" not in answer(with_changes(comparison, "anew", RAISED))[0]


def test_changes_are_listed(comparison):
    check_text("\n".join(answer(with_changes(comparison, "anew", RAISED))))
    kinds = (LOWERED, SHIFTED, ALONG_NORMALS, NEW, GONE)
    many = with_changes(comparison, "anew", *kinds)
    assert len(answer(many)) == 5
    for row in change_rows(many):
        check_text(" ".join(map(str, row)), masked=False)
    check_text(answer(many)[1], masked=False)
    check_text(answer(replace(many, candidates=(*many.candidates, comparison["lowered"])))[1])
    unknown = replace(many, reference=replace(comparison.reference, unit=None))
    check_text(answer(unknown)[1], masked=False)


def test_bars_show_all_of_d2(comparison):
    for is_wide, count in ((False, 8), (True, 4)):
        found = bars(comparison, is_wide=is_wide)
        assert len(found) == count
        for bar in found:
            assert sum(part.width for part in bar.segments) == pytest.approx(100, abs=0.05)  # widths have two digits
    check_text(found[1].description)
    same = compare(ground(0), ground(0), Settings(register="none"))
    assert bars(same, is_wide=False) == []


def test_budget_and_changes_are_read_back(comparison, tmp_path):
    saved = with_changes(comparison, "lowered", SHIFTED, GONE)
    saved.save(tmp_path / "report", figures=False)
    read = read_report(tmp_path / "report").candidates[0]
    written = saved.candidates[0]
    assert read.changes == written.changes.found
    assert read.budget == written.budget
    for way in ARROWS:
        assert read.budget[way].is_noise == written.budget[way].is_noise
    page = (tmp_path / "report" / "report.html").read_text(encoding="utf-8")
    assert 'id="budget"' in page and "moved by 5 m" in page
