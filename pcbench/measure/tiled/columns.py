"""Columns of points on disk: one array per numbered part of a cloud and column."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pcbench.tasks.codec import write_array
from pcbench.tasks.files import task_file


def column_file(folder: Path, number: int, column: str) -> Path:
    """Return the file of a column of a part of a cloud."""
    return folder / f"{number:06d}.{column}.npy"


def load_column(folder: Path, number: int, column: str) -> NDArray[Any]:
    """Return a column of a part of a cloud."""
    values: NDArray[Any] = np.load(column_file(folder, number, column))
    return values


def save_column(folder: Path, number: int, column: str, values: NDArray[Any]) -> None:
    """Store a column of a part of a cloud, and keep its digest with the result of the task."""
    with task_file(column_file(folder, number, column)) as file:
        write_array(file, values)
