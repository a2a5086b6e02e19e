"""Runs cells of the stress study in a child process: `python -m pcbench.studies.stress.child BATCH.json`.

The batch lists the runs with their records. Before each run its number is written to BATCH.at: if the process dies or
hangs, the parent knows in which run. A run that exceeds the time limit ends the process, also inside native code. The
parent removes the batch to stop the process after its current run.
"""

from __future__ import annotations

import faulthandler
import json
import sys
from pathlib import Path
from typing import Any

from pcbench.errors import MissingExtra
from pcbench.extras import require
from pcbench.studies.frame.records import write_record
from pcbench.studies.stress.cells import RunPlan, build_pair, load_pair, run_cell
from pcbench.studies.stress.scenes import scene_pair
from pcbench.studies.stress.subjects import PAIR_SUBJECTS

MISSING_LIBRARY = 3  # exit code
_TINY_POINTS = 1000


def main(file: str) -> None:
    """Run all runs of a batch and write their records."""
    path = Path(file)
    batch = json.loads(path.read_text(encoding="utf-8"))
    try:
        _run_all(path, batch)
    except MissingExtra as error:
        print(error, file=sys.stderr)
        sys.exit(MISSING_LIBRARY)


def _run_all(path: Path, batch: dict[str, Any]) -> None:
    given = None if batch["given"] is None else load_pair(Path(batch["given"]))
    plans = [RunPlan(**run["plan"]) for run in batch["runs"]]
    _warm_up(plans)
    pair, of_plan = None, None
    for number, (plan, run) in enumerate(zip(plans, batch["runs"], strict=True)):
        if not path.is_file():  # the study was interrupted
            return
        path.with_suffix(".at").write_text(str(number), encoding="utf-8")
        faulthandler.dump_traceback_later(batch["time_limit_s"], exit=True)
        if pair is None or of_plan != plan.pair:
            pair, of_plan = build_pair(plan, given), plan.pair
        result = run_cell(plan, pair)
        faulthandler.cancel_dump_traceback_later()
        write_record(Path(run["record"]), run["key"], result)


def _warm_up(plans: list[RunPlan]) -> None:
    """Import what the runs need, so that the CPU seconds of the first ones do not include it."""
    tiny = scene_pair("object", 0, _TINY_POINTS)
    for subject in {PAIR_SUBJECTS[plan.subject] for plan in plans}:
        for name in {plan.method for plan in plans if plan.subject == subject.name}:
            for module in subject.methods[name].modules:
                require(module)
        subject.warm_up(tiny)


if __name__ == "__main__":
    main(sys.argv[1])
