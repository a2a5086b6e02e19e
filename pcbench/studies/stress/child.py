"""Runs cells of the stress study in a child process: `python -m pcbench.studies.stress.child BATCH.json`.

The batch lists the runs with their records. Before each run its number is written to BATCH.at: if the process dies or
hangs, the parent knows in which run. A run that exceeds the time limit ends the process, also inside native code.
"""

from __future__ import annotations

import faulthandler
import json
import sys
from pathlib import Path
from typing import Any

from pcbench.errors import MissingExtra
from pcbench.extras import require
from pcbench.studies.folder import write_record
from pcbench.studies.stress.cells import RunPlan, build_pair, load_pair, run_cell
from pcbench.studies.stress.methods import METHODS
from pcbench.studies.stress.results import GLOBAL, REGISTRATION
from pcbench.studies.stress.scenes import scene_pair

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
    _warm_up(batch["runs"])
    pair, of_plan = None, None
    for number, run in enumerate(batch["runs"]):
        plan = RunPlan(**run["plan"])
        path.with_suffix(".at").write_text(str(number), encoding="utf-8")
        faulthandler.dump_traceback_later(batch["time_limit_s"], exit=True)
        if pair is None or of_plan != plan.pair:
            pair, of_plan = build_pair(plan, given), plan.pair
        result = run_cell(plan, pair)
        faulthandler.cancel_dump_traceback_later()
        write_record(Path(run["record"]), run["key"], result.values())


def _warm_up(runs: list[dict[str, Any]]) -> None:
    """Run each method on a tiny pair, so that the CPU seconds of the first run do not include imports."""
    tiny = scene_pair("object", 0, _TINY_POINTS)
    methods = {(run["plan"]["subject"], run["plan"]["method"]): run["plan"] for run in runs}
    for values in methods.values():
        plan = RunPlan(**values)
        if plan.subject == REGISTRATION:
            for module in METHODS[plan.method].modules:
                require(module)
            if METHODS[plan.method].scope == GLOBAL:
                continue  # its own child process imports again in each run
        run_cell(plan, tiny)


if __name__ == "__main__":
    main(sys.argv[1])
