"""List measurements that are older than the code they measure: `python docs/stale_tables.py`.

A table that `make measured` writes is stale if a file that its command imported has other code now; comments,
docstrings and layout do not count. Figures of the running text that repeat such a table are compared with it
(quoted_figures.py).

Pages in docs/trials/ are records of experiments and do not become stale. Each entry, a heading of the second level with
its text, names its commit or its date, and its commits exist. Other pages name no commit outside of written tables.

Prints one line for each finding; the exit code is 0 in each case.
"""

import re
import subprocess
import sys
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

from quoted_figures import differing_figures
from written_tables import ROOT, TABLE, pages, read_run, tables

TRIALS = "docs/trials/"
_COMMIT = re.compile(r"\b(?=[0-9]*[a-f])(?=[a-f]*[0-9])[0-9a-f]{7,40}\b|(?<=commit )[0-9]{7,40}\b")  # no word, no count
_CODE = re.compile(r"(`+)(?!`).*?(?<!`)\1(?!`)", re.DOTALL)  # spans and blocks: commits of other projects, outputs
_DATE = re.compile(r"\b20\d\d-\d\d-\d\d\b")


def findings(root: Path) -> Iterator[str]:
    """Yield a line for each stale table, unknown commit, and trial without commit and date."""
    yield from _stale_tables(root)
    for page in pages(root):
        name, text = page.relative_to(root).as_posix(), page.read_text()
        yield from _trials(root, name, text) if name.startswith(TRIALS) else _commits_beside_tables(name, text)
    yield from differing_figures(root)


def _stale_tables(root: Path) -> Iterator[str]:
    for table in tables(root):
        place, run = f"{table.page}:{table.line}", read_run(root, table.command)
        if run is None:
            yield f"{place}: never written by `make measured`: {table.command}"
        elif changed := run.changed_files(root):
            files = f"{len(changed)} of {len(run.code)} files have other code ({', '.join(changed[:3])})"
            yield f"{place}: commit {run.commit} of {run.day}: {files}"


def _trials(root: Path, name: str, text: str) -> Iterator[str]:
    for number, entry in _entries(text):
        commits = _COMMIT.findall(_CODE.sub("", entry))
        if not commits and not _DATE.search(entry):
            yield f"{name}:{number}: expected a commit or a date such as 2026-11-25 in {entry.partition(chr(10))[0]!r}"
        for commit in commits:
            if _git(root, "cat-file", "-e", f"{commit}^{{commit}}") is None:
                shallow = _git(root, "rev-parse", "--is-shallow-repository") == "true\n"
                yield f"{name}:{number}: commit {commit}: unknown{', perhaps because this clone is shallow' * shallow}"


def _entries(text: str) -> Iterator[tuple[int, str]]:
    """Yield each heading of the second level with its text, and its line."""
    starts = [match.start() for match in re.finditer(r"^## ", text, re.MULTILINE)]
    for start, end in pairwise([*starts, len(text)]):
        yield text.count("\n", 0, start) + 1, text[start:end]


def _commits_beside_tables(name: str, text: str) -> Iterator[str]:
    outside = TABLE.sub(lambda table: "\n" * table[0].count("\n"), text)
    for number, line in enumerate(outside.splitlines(), 1):
        for commit in _COMMIT.findall(_CODE.sub("", line)):
            yield f"{name}:{number}: commit {commit}: a record of an experiment belongs to {TRIALS}"


def _git(root: Path, *words: str) -> str | None:
    process = subprocess.run(["git", "-C", root, *words], capture_output=True, text=True)
    return process.stdout if process.returncode == 0 else None


def main(root: Path = ROOT) -> int:
    """Print the findings and their number."""
    if _git(root, "rev-parse", "HEAD") is None:
        print(f"{root}: expected a git repository with a commit; the age of tables is unknown")
        return 0
    found = list(findings(root))
    print(*found, sep="\n", end="\n" if found else "")
    print(f"{len(found)} findings; {sum(1 for _ in tables(root))} tables are written by `make measured`")
    return 0


if __name__ == "__main__":
    sys.exit(main())
