"""Figures of the running text that repeat a figure of a stored run: `python docs/quoted_figures.py`.

docs/measured/quoted.toml has a line for each:

    [TEXT, RUN, LINE, VALUE]

TEXT is a regular expression with a group around the figure of the page, LINE one around the figure of the run, which is
searched in each line. VALUE says which of several counts: `first`, `last`, `least` or `largest`. Figures are equal if
they agree after rounding to the decimals of the page. Prints a line for each figure that differs.
"""

from __future__ import annotations

import re
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

from written_tables import ROOT, read_run

QUOTED = "docs/measured/quoted.toml"
_VALUES = {"first": lambda values: values[0], "last": lambda values: values[-1], "least": min, "largest": max}


def differing_figures(root: Path) -> Iterator[str]:
    """Yield a line for each quoted figure that differs from its run, or that is not found; a missing run is none."""
    if not (root / QUOTED).is_file():
        return
    content = tomllib.loads((root / QUOTED).read_text())
    for page, figures in content["figures"].items():
        text = " ".join((root / page).read_text().split())
        for pattern, name, line_pattern, value in figures:
            run = read_run(root, content["runs"][name])
            if run is None:
                continue
            quoted = re.findall(pattern, text)
            found = [_number(each) for line in run.lines for each in re.findall(line_pattern, line)]
            if len(quoted) != 1 or not found:
                yield f"{page}: expected {pattern!r} once, got {len(quoted)}; {line_pattern!r} in the run: {len(found)}"
                continue
            decimals = len(quoted[0].partition(".")[2])
            measured = f"{_VALUES[value](found):.{decimals}f}"
            if float(measured) != _number(quoted[0]):
                yield f"{page}: {quoted[0]} in {pattern!r} is {measured} in the last run of {run.command}"


def _number(text: str) -> float:
    return float(text.replace(",", "").rstrip("%"))


if __name__ == "__main__":
    print(*differing_figures(ROOT), sep="\n")
    sys.exit(0)
