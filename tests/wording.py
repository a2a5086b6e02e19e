"""Texts for users, compared with one golden file.

Tests assert values, codes and verdicts. Texts of the program are passed to `check_text`, error messages to
`check_error`. The texts of each test are in `wording.txt` next to this module. After a change of wording run
`make wording` and read the diff.
"""

import re
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from difflib import unified_diff

import pytest
from data_folder import data_root
from repository import ROOT, TESTS

from pcbench.errors import InputError

GOLDEN = TESTS / "wording.txt"
_NUMBER = re.compile(r"(?<![\w.])[-+]?\d+(,\d{3})*(\.\d+)?(e[-+]?\d+)?(?![\w])")
_HEADING = "== "

Texts = dict[str, list[str]]
"""The texts of each test, by its node id."""

_texts: list[str] | None = None


def check_text(text: object, *, masked: bool = True) -> str:
    """Compare a text with the golden file after the running test has passed, and return the text.

    Numbers are masked, because they depend on the processor and tests assert them as values. So are runs of spaces,
    which depend on the widths of numbers. The folders of the test and of the repository are always masked.
    """
    unmasked = _without_folders(str(text))
    _record(re.sub(r" {2,}", "  ", _NUMBER.sub("#", unmasked)) if masked else unmasked)
    return str(text)


@contextmanager
def check_error(
    error: type[BaseException] = InputError, *, masked: bool = False
) -> Iterator[pytest.ExceptionInfo[BaseException]]:
    """Expect an error with a one-line message, and compare the message with the golden file.

    Its numbers are compared too; measured numbers can be `masked`.
    """
    with pytest.raises(error) as caught:
        yield caught
    message = str(caught.value)
    assert "\n" not in message
    if masked:
        check_text(message)
    else:
        _record(_without_folders(message))


def _record(text: str) -> None:
    assert _texts is not None, "check_text() and check_error() must be called inside a test"
    text = text.replace("\0", "\\0")  # the golden file is a text file
    _texts.append("\n".join(line.rstrip() for line in text.strip().splitlines()))


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
    global _texts
    outer_texts, _texts = _texts, (texts := [])
    try:
        yield
    finally:
        _texts = outer_texts
    if renewed is not None:
        renewed[test] = texts
    elif texts != golden.get(test, []):
        lines = unified_diff(
            _lines(golden.get(test, [])), _lines(texts), "wording.txt", "current text", lineterm="", n=9
        )
        pytest.fail("\n".join(["the wording has changed (`make wording` renews it):", *lines]), pytrace=False)


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
    file, _, name = test.partition("::")
    function = name.rpartition("::")[2].partition("[")[0]
    path = ROOT / file
    return not path.is_file() or f"def {function}(" not in path.read_text(encoding="utf-8")


def _lines(texts: Iterable[str]) -> list[str]:
    return [line for text in texts for line in ("- " + text.replace("\n", "\n  ")).splitlines()]
