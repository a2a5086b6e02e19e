"""Point clouds from and to files: the extension picks the format."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from pcbench.cloud import Cloud
from pcbench.errors import InputError
from pcbench.io import colmap
from pcbench.io.files import Fields, Warn, check_readable
from pcbench.io.numpy_files import read_npy, read_npz, write_npy, write_npz
from pcbench.io.ply import read_ply, write_ply

__all__ = ["read_cloud", "write_cloud"]


class _Format(NamedTuple):
    """Readers name neither the path in their errors nor drop NaN points: `read_cloud` does both for all of them."""

    read: Callable[[Path, Warn], Fields]
    write: Callable[[Path, Cloud], None]


_FORMATS = {
    ".npy": _Format(read_npy, write_npy),
    ".npz": _Format(read_npz, write_npz),
    ".ply": _Format(read_ply, write_ply),
}


def _no_colmap(path: Path, cloud: Cloud) -> None:
    raise InputError(f"{path}: COLMAP models are read, not written: write a .ply file instead")


_COLMAP = _Format(colmap.read_colmap, _no_colmap)


def read_cloud(path: str | os.PathLike[str], *, on_warning: Callable[[str], None] | None = None) -> Cloud:
    """The point cloud in a file, without the points whose coordinates are NaN or Inf.

    Args:
        path: a file with a known extension, in upper or lower case, or a folder with a COLMAP model.
        on_warning: called with one line for each thing left out ("a.ply: dropped 12 of 1000 points with NaN or Inf
            coordinates"); `warnings.warn` if not given.

    Raises:
        InputError: the file cannot be read or is not what its extension says; the message starts with the path.
    """
    path = Path(path)
    notes: list[str] = []
    try:
        path = colmap.model_file(path)
        check_readable(path)
        fields = _format(path).read(path, notes.append)
        count = len(fields["points"])
        cloud, dropped = Cloud.from_finite(**fields)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error
    except MemoryError as error:
        raise InputError(f"{path}: does not fit into memory") from error
    if dropped:
        notes.append(f"dropped {dropped} of {count} points with NaN or Inf coordinates")
    for note in notes:
        if on_warning is None:
            warnings.warn(f"{path}: {note}", stacklevel=2)
        else:
            on_warning(f"{path}: {note}")
    return cloud


def write_cloud(path: str | os.PathLike[str], cloud: Cloud) -> None:
    """Writes a cloud, all or nothing: on an error an existing file stays as it was.

    Raises:
        InputError: the extension is unknown, or the format cannot hold the cloud.
        OSError: the file cannot be written.
    """
    path = Path(path)
    try:
        form = _format(path)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    form.write(path, cloud)


def _format(path: Path) -> _Format:
    if path.name in colmap.NAMES:
        return _COLMAP
    extension = path.suffix.lower()
    if extension not in _FORMATS:
        raise InputError(f"expected a file that ends in {', '.join(_FORMATS)}; got {extension or 'no extension'!r}")
    return _FORMATS[extension]
