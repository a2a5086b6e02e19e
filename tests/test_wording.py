"""The golden file of texts: comparison, masking and renewal."""

from contextlib import nullcontext

import pytest
import wording
from repository import ROOT
from wording import check_error, check_text, texts_of

from pcbench.errors import InputError

TEST_ID = "tests/test_wording.py::test_texts_are_compared_after_a_test_has_passed"


def test_masking_of_numbers_and_folders(tmp_path):
    check_text(f"{tmp_path}/a.ply: 1,270,820 points,   spacing 2.31e-1 m, d2 of T_a_b4 at (-3, 4.5, 6)")
    check_text("4 of 5 points", masked=False)
    with check_error():
        raise InputError(f"{ROOT}/README.md: expected 3 numbers, got 'four'")


def test_texts_are_compared_after_a_test_has_passed():
    golden = {TEST_ID: ["one of #", "two\n\nlines"]}
    with texts_of(TEST_ID, golden, None):
        check_text("one of 12")
        check_text("two\n\nlines")
    for texts in (["one of 12"], ["one of 12", "two\n\nlines", "three"], ["another", "two\n\nlines"]):
        with pytest.raises(pytest.fail.Exception, match="make wording"), texts_of(TEST_ID, golden, None):
            for text in texts:
                check_text(text)


def test_messages_of_a_known_kind_pass():
    """The kinds of a function hold for each of its cases; messages of one kind differ in numbers and quoted values."""
    golden = {f"{TEST_ID} refuses": ["expected #, got '...'", "another kind"]}
    for message, known in (("expected 3, got 'x'", True), ("expected 4, got 'y'", True), ("expected 4", False)):
        expectation = nullcontext() if known else pytest.raises(pytest.fail.Exception, match="make wording")
        with expectation, texts_of(f"{TEST_ID}[case]", golden, None), check_error():
            raise InputError(message)
    renewed = {}
    for message in ("expected 3", "one", "expected 5"):
        with texts_of(f"{TEST_ID}[{message}]", {}, renewed), check_error():
            raise InputError(message)
    assert renewed[f"{TEST_ID} refuses"] == ["expected #", "one"]


def test_failure_of_the_test_takes_precedence():
    with pytest.raises(ZeroDivisionError), texts_of(TEST_ID, {TEST_ID: ["never passed"]}, None):
        1 / 0  # noqa: B018


def test_renewal_keeps_tests_that_did_not_run_and_drops_deleted_ones(tmp_path, monkeypatch):
    monkeypatch.setattr(wording, "GOLDEN", tmp_path / "wording.txt")
    deleted_test, test_of_deleted_file = (
        TEST_ID.replace("texts_are_compared_after_a_test_has_passed", "renewing_keeps"),
        "tests/gone.py::test_it",
    )
    assert wording.is_stale(deleted_test) and wording.is_stale(test_of_deleted_file) and not wording.is_stale(TEST_ID)
    other_test = "tests/test_wording.py::test_failure_of_the_test_takes_precedence"
    wording.renew({TEST_ID: ["one", "two\n\nlines\n  and - an indent"], test_of_deleted_file: ["x"], other_test: ["y"]})
    wording.renew({other_test: []})
    assert wording.read() == {TEST_ID: ["one", "two\n\nlines\n  and - an indent"]}


def test_golden_file_has_no_texts_of_deleted_tests():
    assert not [test for test in wording.read() if wording.is_stale(test)]
