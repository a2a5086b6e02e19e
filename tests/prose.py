"""Find unclear wording in docstrings, comments, messages and pages: `python tests/prose.py [FILE ...]`.

`make lint` runs it over all files of the repository. Each pattern has an alternative that reads better.
"""

import ast
import io
import json
import re
import subprocess
import sys
import tokenize
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[1]
SUFFIXES = {".py", ".pyi", ".h", ".cpp", ".cu", ".md", ".ipynb", ".txt"}

FIRST_LINES = {
    r"^(Of|Whose|Whoever|Who|So (many|few|much)|That of|Those of) ": "a full statement",
    r"^How (many|much|often|far|large|well) ": "a full statement",
    r"^(What|Where|Which|When|In which|On which|For what|From what|With what|By what) ": "a full statement",
    r"^(Raises|Returns|Args|Yields):": "a full statement before the sections",
}
"""Beginnings of docstrings that are fragments."""

ANYWHERE = {
    r"\b[Ww]hoever\b": "name the person or the program",
    r"\b(no|not) (more|less|fewer) than so (many|few)\b": "'at most' and the number",
    r"\b[Ss]o many\b": "the number, or 'that many'",
    r"\b[Dd]erivatives? by\b": "'gradient with respect to'",
    r"\b[Hh]eld (within|against|fast)\b": "'clamped to', 'compared with', 'fixed'",
    r"\b(one|two|line|row|file|number|entry|byte|pixel|image|point)s? a (threshold|budget|point|pixel|line|cloud|image|"
    r"view|candidate|metric|step|file|side|cell|tile|Gaussian|camera|degree|millimetre|metre|command|commit|room|family)"
    r"\b": "'per' or 'each'",
    r"\b[Ss]trays?\b": "'outliers'",
    r"\b(bear|bears|bore|borne) (it |them )?out\b": "'confirm'",
    r"\bbears? (a|no) verdict\b": "'allow a verdict'",
    r"\b[Ww]ho (knows|wants|reads|looks|needs|asks)\b": "'to ..., use ...'",
    r"\btak(e|es|en|ing) away\b": "'remove', 'prune'",
    r"\b(a|the) wood\b(?! (surface|texture|grain|floor))": "'forest'",
    r"\bgo(es)? on (from|where)\b": "'continue', 'resume'",
    r"\bput (right|together)\b": "'correct', 'merge'",
    r"\bof (its|their|one's) own\b": "'separate', 'its own ...'",
}
"""Phrases that are unclear to new readers."""

_MARKDOWN_CODE = re.compile(r"^(`{3,}).*?^\1", re.MULTILINE | re.DOTALL)


class Text(NamedTuple):
    """A piece of prose of a file.

    Attributes:
        path: the file.
        line: number of its first line, from 1.
        words: the text.
        is_docstring: whether it is a docstring.
    """

    path: Path
    line: int
    words: str
    is_docstring: bool = False


class Finding(NamedTuple):
    """Unclear wording at a line of a file, with what to write instead."""

    path: Path
    line: int
    words: str
    instead: str


def texts(path: Path) -> Iterator[Text]:
    """Yield the prose of a file: docstrings, comments and messages of code, everything but code blocks of a page."""
    content = path.read_text(encoding="utf-8")
    if path.suffix in (".py", ".pyi"):
        yield from _python(path, content)
    elif path.suffix in (".h", ".cpp", ".cu"):
        for match in re.finditer(r"//[^\n]*|/\*.*?\*/", content, re.DOTALL):
            yield Text(path, content.count("\n", 0, match.start()) + 1, match[0])
    elif path.suffix == ".ipynb":
        for cell in json.loads(content)["cells"]:
            if cell["cell_type"] == "markdown":
                yield Text(path, 1, "".join(cell["source"]))
    else:
        blank = _MARKDOWN_CODE.sub(lambda code: re.sub(r"[^\n]", "", code[0]), content)
        yield Text(path, 1, blank if path.suffix == ".md" else content)


def _python(path: Path, content: str) -> Iterator[Text]:
    docstrings = set()
    for node in ast.walk(ast.parse(content)):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            statement = node.body[0] if node.body else None
            if (
                isinstance(statement, ast.Expr)
                and isinstance(statement.value, ast.Constant)
                and isinstance(statement.value.value, str)
            ):
                docstrings.add(statement.value.lineno)
                yield Text(path, statement.value.lineno, statement.value.value, is_docstring=True)
    for token in tokenize.generate_tokens(io.StringIO(content).readline):
        is_text = token.type == tokenize.STRING and " " in token.string and token.start[0] not in docstrings
        if is_text or token.type == tokenize.COMMENT:
            yield Text(path, token.start[0], token.string)


def findings(text: Text) -> Iterator[Finding]:
    """Yield the unclear phrases of a text."""
    if text.is_docstring:
        for pattern, instead in FIRST_LINES.items():
            first_line = text.words.strip().partition("\n")[0]
            if (match := re.search(pattern, first_line)) and not first_line.endswith("?"):
                yield Finding(text.path, text.line, match[0].strip(), instead)
    for pattern, instead in ANYWHERE.items():
        # A phrase may span two lines of a text, with the mark of a comment between them.
        for match in re.finditer(pattern.replace(" ", r"(?:\s|//|#|\*)+"), text.words):
            yield Finding(
                text.path, text.line + text.words.count("\n", 0, match.start()), " ".join(match[0].split()), instead
            )


def _files() -> list[Path]:
    names = subprocess.run(
        ["git", "ls-files"], cwd=ROOT, check=True, capture_output=True, text=True
    ).stdout.splitlines()
    files = (ROOT / name for name in names)
    excluded_files = {
        Path(__file__).resolve(),
        ROOT / "tests" / "test_prose.py",
        ROOT / "constraints.txt",
        ROOT / "CMakeLists.txt",
    }
    return [file for file in files if file.suffix in SUFFIXES and file not in excluded_files and file.is_file()]


def main(names: list[str]) -> int:
    """Print each finding in a line; return 1 if there is any."""
    count = 0
    for path in map(Path, names) if names else _files():
        for text in texts(path):
            for file, line, words, instead in findings(text):
                count += 1
                name = file.relative_to(ROOT) if file.is_relative_to(ROOT) else file
                print(f"{name}:{line}: {words!r}: write {instead}")
    if count:
        print(f"{count} unclear phrases")
    return int(count > 0)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
