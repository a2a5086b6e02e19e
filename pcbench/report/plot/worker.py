"""The drawing process: `python -m pcbench.report.plot.worker FOLDER MODULE:FUNCTION [NAME...]`.

The function says which pictures the folder has (`pcbench.report.plot.Drawer`); they are written into FOLDER/figures,
and the names of the files are printed. A user's mistake is printed as one line, with exit code 2.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from importlib import import_module
from pathlib import Path

from pcbench.errors import PcbenchError
from pcbench.report.plot import Picture
from pcbench.report.read import damage_in_one_line


def draw(folder: Path, pictures: Mapping[str, Picture], wanted: Sequence[str]) -> list[Path]:
    """Draw all pictures, or those that are wanted; the files that were written, relative to the folder."""
    if unknown := [name for name in wanted if name not in pictures]:
        raise PcbenchError(f"no picture {unknown[0]!r}: expected {', '.join(pictures)}")
    (folder / "figures").mkdir(exist_ok=True)
    written = []
    for name in wanted or pictures:
        path = folder / "figures" / f"{name}.png"
        if pictures[name].draw(path):
            written.append(path.relative_to(folder))
        elif name in wanted:
            raise PcbenchError(f"no picture {name!r}: {pictures[name].why_not}")
    return written


def main() -> int:
    folder, function, *wanted = sys.argv[1:]
    module, _, name = function.partition(":")
    try:
        find = getattr(import_module(module), name)
        with damage_in_one_line(Path(folder)):
            written = draw(Path(folder), find(Path(folder)), wanted)
    except PcbenchError as error:
        print(" ".join(str(error).split()))
        return 2
    print("\n".join(str(path) for path in written))
    return 0


if __name__ == "__main__":
    sys.exit(main())
