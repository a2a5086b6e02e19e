"""The drawing process: `python -m pcbench.report.plot.worker FOLDER MODULE:FUNCTION FIGURES [NAME...]`.

FIGURES is the appearance of the pictures as JSON. The function returns the pictures of the folder
(`pcbench.report.plot.Drawer`). They are written into FOLDER/figures, and the names of the files are printed. A user
error is printed as one line, with exit code 2.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence
from importlib import import_module
from pathlib import Path

from pcbench.errors import PcbenchError, did_you_mean
from pcbench.report.figures import FORMATS, Figures
from pcbench.report.manifest import check_figures_folder
from pcbench.report.plot import Picture
from pcbench.report.plot.panels import drawing_style
from pcbench.report.read import damage_in_one_line


def draw(folder: Path, function: str, look: Figures, wanted: Sequence[str] = ()) -> list[Path]:
    """Draw all or some pictures of a folder.

    Args:
        folder: the folder.
        function: `module:function` that returns its pictures.
        look: appearance of the pictures.
        wanted: names of pictures; an extension selects the format.

    Returns:
        The written files, relative to the folder.

    Raises:
        PcbenchError: there is no such picture, or the folder is damaged.
    """
    check_figures_folder(folder)
    module, _, name = function.partition(":")
    pictures: Mapping[str, Picture] = getattr(import_module(module), name)(folder, look)
    requested = [_split(name, pictures, look) for name in wanted]
    if unknown := [name for name, _ in requested if name not in pictures]:
        hint = did_you_mean(unknown[0], pictures)
        raise PcbenchError(f"no picture {unknown[0]!r}: expected {', '.join(pictures)}{hint}")
    (folder / "figures").mkdir(exist_ok=True)
    written = []
    with drawing_style(look):
        for name, ending in requested or [(name, look.format) for name in pictures]:
            path = folder / (pictures[name].file or f"figures/{name}.{ending}")
            if pictures[name].draw(path):
                written.append(path.relative_to(folder))
            elif requested:
                raise PcbenchError(f"no picture {name!r}: {pictures[name].reason}")
    return written


def _split(name: str, pictures: Mapping[str, Picture], look: Figures) -> tuple[str, str]:
    """Return the name and the format of a requested picture."""
    stem, dot, ending = name.rpartition(".")
    return (stem, ending) if name not in pictures and dot and ending in FORMATS else (name, look.format)


def main() -> int:
    """Draw the pictures and return the exit code."""
    folder, function, style, *wanted = sys.argv[1:]
    try:
        with damage_in_one_line(Path(folder)):
            written = draw(Path(folder), function, Figures(**json.loads(style)), wanted)
    except PcbenchError as error:
        print(" ".join(str(error).split()))
        return 2
    for path in written:
        print(path)
    return 0


if __name__ == "__main__":
    sys.exit(main())
