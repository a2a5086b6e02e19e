"""Messages of errors and notices, whatever the input that they quote."""

import pytest

from pcbench.errors import InputError, MissingExtra, Notice, did_you_mean, one_line


def test_messages_are_one_printable_line():
    text = "a\x1b]0;title\x07b\nc\u202ed \t e"
    assert str(InputError(text)) == one_line(text) == Notice("code", text).text == "a?]0;title?b c?d e"
    assert one_line("\udcff.ply") == "\udcff.ply"  # a file name that is no Unicode


def test_a_long_message_keeps_its_start_and_its_remedy():
    message = str(InputError(f"cloud.ply: expected x, got {'y' * 5000}: rename the properties"))
    assert len(message) == 1000
    assert message.startswith("cloud.ply: expected x, got yyy") and message.endswith("yyy: rename the properties")
    assert " ... " in message


@pytest.mark.parametrize("length", [999, 1000])
def test_a_message_that_is_not_too_long_stays_complete(length):
    assert str(InputError("x" * length)) == "x" * length


def test_the_error_of_a_missing_library_is_cleaned_too():
    assert "\x1b" not in str(MissingExtra("open3d", "open3d", reason="cannot load \x1b[31m"))


def test_similar_names_are_suggested():
    assert did_you_mean("Presets", ["preset", "crop", "presence"]) == "; did you mean preset or presence?"
    assert did_you_mean("x", ["preset"]) == did_you_mean("x", []) == ""
