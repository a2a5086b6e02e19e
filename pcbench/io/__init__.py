"""Point clouds from and to files: the extension picks the format."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Collection
from functools import partial
from pathlib import Path
from typing import NamedTuple

from pcbench.errors import InputError
from pcbench.geometry.arrays import freeze
from pcbench.geometry.cloud import Cloud
from pcbench.io import colmap
from pcbench.io.files import Fields, check_output, check_readable
from pcbench.io.las import read_las, write_las
from pcbench.io.numpy_files import read_npy, read_npz, write_npy, write_npz
from pcbench.io.pcd import read_pcd, write_pcd
from pcbench.io.ply import read_ply, write_ply
from pcbench.io.text import read_text, write_text

__all__ = ["FILTERED", "check_cloud_output", "read_cloud", "write_cloud"]


class _Format(NamedTuple):
    """Readers name neither the path in their errors nor drop NaN points: `read_cloud` does both for all of them."""

    read: Callable[..., Fields]  # (path, warn), and the filters of FILTERED
    write: Callable[[Path, Cloud], None] | None


_FORMATS = {
    ".asc": _Format(read_text, write_text),
    ".csv": _Format(read_text, write_text),
    ".las": _Format(read_las, write_las),
    ".laz": _Format(read_las, write_las),  # .copc.laz too
    ".npy": _Format(read_npy, write_npy),
    ".npz": _Format(read_npz, write_npz),
    ".pcd": _Format(read_pcd, write_pcd),
    ".ply": _Format(read_ply, write_ply),
    ".pts": _Format(read_text, None),
    ".txt": _Format(read_text, write_text),
    ".xyz": _Format(read_text, write_text),
}
_COLMAP = _Format(colmap.read_colmap, None)  # by its file's name: points3D.bin, points3D.txt
FILTERED = (".las", ".laz")  # their readers take classes and returns


def read_cloud(
    path: str | os.PathLike[str],
    *,
    on_warning: Callable[[str], None] | None = None,
    classes: Collection[int] | None = None,
    returns: str | Collection[int] | None = None,
) -> Cloud:
    """The point cloud in a file, without the points whose coordinates are NaN or Inf.

    Args:
        path: a file with a known extension, in upper or lower case, or a folder with a COLMAP model.
        on_warning: called with one line for each thing left out ("a.ply: dropped 12 of 1000 points with NaN or Inf
            coordinates"); `warnings.warn` if not given.
        classes: only points of these classes, such as (2, 6); LAS, LAZ and COPC.
        returns: only the "first" or "last" return of each pulse, or those of these numbers; the same formats.

    Raises:
        InputError: the file cannot be read or is not what its extension says, or no point is of these classes and
            returns; the message starts with the path.
        MissingExtra: an optional library is needed for this file.
    """
    path = Path(path)
    notes: list[str] = []
    try:
        path = colmap.model_file(path)
        check_readable(path)
        read = _format(path).read
        if classes is not None or returns is not None:
            if path.suffix.lower() not in FILTERED:
                raise InputError(f"classes and returns are known in {', '.join(FILTERED)} only")
            read = partial(read, classes=classes, returns=returns)
        fields = _frozen(read(path, notes.append))
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


def _frozen(fields: Fields) -> Fields:
    """A reader's arrays, which nobody else holds, as a cloud keeps them without a copy."""
    for array in (
        fields["points"],
        fields.get("normals"),
        fields.get("colors"),
        *fields.get("attributes", {}).values(),
    ):
        if array is not None:
            freeze(array)
    return fields


def write_cloud(path: str | os.PathLike[str], cloud: Cloud) -> None:
    """Writes a cloud, all or nothing: on an error an existing file stays as it was.

    Raises:
        InputError: the extension is unknown, or the format cannot hold the cloud.
        OSError: the file cannot be written.
    """
    path = Path(path)
    _writer(path)(path, cloud)


def check_cloud_output(path: Path) -> None:
    """Say before a long computation that its cloud cannot be written there.

    Raises:
        InputError: the extension is unknown or only read, or the folder does not exist.
    """
    _writer(path)
    check_output(path, ())


def _writer(path: Path) -> Callable[[Path, Cloud], None]:
    try:
        write = _format(path).write
        if write is None:
            writable = ", ".join(extension for extension, form in _FORMATS.items() if form.write)
            raise InputError(f"{path.suffix} is read but not written: choose one of {writable}")
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    return write


def _format(path: Path) -> _Format:
    if path.name in colmap.NAMES:
        return _COLMAP
    extension = path.suffix.lower()
    if extension not in _FORMATS:
        raise InputError(f"expected a file that ends in {', '.join(_FORMATS)}; got {extension or 'no extension'!r}")
    return _FORMATS[extension]
