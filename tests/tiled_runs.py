"""Comparisons in tiles as processes that tests kill. Run as a script: REFERENCE CANDIDATE WORKSPACE OUTPUT OPTIONS."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

from repository import ROOT, TESTS


def main(reference, candidate, workspace, output, options):
    """Compare two files, and write the result as `as_document` returns it."""
    from tiled_pairs import compare_on_disk

    from pcbench.measure.settings import Settings
    from pcbench.measure.tiled.settings import TilingSettings

    found = compare_on_disk(
        Path(reference),
        {"a": Path(candidate)},
        Settings(register="icp"),
        TilingSettings(**json.loads(options)),
        workspace=Path(workspace),
        maps=Path(workspace) / "maps",
    )
    Path(output).write_text(as_document(found))


def as_document(comparison):
    """comparison.json without what depends on the tiles and the machine, with the points of the maps."""
    from pcbench.report.document import document

    values = document(comparison)
    values["provenance"] = values["tiling"] = None
    for candidate in values["candidates"]:
        candidate["timings_s"] = candidate["peak_rss_bytes"] = None
    maps = [
        [way.points.tobytes().hex(), way.rows.tolist(), *(scalars.tobytes().hex() for scalars in way.scalars.values())]
        for candidate in comparison
        for way in (candidate.deviation, candidate.completeness)
    ]
    return json.dumps([values, maps])


def start(reference, candidate, workspace, output, **options):
    """Start a comparison in a separate process."""
    workspace.mkdir(exist_ok=True)
    arguments = [*map(str, (reference, candidate, workspace, output)), json.dumps(options)]
    path = os.pathsep.join([str(ROOT), str(TESTS), os.environ.get("PYTHONPATH", "")])
    return subprocess.Popen([sys.executable, __file__, *arguments], env=os.environ | {"PYTHONPATH": path})


def wait_for_results(workspace, stage, count, process):
    """Wait until a stage has stored that many results; the process must be running then."""
    while len(list(workspace.rglob(f"results/{stage}/*.result"))) < count:
        assert process.poll() is None, "the comparison ended before this stage"
        time.sleep(0.005)


def children(pid):
    """Processes that a process has started."""
    found = set()
    for file in Path("/proc").glob("[0-9]*/stat"):
        try:
            if int(file.read_text().rpartition(")")[2].split()[1]) == pid:
                found.add(int(file.parent.name))
        except OSError:
            continue
    return found


def kill(*pids):
    for pid in pids:
        os.kill(pid, signal.SIGKILL)


if __name__ == "__main__":
    main(*sys.argv[1:])
