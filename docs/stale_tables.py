"""List measurements that are older than the code they measure: `python docs/stale_tables.py`.

A comment on the page names the files and folders that are measured; the text or table below it names the commit:

    <!-- measures: pcbench/geometry pcbench/native -->
    The two-way search takes 0.2 s (commit 1a2b3c4, 2 cores).

A mark is valid up to the next mark, for every commit named there. A measurement is stale if a measured file has other
code at HEAD than at its commit; comments, docstrings and layout do not count. Tables that `make measured` wrote need no
mark: they are stale if a file that their command imported has other code now. Prints one line for each stale
measurement, unknown commit, missing commit and missing mark; the exit code is 0 in each case.
"""

import re
import subprocess
import sys
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import NamedTuple

from written_tables import ROOT, Run, code_of, read_run, tables

MEASURED = "docs/measured/"  # each table on these pages is a measurement
SUMMARY = "docs/measured/index.md"  # quotes the other pages, which name the commits

NO_RUNS: Mapping[str, Run] = {}
_MADE_BY = re.compile(r"<!-- made by: (.+?) -->")
_MARK = re.compile(r"<!-- measures: (.+?) -->")
_TABLE = re.compile(r"\|[ |:-]*-[ |:-]*\|$|```text")
_COMMIT = re.compile(r"\b(?=[0-9a-f]*[0-9])[0-9a-f]{7,40}\b")  # a word such as "defaced" is no commit


class Measurement(NamedTuple):
    """A commit named on a page, and the code that its figures measure.

    Attributes:
        place: page and line.
        commit: the commit as the page names it; None: the page names none below the mark.
        code: files and folders of the repository; None: no mark precedes the commit or the table.
        run: the stored run of the command that printed the table, if there is one.
    """

    place: str
    commit: str | None
    code: tuple[str, ...] | None
    run: Run | None = None


def measurements(page: str, text: str, runs: Mapping[str, Run] = NO_RUNS) -> Iterator[Measurement]:
    """Yield the measurements of a page.

    Args:
        page: path of the page in the repository.
        text: its Markdown.
        runs: stored runs of the commands that printed tables of the page.
    """
    mark: Measurement | None = None  # the last mark, while no commit below it is found
    code: tuple[str, ...] | None = None
    ends_with_commit = is_stored = False
    for number, line in enumerate(text.splitlines(), 1):
        place = f"{page}:{number}"
        if (made_by := _MADE_BY.fullmatch(line)) and (run := runs.get(made_by[1])):
            mark, is_stored = None, True
            yield Measurement(place, run.commit, tuple(run.code), run)
        is_stored = is_stored and line != "```"
        if is_stored:
            continue
        if match := _MARK.search(line):
            if mark:
                yield mark
            code = tuple(match[1].split())
            mark = Measurement(place, None, code)
        names = _COMMIT.findall(line) if "commit" in line else []
        if ends_with_commit and not names:  # the name of the commit begins the next line
            names = _COMMIT.findall(line.partition(" ")[0])
        ends_with_commit = line.endswith("commit")
        for commit in names:
            mark = None
            yield Measurement(place, commit, code)
        if code is None and _TABLE.match(line) and page.startswith(MEASURED) and page != SUMMARY:
            yield Measurement(place, None, None)
    if mark:
        yield mark


def all_measurements(root: Path) -> list[Measurement]:
    """Return the measurements of the README and of all pages below docs/."""
    pages = [root / "README.md", *sorted((root / "docs").rglob("*.md"))]
    runs = {table.command: run for table in tables(root) if (run := read_run(root, table.command))}
    return [m for page in pages for m in measurements(page.relative_to(root).as_posix(), page.read_text(), runs)]


def status(measurement: Measurement, root: Path) -> str | None:
    """Return what is wrong with a measurement in a line, or None if its code has not changed."""
    commit, code = measurement.commit, measurement.code
    if measurement.run is not None:
        changed = measurement.run.changed_files(root)
        files = f"{len(changed)} of {len(measurement.run.code)} files have other code ({', '.join(changed[:3])})"
        return f"commit {commit} of {measurement.run.day}: {files}" if changed else None
    if code is None:
        return f"commit {commit}: no mark `measures:`" if commit else "a table without mark `measures:`"
    if commit is None:
        return f"no commit named; measures {' '.join(code)}"
    if _git(root, "cat-file", "-e", f"{commit}^{{commit}}") is None:
        shallow = _git(root, "rev-parse", "--is-shallow-repository") == "true\n"
        return f"commit {commit}: unknown{', perhaps because this clone is shallow' if shallow else ''}"
    before, now = (_files(root, revision, code) for revision in (commit, "HEAD"))
    changed = [name for name in sorted(before | now) if _differ(root, before.get(name), now.get(name))]
    if not changed:
        return None
    date = _git(root, "log", "-1", "--format=%cs", commit) or ""
    last = _git(root, "log", "-1", "--format=%h of %cs", "HEAD", "--", *changed) or ""
    count = f"{len(changed)} of {len(before | now)} files"
    return f"commit {commit} of {date.strip()}: {count} have other code, last {last.strip()}; measures {' '.join(code)}"


def _git(root: Path, *words: str) -> str | None:
    process = subprocess.run(["git", "-C", root, *words], capture_output=True, text=True)
    return process.stdout if process.returncode == 0 else None


@cache
def _files(root: Path, revision: str, code: tuple[str, ...]) -> dict[str, str]:
    """Return the files below some paths at a revision, and the hash of their content."""
    lines = (_git(root, "ls-tree", "-r", revision, "--", *code) or "").splitlines()
    return {name: entry.split()[2] for entry, _, name in (line.partition("\t") for line in lines)}


def _differ(root: Path, before: str | None, now: str | None) -> bool:
    if before is None or now is None or before == now:
        return before != now
    return _code(root, before) != _code(root, now)


@cache
def _code(root: Path, blob: str) -> str:
    """Return the code of a file in the history."""
    process = subprocess.run(["git", "-C", root, "cat-file", "blob", blob], capture_output=True, check=True)
    return code_of(process.stdout.decode(errors="replace"))


def main(root: Path = ROOT) -> int:
    """Print the findings and their number."""
    if _git(root, "rev-parse", "HEAD") is None:
        print(f"{root}: expected a git repository with a commit; the age of tables is unknown")
        return 0
    found = all_measurements(root)
    findings = [(m.place, line) for m in found if (line := status(m, root))]
    for place, line in findings:
        print(f"{place}: {line}")
    print(f"{len(findings)} of {len(found)} measurements are stale, or their commit or code is unknown")
    return 0


if __name__ == "__main__":
    sys.exit(main())
