"""Tables that `make measured` writes into the pages, and the stored runs of their commands.

<!-- made by: python benchmarks/neighbors.py --sizes 1e6 --threads 2 -->
```text
(what the command prints)
```
"""

from __future__ import annotations

import ast
import hashlib
import json
import re
import shlex
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[1]
RUNS = "docs/measured/runs"

TABLE = re.compile(r"<!-- made by: (python benchmarks/.+?) -->\n```text\n(.*?)```", re.DOTALL)
_PLACEHOLDER = re.compile(r"\b[A-Z]{3,}\b")  # a folder that only a person knows
_CPP_COMMENT = re.compile(r'("(?:\\.|[^"\\\n])*")|//[^\n]*|/\*.*?\*/', re.DOTALL)


class Table(NamedTuple):
    """The printed lines of a command on a page.

    Attributes:
        page: path of the page in the repository.
        line: line of the comment that names the command.
        command: the command.
    """

    page: str
    line: int
    command: str


@dataclass(frozen=True)
class Run:
    """A command that ran.

    Attributes:
        command: the command.
        commit: commit at which it ran.
        machine: processor and number of its cores.
        load: load of the machine before it, over a minute.
        day: date, as ISO 8601.
        seconds: wall seconds.
        code: hash of each file of the repository that it imported, without comments and layout.
        lines: what it printed.
    """

    command: str
    commit: str
    machine: str
    load: float
    day: str
    seconds: float
    code: Mapping[str, str]
    lines: Sequence[str]

    def changed_files(self, root: Path) -> list[str]:
        """Return the files whose code has changed since."""
        return [name for name, digest in self.code.items() if hash_of(root / name) != digest]


def tables(root: Path) -> Iterator[Table]:
    """Yield the tables of all pages that `make measured` can write.

    A command that stands above several tables, or has a placeholder such as FOLDER, is left to people.
    """
    found = []
    for page in sorted((root / "docs").rglob("*.md")):
        text = page.read_text()
        for match in TABLE.finditer(text):
            line = text.count("\n", 0, match.start()) + 1
            found.append(Table(page.relative_to(root).as_posix(), line, match[1]))
    count = Counter(table.command for table in found)
    yield from (t for t in found if count[t.command] == 1 and not _PLACEHOLDER.search(t.command))


def read_run(root: Path, command: str) -> Run | None:
    """Return the last run of a command, None if it has none."""
    path = _record(root, command)
    return Run(**json.loads(path.read_text())) if path.is_file() else None


def store_run(root: Path, run: Run) -> None:
    """Store the last run of a command."""
    path = _record(root, run.command)
    path.parent.mkdir(parents=True, exist_ok=True)
    replace_text(path, json.dumps(asdict(run), indent=1) + "\n")


def replace_text(path: Path, text: str) -> None:
    """Write a file at once."""
    scratch = path.with_suffix(path.suffix + ".new")
    scratch.write_text(text)
    scratch.replace(path)


def _record(root: Path, command: str) -> Path:
    script, *options = shlex.split(command)[1:]
    name = re.sub(r"[^A-Za-z0-9.]+", "-", " ".join([Path(script).stem, *options])).strip("-")
    return root / RUNS / f"{name[:80]}.json"


def hash_of(path: Path) -> str | None:
    """Return the hash of a file's code without comments, docstrings and layout; None if there is no such file."""
    if not path.is_file():
        return None
    return hashlib.sha256(code_of(path.read_text(errors="replace")).encode()).hexdigest()[:16]


def code_of(text: str) -> str:
    """Return the content of a file without comments, docstrings and layout."""
    try:
        tree = ast.parse(text)
    except (SyntaxError, ValueError):  # not Python
        return " ".join(_CPP_COMMENT.sub(lambda match: match[1] or " ", text).split())
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) and ast.get_docstring(node) is not None:
            node.body = node.body[1:]
    return ast.dump(tree)
