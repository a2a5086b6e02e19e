"""Run the commands behind printed measurements again, and write what they print into the pages: `make measured`.

`make measured ONLY=speed` runs the commands whose page or text contains a word (written_tables.py says which tables a
command writes). A command is left out while the code
that it imported, in all its processes, is the same as when it ran; so an interrupted call continues where it ended.
Each run is stored in docs/measured/runs/ as JSON: commit, machine, date, seconds, hashes of the code, and the lines.
A command that fails, takes longer than its limit or misses a peer changes nothing; the others run, and the exit code
is 1.
"""

from __future__ import annotations

import argparse
import os
import re
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Iterable, Sequence
from datetime import date
from pathlib import Path
from tempfile import TemporaryDirectory

sys.path.append(str(Path(__file__).parents[1] / "benchmarks"))

from measure import commit, setting
from written_tables import ROOT, Run, Table, hash_of, read_run, replace_text, store_run, tables

CODE = "pcbench", "reconstructors", "benchmarks", "tests"  # folders whose modules a command measures or uses
_FIRST_LIMIT_S, _LEAST_LIMIT_S = 1800.0, 120.0  # of a command that never ran; of one that did
_LIMIT_FACTOR = 4.0  # limit of a command that ran, over the seconds that it took
_MISSING = re.compile(r"missing: .*|.* is not measured.*")  # as the benchmarks say it
_SOURCES = {".h", ".cpp", ".cu"}
_RECORD_IMPORTS = """
import atexit, os, sys

def write():
    files = {getattr(module, "__file__", None) for module in list(sys.modules.values())}
    files.add(sys.argv[0])  # Python has deleted the name of the script
    with open(os.path.join(os.environ["PCBENCH_IMPORTS"], str(os.getpid())), "w") as file:
        file.write("\\n".join(os.path.abspath(name) for name in files if name))

atexit.register(write)
"""


def run_command(root: Path, command: str, limit_s: float) -> Run:
    """Run a command at the root.

    Raises:
        TimeoutError: it took longer than its limit.
        ChildProcessError: it failed, or a peer is not installed; the message says how.
    """
    load = os.getloadavg()[0]
    with TemporaryDirectory() as folder:
        hook, imports = Path(folder) / "hook", Path(folder) / "imports"
        for path in (hook, imports):
            path.mkdir()
        (hook / "sitecustomize.py").write_text(_RECORD_IMPORTS)
        environment = {**os.environ, "PYTHONPATH": str(hook), "PCBENCH_IMPORTS": str(imports)}
        start = time.monotonic()
        process = subprocess.Popen(
            [sys.executable, *shlex.split(command)[1:]], cwd=root, env=environment, text=True,
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, start_new_session=True,
        )  # fmt: skip
        try:
            printed, errors = process.communicate(timeout=limit_s)
        except BaseException as error:
            os.killpg(process.pid, signal.SIGKILL)
            process.communicate()
            if isinstance(error, subprocess.TimeoutExpired):
                raise TimeoutError(f"longer than its limit of {limit_s:.0f} s") from None
            raise
        seconds = time.monotonic() - start
        if missing := _MISSING.search(printed):
            raise ChildProcessError(f"a peer is needed: {missing[0]}")
        if process.returncode:
            raise ChildProcessError(f"exit code {process.returncode}: {(errors or printed).strip()[-500:]}")
        names = sorted({name for file in imports.iterdir() for name in file.read_text().split("\n")})
    code = {name: digest for name in code_files(root, names) if (digest := hash_of(root / name))}
    lines = [line.rstrip() for line in printed.strip("\n").split("\n")]
    return Run(command, commit(), _machine(), round(load, 1), date.today().isoformat(), round(seconds, 1), code, lines)


def code_files(root: Path, modules: Iterable[str]) -> list[str]:
    """Return the files of the repository behind imported modules; those of a compiled module are its sources."""
    files = set()
    for name in map(Path, modules):
        if name.suffix == ".py":
            files.add(name)
        elif (at := next((k for k, part in enumerate(name.parts) if part in CODE), None)) is not None:
            folder = root.joinpath(*name.parts[at:-1])
            files.update(path for path in folder.rglob("*") if path.suffix in _SOURCES)
            files.update(folder.parent.glob("*.h"))
            files.update((root / "pcbench/native/common").iterdir())
    inside = {path.relative_to(root) for path in files if path.is_relative_to(root) and path.is_file()}
    return sorted(path.as_posix() for path in inside if path.parts[0] in CODE)


def write_table(root: Path, table: Table, lines: Sequence[str]) -> None:
    """Replace the printed lines below a command."""
    path = root / table.page
    text = path.read_text()
    start = text.index(f"<!-- made by: {table.command} -->\n```text\n")
    begin = text.index("```text\n", start) + len("```text\n")
    end = text.index("```", begin)
    replace_text(path, text[:begin] + "\n".join(lines) + "\n" + text[end:])


def main() -> int:
    """Run the commands of stale tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default="", help="words or quoted phrases, of which the page or the command has one")
    parser.add_argument("--again", action="store_true", help="also run commands whose code has not changed")
    options = parser.parse_args()
    words, failures = shlex.split(options.only), []
    for table in tables(ROOT):
        place = f"{table.page}:{table.line}"
        if words and not any(word in table.page or word in table.command for word in words):
            continue
        last = read_run(ROOT, table.command)
        if last and not options.again and not last.changed_files(ROOT):
            print(f"{place}: current, {last.commit} of {last.day}")
            continue
        print(f"{place}: {table.command}", end=" ... ", flush=True)
        limit_s = max(_LEAST_LIMIT_S, _LIMIT_FACTOR * last.seconds) if last else _FIRST_LIMIT_S
        try:
            run = run_command(ROOT, table.command, limit_s)
        except (TimeoutError, ChildProcessError) as error:
            failures.append(f"{place}: {error}")
            print("failed")
            continue
        write_table(ROOT, table, run.lines)
        store_run(ROOT, run)
        print(f"{run.seconds:.0f} s")
    print(*failures, sep="\n", end="\n" if failures else "")
    return 1 if failures else 0


def _machine() -> str:
    """Return the processor and the number of its cores."""
    return setting().partition("; ")[2].rpartition(", load")[0]


if __name__ == "__main__":
    sys.exit(main())
