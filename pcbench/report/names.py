"""Names of candidates, which become parts of file names."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pcbench.errors import InputError

_MAX_NAME_BYTES = 220  # file names have at most 255 bytes, and the longest suffix is `_poisson_meshlab_distance.png`
_UNPRINTABLE = re.compile(r"[\x00-\x1f\x7f-\x9f\u2028\u2029]")  # characters that would break table lines


def check_name(name: Any) -> str:
    """Return the name of a candidate if it can be part of file names.

    Raises:
        InputError: it is empty, reserved, too long, or has a path separator or unprintable characters.
    """
    reserved = ("", ".", "..", "reference")
    if not isinstance(name, str) or name in reserved or _UNPRINTABLE.search(name) or any(c in name for c in "/\\"):
        raise InputError(f"expected a candidate's name that is valid in a file name and not 'reference', got {name!r}")
    if (size := len(os.fsencode(name))) > _MAX_NAME_BYTES:
        raise InputError(
            f"{name[:20]}...: expected a candidate's name of at most {_MAX_NAME_BYTES} bytes, because the"
            f" report's files have it in their names, got {size}: rename the file"
        )
    return name


def names_of(paths: Sequence[Path]) -> list[str]:
    """Return a name for each candidate: its file's stem, with a number if stems are equal.

    Raises:
        InputError: a stem is not a valid name.
    """
    result: list[str] = []
    stems = [_UNPRINTABLE.sub("_", path.stem) for path in paths]
    taken = {*stems, "reference"}
    for stem in stems:
        name, number = stem or "candidate", 2
        if name in result or name == "reference":
            while f"{stem}_{number}" in taken:
                number += 1
            name = f"{stem}_{number}"
            taken.add(name)
        result.append(check_name(name))
    return result
