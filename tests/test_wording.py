"""The golden file of texts: what is compared, what is masked, and what renewing it keeps."""

import pytest
import wording
from repository import ROOT
from wording import refused, said, spoken_by

from pcbench.errors import InputError

HERE = "tests/test_wording.py::test_texts_are_compared_once_a_test_has_passed"


def test_numbers_and_folders_are_masked_in_texts_and_numbers_stay_in_errors(tmp_path):
    said(f"{tmp_path}/a.ply: 1,270,820 points,   spacing 2.31e-1 m, d2 of T_a_b4 at (-3, 4.5, 6)")
    said("4 of 5 points", masked=False)
    with refused():
        raise InputError(f"{ROOT}/README.md: expected 3 numbers, got 4")


def test_texts_are_compared_once_a_test_has_passed():
    golden = {HERE: ["one of #", "two\n\nlines"]}
    with spoken_by(HERE, golden, None):
        said("one of 12")
        said("two\n\nlines")
    for texts in (["one of 12"], ["one of 12", "two\n\nlines", "three"], ["another", "two\n\nlines"]):
        with pytest.raises(pytest.fail.Exception, match="make wording"), spoken_by(HERE, golden, None):
            for text in texts:
                said(text)


def test_a_failure_of_the_test_itself_comes_first():
    with pytest.raises(ZeroDivisionError), spoken_by(HERE, {HERE: ["never said"]}, None):
        1 / 0  # noqa: B018


def test_renewing_keeps_what_did_not_run_and_drops_what_is_no_more(tmp_path, monkeypatch):
    monkeypatch.setattr(wording, "GOLDEN", tmp_path / "wording.txt")
    again, gone = HERE.replace("texts_are_compared_once_a_test_has_passed", "renewing_keeps"), "tests/gone.py::test_it"
    assert wording.is_stale(again) and wording.is_stale(gone) and not wording.is_stale(HERE)
    other = "tests/test_wording.py::test_a_failure_of_the_test_itself_comes_first"
    wording.renew({HERE: ["one", "two\n\nlines\n  and - an indent"], gone: ["x"], other: ["y"]})
    wording.renew({other: []})
    assert wording.read() == {HERE: ["one", "two\n\nlines\n  and - an indent"]}


def test_no_text_of_a_test_that_is_no_more_is_kept():
    assert not [test for test in wording.read() if wording.is_stale(test)]
