"""Texts for users, compared with one golden file.

Tests assert values, codes and verdicts. Texts of the program are passed to `check_text`, error messages to
`check_error`. `wording.txt` next to this module has the texts of each test, and the kinds of messages of each test
function: messages that differ only in numbers and in what they quote are of one kind. After a change of wording run
`make wording` for whole files and read the diff.
"""

import re
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from difflib import unified_diff

import pytest
from data_folder import data_root
from repository import ROOT, TESTS

from pcbench.errors import InputError, one_line

GOLDEN = TESTS / "wording.txt"
_NUMBER = re.compile(r"(?<![\w.])[-+]?\d+(,\d{3})*(\.\d+)?(e[-+]?\d+)?(?![\w])")
_QUOTED = re.compile(r"(?<![^\Wb])'[^']*'(?!\w)")  # not the apostrophe of a possessive; also bytes as b'...'
_HEADING = "== "
_REFUSES = " refuses"

Texts = dict[str, list[str]]
"""The texts of each test, by its node id, and the kinds of messages of each function, by its id and `_REFUSES`."""

_texts: list[str] | None = None
_kinds: list[str] | None = None


def check_text(text: object, *, masked: bool = True) -> str:
    """Compare a text with the golden file after the running test has passed, and return the text.

    Numbers are masked, because they depend on the processor and tests assert them as values. So are runs of spaces,
    which depend on the widths of numbers. The folders of the test and of the repository are always masked.
    """
    assert _texts is not None, "check_text() must be called inside a test"
    unmasked = _without_folders(str(text))
    _texts.append(_stored(re.sub(r" {2,}", "  ", _NUMBER.sub("#", unmasked)) if masked else unmasked))
    return str(text)


@contextmanager
def check_error(error: type[BaseException] = InputError) -> Iterator[pytest.ExceptionInfo[BaseException]]:
    """Expect an error with a message of one printable line, whose kind is one of those of the test function."""
    with pytest.raises(error) as caught:
        yield caught
    assert _kinds is not None, "check_error() must be called inside a test"
    message = str(caught.value)
    assert message == one_line(message)
    _kinds.append(_stored(_NUMBER.sub("#", _QUOTED.sub("'...'", _without_folders(message)))))


def _stored(text: str) -> str:
    text = text.replace("\0", "\\0")  # the golden file is a text file
    return "\n".join(line.rstrip() for line in text.strip().splitlines())


def _without_folders(text: str) -> str:
    # The folder of a test is similar to /tmp/pytest-of-user/pytest-0/popen-gw0/test_name0.
    temporary = re.escape(tempfile.gettempdir())
    text = re.sub(rf"{temporary}/pytest-of-[^/\s]+/pytest-[^/\s]+(/popen-gw\d+)?(/[^/\s:,'\"]+)?", "TMP", text)
    for folder, name in ((data_root(), "DATA"), (ROOT, "ROOT")):
        if folder is not None:
            text = text.replace(str(folder.resolve()), name).replace(str(folder), name)
    return text


@contextmanager
def texts_of(test: str, golden: Texts, renewed: Texts | None) -> Iterator[None]:
    """Collect the texts of a test and compare them with the golden file, or add them to the renewed texts."""
    global _texts, _kinds
    outer, (_texts, _kinds) = (_texts, _kinds), (texts := [], kinds := [])
    function = test.partition("[")[0] + _REFUSES
    try:
        yield
    finally:
        _texts, _kinds = outer
    if renewed is not None:
        add(renewed, {test: texts, function: kinds} if kinds else {test: texts})
        return
    expected = golden.get(test, []), golden.get(function, [])
    new_kinds = [kind for kind in kinds if kind not in expected[1]]
    if texts != expected[0] or new_kinds:
        before, after = _lines([*expected[0], *expected[1]]), _lines([*texts, *expected[1], *new_kinds])
        lines = unified_diff(before, after, "wording.txt", "current text", lineterm="", n=9)
        pytest.fail("\n".join(["the wording has changed (`make wording` renews it):", *lines]), pytrace=False)


def add(texts: Texts, more: Texts) -> None:
    """Add the texts of more tests; kinds of messages of one function come from several tests."""
    for test, added in more.items():
        texts[test] = sorted({*texts.get(test, []), *added}) if test.endswith(_REFUSES) else added


def read() -> Texts:
    """Read the golden file."""
    result: Texts = {}
    lines = GOLDEN.read_text(encoding="utf-8").splitlines() if GOLDEN.exists() else []
    texts: list[str] = []
    for line in lines:
        if line.startswith(_HEADING):
            result[line.removeprefix(_HEADING)] = texts = []
        elif line.startswith("- "):
            texts.append(line[2:])
        elif texts:
            texts[-1] += "\n" + line[2:]
    return {test: [text.rstrip("\n") for text in texts] for test, texts in result.items()}


def renew(renewed: Texts) -> None:
    """Write the golden file; texts of tests that did not run stay, texts of deleted tests are removed."""
    texts = {test: texts for test, texts in {**read(), **renewed}.items() if texts and not is_stale(test)}
    blocks = ["\n".join([_HEADING + test, *_lines(texts[test])]) for test in sorted(texts)]
    GOLDEN.write_text("\n\n".join(blocks) + "\n", encoding="utf-8")


def is_stale(test: str) -> bool:
    """Whether the test of a node id no longer exists in its file."""
    file, _, name = test.removesuffix(_REFUSES).partition("::")
    function = name.rpartition("::")[2].partition("[")[0]
    path = ROOT / file
    return not path.is_file() or f"def {function}(" not in path.read_text(encoding="utf-8")


def _lines(texts: Iterable[str]) -> list[str]:
    return [line for text in texts for line in ("- " + text.replace("\n", "\n  ")).splitlines()]
