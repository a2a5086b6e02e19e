"""Marks written into pictures, so that only pictures drawn by pcbench are replaced."""

from __future__ import annotations

from collections.abc import Collection
from os import SEEK_END
from pathlib import Path
from typing import Any

from pcbench.errors import InputError
from pcbench.regular_files import open_regular

METADATA: dict[str, dict[str, Any]] = {
    "png": {"Software": "pcbench"},
    "svg": {"Creator": "pcbench", "Date": None},
    "pdf": {"Creator": "pcbench", "CreationDate": None},
}
"""Metadata of pictures by format, without dates, so that the same figure gives the same bytes."""

_MARKS = {".png": b"Software\0pcbench", ".svg": b"<dc:title>pcbench<", ".pdf": b"/Creator (pcbench)"}
_MARKED_BYTES = 4096  # at the start or the end of a file, which contain the mark


def check_picture(path: Path, formats: Collection[str] = ("png",)) -> None:
    """Check that a picture can be written to a path: photographs and textures are pictures too.

    Args:
        path: the file.
        formats: the formats that can be written.

    Raises:
        InputError: the file exists and was not drawn by pcbench, or its extension is not that of a format.
    """
    extension = path.suffix.lower()
    if not path.is_file():
        if extension[1:] not in formats:
            raise InputError(f"{path}: expected the extension {' or '.join(f'.{name}' for name in formats)}")
        return
    with open_regular(path) as file:
        start = file.read(_MARKED_BYTES)
        file.seek(-min(_MARKED_BYTES, file.seek(0, SEEK_END)), SEEK_END)
        end = file.read()
    mark = _MARKS.get(extension) if extension[1:] in formats else None
    if mark is None or not (mark in start or mark in end):
        raise InputError(f"{path}: the file exists and is not a picture of pcbench: choose another name")
