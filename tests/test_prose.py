"""The check of wording finds each kind of unclear phrase, and accepts plain sentences."""

from pathlib import Path

import prose
import pytest


@pytest.mark.parametrize(
    ("name", "content", "count"),
    [
        ("fragment.py", '"""Of the points inside."""\n', 1),
        ("late.py", 'def f():\n    """What a cloud has."""\n', 1),
        ("comment.py", "x = 1  # whoever reads this\n", 1),
        ("message.py", 'x = f"{1} strays in the cloud"\n', 1),
        ("name.py", "strays = 1\n", 0),
        ("statement.py", '"""Return the points inside the region."""\n', 0),
        ("kernel.h", "// derivatives by\n// the mean\nint strays;\n", 1),
        ("page.md", "Held\nwithin the limits.\n\n```text\nheld within\n```\n", 1),
        ("book.ipynb", '{"cells": [{"cell_type": "markdown", "source": ["so many\\n"]}]}', 1),
    ],
)
def test_unclear_phrases_are_found(tmp_path: Path, name: str, content: str, count: int):
    path = tmp_path / name
    path.write_text(content)
    assert sum(len(list(prose.findings(text))) for text in prose.texts(path)) == count


def test_findings_have_their_line(tmp_path: Path):
    path = tmp_path / "page.md"
    path.write_text("First line.\nThe points\nare put\ntogether.\n")
    (finding,) = (finding for text in prose.texts(path) for finding in prose.findings(text))
    assert (finding.line, finding.words) == (3, "put together")


def test_command_fails_if_there_is_a_finding(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    path = tmp_path / "page.md"
    path.write_text("Plain words.\n")
    assert prose.main([str(path)]) == 0
    path.write_text("Whoever reads it.\n")
    assert prose.main([str(path)]) == 1
    assert f"{path}:1: 'Whoever'" in capsys.readouterr().out
