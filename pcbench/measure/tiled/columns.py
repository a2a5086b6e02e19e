"""Columns of points on disk: one array per numbered part of a cloud and column."""

from __future__ import annotations

import io
import mmap
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcbench.tasks.codec import write_array
from pcbench.tasks.files import task_file

_PREFIX_BYTES = 10  # of a file of numpy: magic string, version, and length of the description that follows


class _Layout(NamedTuple):
    shape: tuple[int, ...]
    dtype: np.dtype[Any]


def column_file(folder: Path, number: int, column: str) -> Path:
    """Return the file of a column of a part of a cloud."""
    return folder / f"{number:06d}.{column}.npy"


def load_column(folder: Path, number: int, column: str) -> NDArray[Any]:
    """Return a column of a part of a cloud."""
    values: NDArray[Any] = np.load(column_file(folder, number, column))
    return values


def map_column(file: Path) -> NDArray[Any]:
    """Return a file of `save_column` as a read-only array that is read where it is used.

    A search in many tiles opens thousands of columns, and `numpy.load` takes several times as long: it resolves links
    and parses each description anew.

    Raises:
        ValueError: the file is no array, or shorter than its description states.
    """
    with file.open("rb") as opened:
        prefix = opened.read(_PREFIX_BYTES)
        header = prefix + opened.read(int.from_bytes(prefix[8:], "little"))
        layout = _layout(header)
        content = mmap.mmap(opened.fileno(), 0, access=mmap.ACCESS_READ)
    try:
        return np.ndarray(layout.shape, layout.dtype, content, len(header))
    except TypeError as error:
        raise ValueError(
            f"{file}: expected an array {layout.shape} of {layout.dtype}, got {len(content)} bytes"
        ) from error


@lru_cache
def _layout(header: bytes) -> _Layout:
    stream = io.BytesIO(header)
    np.lib.format.read_magic(stream)
    shape, _, dtype = np.lib.format.read_array_header_1_0(stream)
    return _Layout(shape, dtype)


def save_column(folder: Path, number: int, column: str, values: NDArray[Any]) -> None:
    """Store a column of a part of a cloud, and keep its digest with the result of the task."""
    with task_file(column_file(folder, number, column)) as file:
        write_array(file, values)
