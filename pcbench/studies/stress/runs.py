"""Run the cells of a plan in child processes of workers, and read their records.

A crash of a native library or a run that hangs ends its child only: it becomes an outcome, and a new child goes on
with the next run. Records of earlier runs are reused if nothing that they depend on has changed.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from pcbench.children import run_module
from pcbench.errors import InputError
from pcbench.extras import installed_versions
from pcbench.io.json_values import from_json
from pcbench.studies.frame.cells import MEMORY_ADVICE
from pcbench.studies.frame.code import measuring_code_digest
from pcbench.studies.frame.records import read_record, write_record
from pcbench.studies.stress.cells import RECORDS, RunPlan, failed_run
from pcbench.studies.stress.child import MISSING_LIBRARY
from pcbench.studies.stress.subject import CRASH, TIME_OUT, RunResult
from pcbench.studies.stress.subjects import PAIR_SUBJECTS
from pcbench.systems import cpu_count, signal_name
from pcbench.tasks import Task, TaskRunner, Workers
from pcbench.threads import ONE_THREAD

WORK = "work"  # folder of temporary files
_CHILD = "pcbench.studies.stress.child"
_KILLED = "SIGKILL"  # message of a run whose process was killed, as by a system without memory
_TIMED_OUT = "Timeout ("  # start of the traceback that the time limit of a run prints
# Modules of this study that a run depends on.
_OWN_MODULES = (
    "cells",
    "changes",
    "child",
    "ladders",
    "methods",
    "metrics",
    "registration",
    "scenes",
    "subject",
    "surfaces",
    "verdicts",
)
_BATCH_RUNS = (16, 40)  # fewest and most runs of a child process, whose start takes seconds
_ALL_CPUS = Workers()


@dataclass(frozen=True)
class RunSettings:
    """Settings that all runs of a study share.

    Attributes:
        out: folder of the study.
        time_limit_s: time limit of a run, in seconds.
        given: file of the given pair; None for built-in scenes.
        given_digest: SHA-256 of the given pair.
    """

    out: Path
    time_limit_s: float
    given: Path | None = None
    given_digest: str = ""

    def absolute(self) -> RunSettings:
        """Return the settings with absolute paths."""
        given = None if self.given is None else self.given.absolute()
        return replace(self, out=self.out.absolute(), given=given)

    def key(self, plan: RunPlan, code: str) -> dict[str, Any]:
        """Return all inputs that a run's result depends on."""
        library = PAIR_SUBJECTS[plan.subject].methods[plan.method].library
        return {
            "plan": asdict(plan),
            "code": code,
            "library": installed_versions([library]).get(library, ""),
            "given": self.given_digest,
            "time_limit_s": self.time_limit_s,
        }


def run_all(
    plans: Sequence[RunPlan],
    settings: RunSettings,
    step: Callable[[str], None] = lambda _: None,
    workers: Workers = _ALL_CPUS,
) -> list[RunResult]:
    """Run all plans that have no record yet, and return the results of all.

    Raises:
        InputError: an optional library is installed but cannot be loaded.
        WorkerError: the cluster cannot be used.
        OSError: a record cannot be written.
    """
    settings = settings.absolute()  # workers of a cluster have other folders
    shutil.rmtree(settings.out / WORK, ignore_errors=True)
    for name in (RECORDS, WORK):
        (settings.out / name).mkdir(exist_ok=True)
    code = code_digest()
    keys = {plan: settings.key(plan, code) for plan in plans}
    missing = [plan for plan in plans if not _is_final(_read(plan.record(settings.out), keys[plan], plan))]
    smallest, largest = _BATCH_RUNS
    batches = _batches(missing, min(largest, max(smallest, len(missing) // (4 * (workers.count or cpu_count())))))
    tasks = [
        Task(f"batch-{number}", (f"batch_{number}", batch, settings, {plan: keys[plan] for plan in batch}), len(batch))
        for number, batch in enumerate(batches)
    ]
    try:
        with TaskRunner(workers, settings.out / WORK, step, unit="runs", memory_advice=MEMORY_ADVICE) as runner:
            runner.run("batches", _run_batch, tasks, title="done")
    finally:
        shutil.rmtree(settings.out / WORK, ignore_errors=True)  # without its batch, a child ends after its run
    results = []
    for plan in plans:
        result = _read(plan.record(settings.out), keys[plan], plan)
        if result is None:
            raise InputError(f"{plan.record(settings.out)}: the record of a run was removed: run the study again")
        results.append(result)
    return results


def code_digest() -> str:
    """Return the SHA-256 of the code of pcbench that results of runs depend on."""
    return measuring_code_digest("stress", _OWN_MODULES)


def _batches(plans: Iterable[RunPlan], size: int) -> Iterator[list[RunPlan]]:
    """Yield the runs of one child process each: of one subject, about `size`, all runs of a pair in the same one."""
    batch: list[RunPlan] = []
    for plan in plans:
        if batch and (plan.subject != batch[-1].subject or (len(batch) >= size and plan.pair != batch[-1].pair)):
            yield batch
            batch = []
        batch.append(plan)
    if batch:
        yield batch


def _run_batch(
    name: str, batch: Iterable[RunPlan], settings: RunSettings, keys: Mapping[RunPlan, Mapping[str, Any]]
) -> None:
    """Run a batch in one child process; after a crash or a time-out, the rest in a new one."""
    remaining = list(batch)
    file = settings.out / WORK / f"{name}.json"
    current = file.with_suffix(".at")
    while remaining:
        rows = [
            {"plan": asdict(plan), "record": str(plan.record(settings.out).absolute()), "key": keys[plan]}
            for plan in remaining
        ]
        given = None if settings.given is None else str(settings.given.absolute())
        values = {"given": given, "time_limit_s": settings.time_limit_s, "runs": rows}
        file.write_text(json.dumps(values), encoding="utf-8")
        current.unlink(missing_ok=True)
        ended = run_module(_CHILD, str(file.absolute()), environment=ONE_THREAD)
        if ended.code == 0:
            break
        if ended.code == MISSING_LIBRARY:
            raise InputError(ended.last_error_line)
        if not current.is_file():
            raise InputError(f"the process of the runs did not start: {ended.last_error_line or 'no message'}")
        number = int(current.read_text(encoding="utf-8"))
        plan = remaining[number]
        if _TIMED_OUT in ended.errors:
            result = failed_run(plan, TIME_OUT, f"stopped after {settings.time_limit_s:g} s")
        else:
            text = signal_name(-ended.code) if ended.code < 0 else ended.last_error_line
            result = failed_run(plan, CRASH, text or f"exit code {ended.code}")
        write_record(plan.record(settings.out), keys[plan], result)
        remaining = remaining[number + 1 :]
    file.unlink(missing_ok=True)
    current.unlink(missing_ok=True)


def _read(path: Path, key: Mapping[str, Any], plan: RunPlan) -> RunResult | None:
    """Return the result that was recorded for the same inputs; None if there is none or it is damaged."""
    values = read_record(path, key, dict[str, Any])
    if values is None:
        return None
    cell = PAIR_SUBJECTS[plan.subject].cell
    try:
        return RunResult(tuple(from_json(cell, row) for row in values["cells"]), values["pose"])
    except (KeyError, TypeError, ValueError):
        return None


def _is_final(result: RunResult | None) -> bool:
    """Return whether a run need not be repeated; the system or a user may have killed its process."""
    return result is not None and not any(cell.outcome == CRASH and cell.message == _KILLED for cell in result.cells)
