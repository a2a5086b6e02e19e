"""Helpers for tests of the command line: report folders and errors."""

import json
import re
from pathlib import Path

# Files in each report folder.
REPORT = {"report.html", "comparison.json", "metrics.csv", "table.md", "settings.json", "manifest.json", "maps"}

_PROGRESS = re.compile(r"^\[\d+:\d\d\] .*\n", re.MULTILINE)


def read_comparison(folder):
    return json.loads((Path(folder) / "comparison.json").read_text())


def without_timings(values):
    values["provenance"] = None
    for candidate in values["candidates"]:
        candidate["timings_s"] = candidate["peak_rss_bytes"] = None
    return values


def without_progress(err):
    """Return standard error without the progress lines that it has on a busy machine."""
    return _PROGRESS.sub("", err)


def is_one_line(err):
    """Return whether standard error is a one-line error."""
    err = without_progress(err)
    return err.startswith("error: ") and err.count("\n") == 1 and "Traceback" not in err
