"""Names of candidates: which a report can have, and those that files get."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pcbench.errors import InputError

_LONGEST_NAME = 220  # bytes: names of files have 255, and what stands after it is `_poisson_distance.png` at most
_UNPRINTABLE = re.compile(r"[\x00-\x1f\x7f-\x9f\u2028\u2029]")  # what breaks the lines of tables


def check_name(name: Any) -> str:
    """A candidate's name becomes part of file names.

    Raises:
        InputError: it is empty, reserved, too long, or would lead out of the report's folder.
    """
    reserved = ("", ".", "..", "reference")
    if not isinstance(name, str) or name in reserved or _UNPRINTABLE.search(name) or any(c in name for c in "/\\"):
        raise InputError(f"expected a candidate's name that a file can have, other than 'reference', got {name!r}")
    if (size := len(os.fsencode(name))) > _LONGEST_NAME:
        raise InputError(
            f"{name[:20]}...: expected a candidate's name of at most {_LONGEST_NAME} bytes, as the report's files are"
            f" called by it, got {size}: call the file by a shorter one"
        )
    return name


def names_of(paths: Sequence[Path]) -> list[str]:
    """A name for each candidate: its file's stem, with a number where stems are equal.

    Raises:
        InputError: a stem cannot be part of file names.
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
