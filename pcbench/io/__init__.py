"""Read and write point clouds. The file extension selects the format, see `formats.CLOUDS`.

To add a format, write a module with its reader next to the others and add a line to `formats`.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import TypeGuard

import numpy as np
from numpy.typing import ArrayLike

from pcbench.errors import InputError
from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.cloud import Cloud, as_cloud
from pcbench.geometry.splats import filter_splats
from pcbench.io.colmap import model_file
from pcbench.io.files import Warn, as_path, check_output, finite_cloud, read_named
from pcbench.io.formats import CLOUDS, CloudFormat

__all__ = [
    "FILTERABLE_EXTENSIONS",
    "CloudLike",
    "check_cloud_output",
    "is_path",
    "read_cloud",
    "to_cloud",
    "write_cloud",
]

_MIN_NULL_POINTS, _MIN_NULL_SHARE = 100, 0.001  # of points at the origin, for a warning

CloudLike = Cloud | ArrayLike | os.PathLike[str]  # accepted by `to_cloud`; `ArrayLike` includes str, so paths too
FILTERABLE_EXTENSIONS = tuple(
    extension for extension, form in CLOUDS.items() if form.filtered
)  # formats with classes and returns


def read_cloud(
    path: str | os.PathLike[str],
    *,
    on_warning: Callable[[str], None] | None = None,
    classes: Collection[int] | None = None,
    returns: str | Collection[int] | None = None,
    min_opacity: float | None = None,
    max_axis: float | None = None,
) -> Cloud:
    """Read a point cloud from a file and drop points with NaN or Inf coordinates.

    Args:
        path: file with a known extension (upper or lower case), or folder with a COLMAP model.
        on_warning: callback, called with one line per warning ("a.ply: dropped 12 of 1000 points with NaN or Inf
            coordinates"). Defaults to `warnings.warn`.
        classes: class numbers to keep, such as (2, 6). LAS, LAZ and COPC only.
        returns: returns to keep: "first", "last", or return numbers. LAS, LAZ and COPC only.
        min_opacity: minimum opacity (0 to 1) of the Gaussian splats to keep. PLY files of splats only; stored logits of
            opacity and logarithms of the axes are converted.
        max_axis: maximum length of the largest axis (standard deviation) of the splats to keep, in the file's unit.

    Raises:
        InputError: the file cannot be read, does not match its extension, or no point passes the filters. The message
            starts with the path.
        MissingExtra: an optional library is needed for this file.
    """

    def read(path: Path, warn: Warn) -> Cloud:
        form = _format(path)
        filters = {"classes": classes, "returns": returns} if classes is not None or returns is not None else {}
        if filters and not form.filtered:
            raise InputError(
                f"expected {', '.join(FILTERABLE_EXTENSIONS)} to filter by classes or returns, got another format"
            )
        cloud = finite_cloud(form.read(path, warn, **filters), warn)
        _warn_of_null_points(cloud.points, warn)
        return filter_splats(cloud, min_opacity, max_axis)

    return read_named(model_file(as_path(path)), read, on_warning)


def _warn_of_null_points(points: FloatArray, warn: Warn) -> None:
    x, y, z = points.T
    count = int(np.count_nonzero((x == 0) & (y == 0) & (z == 0)))
    if count >= max(_MIN_NULL_POINTS, _MIN_NULL_SHARE * len(points)):
        warn(
            f"{count:,} of {len(points):,} points are exactly (0, 0, 0), as some scanners write missing returns: remove"
            " them, or they count as points"
        )


def is_path(value: object) -> TypeGuard[str | os.PathLike[str]]:
    """Return whether an argument is the path of a cloud rather than a cloud or an array."""
    return isinstance(value, str | os.PathLike)


def to_cloud(value: CloudLike) -> Cloud:
    """Return a cloud unchanged, wrap an (N, 3) array, or read the file at a path.

    Raises:
        InputError, MissingExtra: see `read_cloud` and `Cloud`.
    """
    return read_cloud(value) if isinstance(value, str | os.PathLike) else as_cloud(value)


def write_cloud(path: str | os.PathLike[str], cloud: CloudLike) -> None:
    """Write a cloud to a file. If an error occurs, an existing file stays unchanged.

    Args:
        path: output file; its extension selects the format.
        cloud: cloud, points (N, 3), or path of a file with a cloud.

    Raises:
        InputError: the extension is unknown, the format cannot store the cloud, or an argument is not a path or cloud.
        OSError: the file cannot be written.
    """
    path = as_path(path)
    write = _writer(path)
    write(path, to_cloud(cloud))


def check_cloud_output(path: Path, inputs: Sequence[Path] = (), others: Sequence[Path] = ()) -> None:
    """Check before a long computation that a cloud can be written to a path.

    Args:
        path: output file.
        inputs: input files and folders, which must not be replaced; see `check_output`.
        others: other outputs, which must differ from this one.

    Raises:
        InputError: the extension is unknown or read-only, the folder does not exist, or an input or another result
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
            raise InputError(f"{path.suffix} files can only be read: write one of {', '.join(writable)}")
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    return write


def _format(path: Path, formats: Mapping[str, CloudFormat] = CLOUDS) -> CloudFormat:
    form = formats.get(path.name) or formats.get(path.suffix.lower())
    if form is None:
        known = ", ".join(extension for extension in formats if extension.startswith("."))
        got = path.suffix.lower() or "none"
        raise InputError(f"expected a file with extension {known}; got {got}: rename or convert the file")
    return form
