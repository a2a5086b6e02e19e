"""Run the commands behind printed measurements again, and write what they print into the pages: `make measured`.

`make measured ONLY=speed` runs the commands whose pages or text contain a word (written_tables.py says which tables a
command writes). A command is left out while the code that it imported, in all its processes, is the same as when it
ran; so an interrupted call continues where it ended. The call starts with a list of what it will run, with seconds.
Commands that print seconds or memory run first, one at a time on a quiet machine; the others two at a time, with one
thread each.

Each run is stored in docs/measured/runs/ as JSON: commit, machine, date, seconds, hashes of the code, and the lines.
A command that fails, takes longer than its limit or misses a peer changes nothing; the others run, and the exit code
is 1. The last lines name what failed, and figures of the running text that differ from the runs (quoted_figures.py).
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
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import suppress
from datetime import date
from pathlib import Path
from tempfile import TemporaryDirectory, gettempdir
from typing import NamedTuple

sys.path.append(str(Path(__file__).parents[1] / "benchmarks"))

from measure import commit, setting
from quoted_figures import differing_figures
from written_tables import (
    ROOT,
    Cost,
    Run,
    hash_of,
    pages,
    read_costs,
    read_run,
    replace_text,
    store_run,
    tables,
    with_lines,
)

CODE = "pcbench", "reconstructors", "benchmarks", "tests"  # folders whose modules a command measures or uses
_LEAST_LIMIT_S, _LIMIT_FACTOR = 600.0, 4.0  # least limit of a command, and its limit over the expected seconds
_UNKNOWN_COST = Cost(600.0, True)  # of a command that docs/measured/commands.toml does not have yet
_QUIET_LOAD, _QUIET_WAIT_S, _QUIET_POLL_S = 0.7, 120.0, 3.0  # busy cores at which timings begin; longest wait; steps
_MISSING = re.compile(r"missing: .*|.* is not measured.*")  # as the benchmarks say it
_TEMPORARY_FOLDER = re.compile(rf"{re.escape(gettempdir())}/tmp\w+/")
_running: set[int] = set()  # processes of the commands that run now
_SOURCES = {".h", ".cpp", ".cu"}
_SITE = "site-packages"  # folder of compiled modules
_RECORD_IMPORTS = """
import atexit, os, sys

def write():
    files = {getattr(module, "__file__", None) for module in list(sys.modules.values())}
    files.add(sys.argv[0])  # Python has deleted the name of the script
    with open(os.path.join(os.environ["PCBENCH_IMPORTS"], str(os.getpid())), "w") as file:
        file.write("\\n".join(os.path.abspath(name) for name in files if name))

atexit.register(write)
"""


class Job(NamedTuple):
    """A command to run, what it takes, and the pages that it writes."""

    command: str
    cost: Cost
    pages: tuple[str, ...]


def jobs_to_run(root: Path, words: Iterable[str] = (), again: bool = False) -> list[Job]:
    """Return the commands that have not run with this code, timings first.

    Args:
        root: the repository.
        words: texts of which the command or one of its pages has one; none: all commands.
        again: also return the commands whose code has not changed.
    """
    costs, places = read_costs(root), {}
    for table in tables(root):
        places.setdefault(table.command, {})[table.page] = None
    jobs = [Job(command, costs.get(command, _UNKNOWN_COST), tuple(at)) for command, at in places.items()]
    words = list(words)
    if words:
        jobs = [job for job in jobs if any(word in text for word in words for text in (job.command, *job.pages))]
    jobs = [job for job in jobs if again or not (run := read_run(root, job.command)) or run.changed_files(root)]
    return sorted(jobs, key=lambda job: not job.cost.is_timing)


def run_command(root: Path, command: str, limit_s: float, environment: Mapping[str, str] | None = None) -> Run:
    """Run a command: a script at the root, and `pcbench` in a new folder.

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
        environment = {**os.environ, **(environment or {}), "PYTHONPATH": str(hook), "PCBENCH_IMPORTS": str(imports)}
        program, *options = shlex.split(command)
        start = time.monotonic()
        process = subprocess.Popen(
            [sys.executable, *(["-m", "pcbench"] if program == "pcbench" else []), *options],
            cwd=folder if program == "pcbench" else root, env=environment, text=True,
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, start_new_session=True,
        )  # fmt: skip
        _running.add(process.pid)
        try:
            printed, errors = process.communicate(timeout=limit_s)
        except BaseException as error:
            _kill(process.pid)
            process.communicate()
            if isinstance(error, subprocess.TimeoutExpired):
                raise TimeoutError(f"longer than its limit of {limit_s:.0f} s") from None
            raise
        finally:
            _running.discard(process.pid)
        seconds = time.monotonic() - start
        if program == "python" and (missing := _MISSING.search(printed)):
            raise ChildProcessError(f"a peer is needed: {missing[0]}")
        if process.returncode:
            raise ChildProcessError(f"exit code {process.returncode}: {(errors or printed).strip()[-500:]}")
        names = sorted({name for file in imports.iterdir() for name in file.read_text().split("\n")})
    code = {name: digest for name in code_files(root, names) if (digest := hash_of(root / name))}
    lines = [_TEMPORARY_FOLDER.sub("", line).rstrip() for line in printed.strip("\n").split("\n")]
    return Run(command, commit(), _machine(), round(load, 1), date.today().isoformat(), round(seconds, 1), code, lines)


