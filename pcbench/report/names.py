"""Names of candidates, which become parts of file names."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from glob import has_magic
from pathlib import Path
from typing import Any

from pcbench.errors import InputError
from pcbench.io.paths import EPT, is_pattern

_MAX_NAME_BYTES = 220  # file names have at most 255 bytes, and the longest suffix is `_poisson_meshlab_distance.png`
# Characters that would break the lines of tables or reverse their text.
_UNPRINTABLE = re.compile(r"[\x00-\x1f\x7f-\x9f\u200e\u200f\u2028-\u202e\u2066-\u2069]")


def check_name(name: Any, reserved: str = "reference") -> str:
    """Return the name of a candidate if it can be part of file names, of which one name is taken.

    Raises:
        InputError: it is empty, reserved, too long, or has a path separator or unprintable characters.
    """
    if (
        not isinstance(name, str)
        or name in ("", ".", "..", reserved)
        or _UNPRINTABLE.search(name)
        or any(c in name for c in "/\\")
    ):
        raise InputError(f"expected a candidate's name that is valid in a file name and not {reserved!r}, got {name!r}")
    if (size := len(os.fsencode(name))) > _MAX_NAME_BYTES:
        raise InputError(
            f"{name[:20]}...: expected a candidate's name of at most {_MAX_NAME_BYTES} bytes, because the"
            f" report's files have it in their names, got {size}: rename the file"
        )
    return name


def names_of(paths: Sequence[Path], reserved: str = "reference") -> list[str]:
    """Return a name for each candidate: its file's stem, with a number if it is a reserved name.

    Equal stems get the nearest folder that distinguishes them as a prefix (`a/x.ply` and `b/x.ply` become `a_x` and
    `b_x`), or a number if there is none.

    Raises:
        InputError: a stem is not a valid name.
    """
    result: list[str] = []
    stems = [_with_folder(path, paths) for path in paths]
    taken = {*stems, reserved}
    for stem in stems:
        name, number = stem or "candidate", 2
        if name in result or name == reserved:
            while f"{stem}_{number}" in taken:
                number += 1
            name = f"{stem}_{number}"
            taken.add(name)
        result.append(check_name(name, reserved))
    return result


def _with_folder(path: Path, paths: Sequence[Path]) -> str:
    """Return the stem of a path, after the nearest folder that distinguishes all paths with this stem."""
    stem = _stem(path)
    same = [other for other in paths if _stem(other) == stem]
    if len(same) > 1:
        # From the nearest folder to the root; paths of different depth are compared up to the shortest one.
        for level in zip(_folders(path), *map(_folders, same), strict=False):
            name = f"{level[0]}_{stem}"
            if len({*level[1:]}) == len(same) and len(os.fsencode(name)) <= _MAX_NAME_BYTES:
                return name
    return stem


def _stem(path: Path) -> str:
    """Return the stem of a file, or the name of a folder; that of the folder of a pattern or of an `ept.json`."""
    if path.name == EPT or is_pattern(path):
        folders = Path(os.path.abspath(path)).parent.parts  # noqa: PTH100 - `resolve` would follow links
        name = next((folder for folder in folders[::-1] if not has_magic(folder)), "")
    else:
        name = path.name if path.is_dir() else path.stem
    return _UNPRINTABLE.sub("_", name)


def _folders(path: Path) -> list[str]:
    """Return the names of a path's folders as parts of file names, the nearest first."""
    folders = Path(os.path.abspath(path)).parent.parts[:0:-1]  # noqa: PTH100 - `resolve` would follow links
    return [_UNPRINTABLE.sub("_", folder).replace("\\", "_") for folder in folders]
