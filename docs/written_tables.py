"""Tables that `make measured` writes into the pages, and the stored runs of their commands.

<!-- made by: python benchmarks/neighbors.py --sizes 1e6 --threads 2 -->
```text
(what the command prints)
```

A table shows one block of the output, the lines up to the next empty one, if its comment ends in `| START`, the start
of the first line of the block: one run fills several tables, also on several pages. A table whose last line is `...`
shows the first lines.
docs/measured/commands.toml has the expected seconds of each command.
"""

from __future__ import annotations

import ast
import hashlib
import json
import re
import shlex
import textwrap
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[1]
RUNS = "docs/measured/runs"
COMMANDS = "docs/measured/commands.toml"

TABLE = re.compile(
    r"<!-- made by: (?P<command>(?:python benchmarks/|pcbench (?:bench|demo|experiment|stress|tradeoff) )[^|\n]+?)"
    r"(?: \| (?P<block>[^\n]+?))? -->\n```text\n(?P<lines>.*?)```",
    re.DOTALL,
)
_WIDTH = 120  # of sentences on a page, as of other text
_CPP_COMMENT = re.compile(r'("(?:\\.|[^"\\\n])*")|//[^\n]*|/\*.*?\*/', re.DOTALL)


class Table(NamedTuple):
    """The printed lines of a command on a page.

    Attributes:
        page: path of the page in the repository.
        line: line of the comment that names the command.
        command: the command.
        block: start of the block that is shown, None: all of its output.
    """

    page: str
    line: int
    command: str
    block: str | None = None


class Cost(NamedTuple):
    """The expected cost of a command.

    Attributes:
        seconds: wall seconds that are expected.
        is_timing: whether it prints seconds or memory; its figures then depend on what else runs.
    """

    seconds: float
    is_timing: bool


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

    def block(self, start: str | None) -> list[str]:
        """Return the lines from the one that begins with a text to the next empty one; None: all lines.

        Raises:
            LookupError: no line after an empty one begins with the text.
        """
        if start is None:
            return list(self.lines)
        blocks = "\n".join(self.lines).split("\n\n")
        for block in blocks:
            if (lines := block.strip("\n").split("\n"))[0].lstrip().startswith(start):
                return lines
        starts = ", ".join(repr(block.strip().partition("\n")[0][:30]) for block in blocks)
        raise LookupError(f"expected a block that starts with {start!r}; the command printed {starts}")


def pages(root: Path) -> list[Path]:
    """Return the README and all pages below docs/."""
    return [path for path in (root / "README.md", *sorted((root / "docs").rglob("*.md"))) if path.is_file()]


def tables(root: Path) -> Iterator[Table]:
    """Yield the tables of all pages that `make measured` writes."""
    for page in pages(root):
        text = page.read_text()
        for match in TABLE.finditer(text):
            line = text.count("\n", 0, match.start()) + 1
            yield Table(page.relative_to(root).as_posix(), line, match["command"], match["block"])


def with_lines(text: str, run: Run) -> str:
    """Return the text of a page with the tables of a run.

    Raises:
        LookupError: the command did not print a block that the page shows.
    """

    def written(table: re.Match[str]) -> str:
        if table["command"] != run.command:
            return table[0]
        lines = [part for line in run.block(table["block"]) for part in _wrapped(line)]
        if table["lines"].endswith("\n...\n"):
            lines = [*lines[: table["lines"].count("\n") - 1], "..."]
        return table[0][: table.start("lines") - table.start()] + "\n".join(lines) + "\n```"

    return TABLE.sub(written, text)


def _wrapped(line: str) -> list[str]:
    """Return the lines of a long sentence; lines with columns stay as they are."""
    return [line] if len(line) <= _WIDTH or "  " in line else textwrap.wrap(line, _WIDTH)


def read_costs(root: Path) -> dict[str, Cost]:
    """Return what each command takes: the seconds of its last run, otherwise those of docs/measured/commands.toml."""
    costs = {}
    for kind, commands in tomllib.loads((root / COMMANDS).read_text()).items():
        for command, seconds in commands.items():
            run = read_run(root, command)
            costs[command] = Cost(run.seconds if run else seconds, kind == "timings")
    return costs


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
    program, script, *options = shlex.split(command)
    words = [Path(script).stem, *options] if program == "python" else [program, script, *options]
    name = re.sub(r"[^A-Za-z0-9.]+", "-", " ".join(words)).strip("-")
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