def code_files(root: Path, modules: Iterable[str]) -> list[str]:
    """Return the files of the repository behind imported modules; those of a compiled module are its sources."""
    files = set()
    for name in map(Path, modules):
        if name.suffix == ".py":
            files.add(name)
            continue
        installed = name.parts[name.parts.index(_SITE) + 1 :] if _SITE in name.parts else name.parts[len(root.parts) :]
        if installed and installed[0] in CODE:
            folder = root.joinpath(*installed[:-1])
            files.update(path for path in folder.rglob("*") if path.suffix in _SOURCES)
            files.update(folder.parent.glob("*.h"))
            files.update((root / "pcbench/native/common").iterdir())
    inside = {path.relative_to(root) for path in files if path.is_relative_to(root) and path.is_file()}
    return sorted(path.as_posix() for path in inside if path.parts[0] in CODE)


def write_tables(root: Path) -> list[str]:
    """Write the tables of all stored runs into their pages; return a line for each block that was not printed."""
    failures, found = [], list(tables(root))
    for page in pages(root):
        name, text = page.relative_to(root).as_posix(), page.read_text()
        written = text
        for command in dict.fromkeys(table.command for table in found if table.page == name):
            if run := read_run(root, command):
                try:
                    written = with_lines(written, run)
                except LookupError as error:
                    failures.append(f"failed: {name}: {command}: {error}")
        if written != text:
            replace_text(page, written)
    return failures


def busy_cores(seconds: float) -> float:
    """Return how many cores are busy on average in the next seconds."""

    def idle_and_all() -> tuple[int, int]:
        ticks = [int(word) for word in Path("/proc/stat").read_text().partition("\n")[0].split()[1:]]
        return ticks[3] + ticks[4], sum(ticks[:8])  # idle and waiting for disks; guests are part of the first columns

    before = idle_and_all()
    time.sleep(seconds)
    idle, total = (after - first for after, first in zip(idle_and_all(), before, strict=True))
    return (os.cpu_count() or 1) * (1 - idle / max(total, 1))


def wait_until_quiet() -> None:
    """Wait until the machine does little else, but not longer than two minutes."""
    start, is_announced = time.monotonic(), False
    while (busy := busy_cores(_QUIET_POLL_S)) > _QUIET_LOAD and time.monotonic() - start < _QUIET_WAIT_S:
        if not is_announced:
            print(f"waiting for less than {_QUIET_LOAD} busy cores, now {busy:.1f}", flush=True)
        is_announced = True
    if busy > _QUIET_LOAD:
        print(f"{busy:.1f} cores are busy: compare ratios and CPU seconds, not wall seconds", flush=True)


def results(root: Path, jobs: list[Job]) -> Iterator[tuple[Job, Run | Exception]]:
    """Run timings one after another, then the other commands two at a time, and yield what they gave."""

    def result(job: Job, environment: Mapping[str, str] | None = None) -> Run | Exception:
        limit_s = max(_LEAST_LIMIT_S, _LIMIT_FACTOR * job.cost.seconds)
        try:
            return run_command(root, job.command, limit_s, environment)
        except (TimeoutError, ChildProcessError) as error:
            return error

    timings = [job for job in jobs if job.cost.is_timing]
    for job in timings:
        wait_until_quiet()
        yield job, result(job)
    pool = ThreadPoolExecutor(2)
    try:
        futures = {pool.submit(result, job, {"OMP_NUM_THREADS": "1"}): job for job in jobs if not job.cost.is_timing}
        for future in as_completed(futures):
            yield futures[future], future.result()
    finally:
        pool.shutdown(wait=False, cancel_futures=True)
        for process in list(_running):
            _kill(process)


def list_jobs(jobs: list[Job]) -> None:
    """Print the commands and the seconds that are expected."""
    for job in jobs:
        print(f"{job.cost.seconds:7.0f} s  {'alone' if job.cost.is_timing else '     '}  {job.command}")
    alone, others = (sum(j.cost.seconds for j in jobs if j.cost.is_timing is kind) for kind in (True, False))
    total = f"{(alone + others / 2) / 60:.0f} min: {alone / 60:.0f} for timings, {others / 120:.0f} for the others"
    print(f"{len(jobs)} commands, {total}", flush=True)


def main() -> int:
    """Run the commands of stale tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default="", help="words or quoted phrases, of which a page or the command has one")
    parser.add_argument("--again", action="store_true", help="also run commands whose code has not changed")
    parser.add_argument("--list", action="store_true", help="only list the commands and their seconds")
    options = parser.parse_args()
    jobs, failures = jobs_to_run(ROOT, shlex.split(options.only), options.again), []
    list_jobs(jobs)
    if options.list:
        return 0
    for job, found in results(ROOT, jobs):
        if isinstance(found, Exception):
            failures.append(f"failed: {job.command}: {found}")
            print(failures[-1], flush=True)
            continue
        store_run(ROOT, found)
        write_tables(ROOT)
        print(f"{found.seconds:7.0f} s  {job.command}", flush=True)
    failures += write_tables(ROOT)
    for line in (*failures, *differing_figures(ROOT)):
        print(line)
    return 1 if failures else 0


def _kill(process: int) -> None:
    with suppress(ProcessLookupError):  # it has just ended
        os.killpg(process, signal.SIGKILL)


def _machine() -> str:
    """Return the processor and the number of its cores."""
    return setting().partition("; ")[2].rpartition(", load")[0]


if __name__ == "__main__":
    sys.exit(main())
