"""Checks of outputs before a computation: no result may replace an input or another result."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from pcbench.errors import InputError
from pcbench.io.paths import input_files


def check_output(path: Path, inputs: Sequence[Path], others: Sequence[Path] = ()) -> None:
    """Check before a computation that a result can be written to a path.

    Args:
        path: output file.
        inputs: input files, and folders in which no file may be replaced.
        others: other outputs, which must differ from this one.

    Raises:
        InputError: the folder does not exist, or an input or another result would be replaced.
    """
    target = path.resolve()
    for input_path in (file for named in inputs for file in input_files(named)):
        if target == input_path.resolve() or (path.exists() and target.is_relative_to(input_path.resolve())):
            raise InputError(f"{path}: the result would replace an input: choose another name")
    if any(target == other.resolve() for other in others):
        raise InputError(f"{path}: two results would be written to this file: give each its own name")
    if path.is_dir():
        raise InputError(f"{path}: expected a file name, got a folder: name a file inside it")
    if path.exists() and not path.is_file():
        raise InputError(f"{path}: expected a regular file, got a device or a pipe: choose another name")
    if not path.absolute().parent.is_dir():
        raise InputError(f"{path}: expected a file name in an existing folder: create the folder or choose another one")
