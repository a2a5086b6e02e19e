"""What users read, compared with one golden file.

Tests assert values, codes and verdicts. Where a test makes the program speak, it hands the text to `said`, or expects
an error with `refused`: the texts of each test stand in `wording.txt` beside this module. A change of wording is one
command, `make wording`, and a diff to read.
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
_NUMBER = re.compile(r"(?<![\w.])[-+]?\d[\d,]*(\.\d+)?(e[-+]?\d+)?(?![\w])")
_HEADING = "== "

Texts = dict[str, list[str]]
"""The texts of each test, by its node id."""

_spoken: list[str] | None = None


def said(text: object) -> str:
    """Compare a text with the golden file once the running test has passed, and return it.

    Its numbers are masked: they depend on the processor, and tests assert them as values. So are the folders of the
    test and of the repository, and runs of spaces, which depend on the widths of numbers.
    """
    _hand_in(re.sub(r" {2,}", "  ", _NUMBER.sub("#", _without_folders(str(text)))))
    return str(text)


@contextmanager
def refused(
    error: type[BaseException] = InputError, *, masked: bool = False
) -> Iterator[pytest.ExceptionInfo[BaseException]]:
    """Expect an error, and compare its message with the golden file. The message is one line.

    Its numbers are compared too, unless they are `masked` because they are measured.
    """
    with pytest.raises(error) as caught:
        yield caught
    message = str(caught.value)
    assert "\n" not in message
    if masked:
        said(message)
    else:
        _hand_in(_without_folders(message))


def _hand_in(text: str) -> None:
    assert _spoken is not None, "said() and refused() belong into the body of a test"
    _spoken.append("\n".join(line.rstrip() for line in text.strip().splitlines()))


def _without_folders(text: str) -> str:
    # pytest's folder of this run is something like /tmp/pytest-of-user/pytest-0/popen-gw0/test_name0.
    temporary = re.escape(tempfile.gettempdir())
    text = re.sub(rf"{temporary}/pytest-of-[^/\s]+/pytest-[^/\s]+(/popen-gw\d+)?(/[^/\s:,'\"]+)?", "TMP", text)
    for folder, name in ((data_root(), "DATA"), (ROOT, "ROOT")):
        if folder is not None:
            text = text.replace(str(folder.resolve()), name).replace(str(folder), name)
    return text


@contextmanager
def spoken_by(test: str, golden: Texts, renewed: Texts | None) -> Iterator[None]:
    """Collect the texts of a test, and compare them with the golden file, or put them among the renewed ones."""
    global _spoken
    before, _spoken = _spoken, (texts := [])
    try:
        yield
    finally:
        _spoken = before
    if renewed is not None:
        renewed[test] = texts
    elif texts != golden.get(test, []):
        lines = unified_diff(_lines(golden.get(test, [])), _lines(texts), "wording.txt", "said now", lineterm="", n=9)
        pytest.fail("\n".join(["the wording has changed (`make wording` renews it):", *lines]), pytrace=False)


def read() -> Texts:
    """The golden file."""
    found: Texts = {}
    lines = GOLDEN.read_text(encoding="utf-8").splitlines() if GOLDEN.exists() else []
    texts: list[str] = []
    for line in lines:
        if line.startswith(_HEADING):
            found[line.removeprefix(_HEADING)] = texts = []
        elif line.startswith("- "):
            texts.append(line[2:])
        elif texts:
            texts[-1] += "\n" + line[2:]
    return {test: [text.rstrip("\n") for text in texts] for test, texts in found.items()}


def renew(renewed: Texts) -> None:
    """Write the golden file: texts of tests that did not run stay, those of tests that are no more go."""
    texts = {test: texts for test, texts in {**read(), **renewed}.items() if texts and not is_stale(test)}
    blocks = ["\n".join([_HEADING + test, *_lines(texts[test])]) for test in sorted(texts)]
    GOLDEN.write_text("\n\n".join(blocks) + "\n", encoding="utf-8")


def is_stale(test: str) -> bool:
    """Whether a test of this node id is no longer in its file."""
    file, _, name = test.partition("::")
    function = name.rpartition("::")[2].partition("[")[0]
    path = ROOT / file
    return not path.is_file() or f"def {function}(" not in path.read_text(encoding="utf-8")


def _lines(texts: Iterable[str]) -> list[str]:
    return [line for text in texts for line in ("- " + text.replace("\n", "\n  ")).splitlines()]
