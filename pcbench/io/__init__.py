"""Point clouds from and to files: the extension picks the format, see `formats.CLOUDS`.

To add a format, write a module with its reader beside the others and give it a line in `formats`.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import TypeGuard

from numpy.typing import ArrayLike

from pcbench.errors import InputError
from pcbench.geometry.cloud import Cloud, as_cloud
from pcbench.geometry.splats import filter_splats
from pcbench.io.colmap import model_file
from pcbench.io.files import Warn, as_path, check_output, finite_cloud, read_named
from pcbench.io.formats import CLOUDS, CloudFormat

__all__ = ["FILTERED", "CloudLike", "check_cloud_output", "is_path", "read_cloud", "to_cloud", "write_cloud"]

CloudLike = Cloud | ArrayLike | os.PathLike[str]  # what `to_cloud` takes; `ArrayLike` holds str, a path too
FILTERED = tuple(extension for extension, form in CLOUDS.items() if form.filtered)  # have classes and returns


def read_cloud(
    path: str | os.PathLike[str],
    *,
    on_warning: Callable[[str], None] | None = None,
    classes: Collection[int] | None = None,
    returns: str | Collection[int] | None = None,
    min_opacity: float | None = None,
    max_axis: float | None = None,
) -> Cloud:
    """The point cloud in a file, without the points whose coordinates are NaN or Inf.

    Args:
        path: a file with a known extension, in upper or lower case, or a folder with a COLMAP model.
        on_warning: called with one line for each thing left out ("a.ply: dropped 12 of 1000 points with NaN or Inf
            coordinates"); `warnings.warn` if not given.
        classes: only points of these classes, such as (2, 6); LAS, LAZ and COPC.
        returns: only the "first" or "last" return of each pulse, or those of these numbers; the same formats.
        min_opacity: only Gaussian splats of at least this opacity, 0 to 1; PLY files of splats, whose logits of
            opacities and logarithms of axes are understood.
        max_axis: only splats whose largest axis (standard deviation) is at most so long, in the file's unit.

    Raises:
        InputError: the file cannot be read or is not what its extension says, or no point is left by what was asked
            for; the message starts with the path.
        MissingExtra: an optional library is needed for this file.
    """

    def read(path: Path, warn: Warn) -> Cloud:
        form = _format(path)
        filters = {"classes": classes, "returns": returns} if classes is not None or returns is not None else {}
        if filters and not form.filtered:
            raise InputError(f"classes and returns are known in {', '.join(FILTERED)} only")
        return filter_splats(finite_cloud(form.read(path, warn, **filters), warn), min_opacity, max_axis)

    return read_named(model_file(as_path(path)), read, on_warning)


def is_path(given: object) -> TypeGuard[str | os.PathLike[str]]:
    """Whether something that stands where a cloud may stand is the path of one."""
    return isinstance(given, str | os.PathLike)


def to_cloud(given: CloudLike) -> Cloud:
    """A cloud as it is, one around an (N, 3) array, or the one in the file that a path names.

    Raises:
        InputError, MissingExtra: as `read_cloud` and `Cloud`.
    """
    return read_cloud(given) if isinstance(given, str | os.PathLike) else as_cloud(given)


def write_cloud(path: str | os.PathLike[str], cloud: CloudLike) -> None:
    """Writes a cloud, all or nothing: on an error an existing file stays as it was.

    Args:
        path: its extension picks the format.
        cloud: a cloud, its points (N, 3), or the path of a file with one.

    Raises:
        InputError: the extension is unknown, or the format cannot hold the cloud; or one of both is none.
        OSError: the file cannot be written.
    """
    path = as_path(path)
    write = _writer(path)
    write(path, to_cloud(cloud))


def check_cloud_output(path: Path, inputs: Sequence[Path] = (), others: Sequence[Path] = ()) -> None:
    """Say before a long computation that its cloud cannot be written there; inputs and others as for `check_output`.

    Raises:
        InputError: the extension is unknown or only read, the folder does not exist, or an input or another result
            would be replaced.
    """
    _writer(path)
    check_output(path, inputs, others)


def _writer(path: Path) -> Callable[[Path, Cloud], None]:
    try:
        writable = {extension: form for extension, form in CLOUDS.items() if form.write}
        is_known = path.name in CLOUDS or path.suffix.lower() in CLOUDS
        write = _format(path, CLOUDS if is_known else writable).write
        if write is None:
            raise InputError(f"{path.suffix} is read but not written: choose one of {', '.join(writable)}")
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    return write


def _format(path: Path, formats: Mapping[str, CloudFormat] = CLOUDS) -> CloudFormat:
    form = formats.get(path.name) or formats.get(path.suffix.lower())
    if form is None:
        known = ", ".join(extension for extension in formats if extension.startswith("."))
        raise InputError(f"expected a file that ends in {known}; got {path.suffix.lower() or 'no extension'!r}")
    return form
