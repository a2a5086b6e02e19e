"""Read and write point clouds. The file extension selects the format (see `formats.CLOUDS`).

To add a format, write a module with its reader next to the others and add a line to `formats`.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Sequence
from pathlib import Path
from typing import TypeGuard

from numpy.typing import ArrayLike

from pcbench.errors import InputError
from pcbench.geometry.cloud import Cloud, as_cloud
from pcbench.io.files import Warn, as_path, errors_named, report_warnings
from pcbench.io.formats import CLOUDS, FILTERABLE_EXTENSIONS, format_of
from pcbench.io.las_records import parse_filters
from pcbench.io.outputs import check_output
from pcbench.io.source import Source

__all__ = [
    "FILTERABLE_EXTENSIONS",
    "CloudLike",
    "check_cloud_output",
    "is_path",
    "read_cloud",
    "to_cloud",
    "write_cloud",
]

CloudLike = Cloud | ArrayLike | os.PathLike[str]  # accepted by `to_cloud`; `ArrayLike` includes str, so paths too


def read_cloud(
    path: str | os.PathLike[str],
    *,
    on_warning: Callable[[str], None] | None = None,
    classes: Collection[int] | None = None,
    returns: str | Collection[int] | None = None,
    min_opacity: float | None = None,
    max_axis: float | None = None,
    color_depth: int | None = None,
    drop_nodata: bool = False,
) -> Cloud:
    """Read a point cloud from one or many files and drop points with NaN or Inf coordinates.

    Many files are read one after the other, in the natural order of their names (tile_2 before tile_10). Normals,
    colours and attributes are kept if all files have them.

    Args:
        path: file with a known extension (upper or lower case), folder of such files, pattern such as `tiles/*.laz`,
            `.vpc` index, folder or ept.json of Entwine Point Tiles, or folder with a COLMAP model.
        on_warning: callback, called with one line per warning ("a.ply: dropped 12 of 1000 points with NaN or Inf
            coordinates"). Defaults to `warnings.warn`.
        classes: class numbers to keep, such as (2, 6). LAS, LAZ, COPC and EPT only.
        returns: returns to keep: "first", "last", or return numbers. LAS, LAZ, COPC and EPT only.
        min_opacity: minimum opacity (0 to 1) of the Gaussian splats to keep. Files of splats only; stored logits of
            opacity and logarithms of the axes are converted.
        max_axis: maximum length of the largest axis (standard deviation) of the splats to keep, in the file's unit.
        color_depth: significant bits of the colours in LAS, LAZ, COPC and EPT files, 8 or 16. None: 16 if a value of
            the cloud exceeds 255, also of points that are filtered out, else 8.
        drop_nodata: whether points that stand for missing data, such as z = -9999, are removed, with a warning that
            gives their number. Otherwise they are kept, with a warning.

    Raises:
        InputError: a file cannot be read or does not match its extension, files have different coordinate reference
            systems or units, or no point passes the filters. The message names the file.
        MissingExtra: an optional library is needed for this file.
    """
    path, lines = as_path(path), list[str]()
    with errors_named(path):
        filters = parse_filters(classes, returns)
    cloud = Source.open(path, filters).read_cloud(
        lines.append, min_opacity=min_opacity, max_axis=max_axis, color_depth=color_depth, drop_nodata=drop_nodata
    )
    report_warnings(lines, on_warning)
    return cloud


def is_path(value: object) -> TypeGuard[str | os.PathLike[str]]:
    """Return whether an argument is the path of a cloud rather than a cloud or an array."""
    return isinstance(value, str | os.PathLike)


def to_cloud(value: CloudLike) -> Cloud:
    """Return a cloud unchanged, wrap an (N, 3) array, or read the file at a path.

    Raises:
        InputError, MissingExtra: see `read_cloud` and `Cloud`.
    """
    return read_cloud(value) if isinstance(value, str | os.PathLike) else as_cloud(value)


def write_cloud(
    path: str | os.PathLike[str], cloud: CloudLike, *, on_warning: Callable[[str], None] | None = None
) -> None:
    """Write a cloud to a file. If an error occurs, an existing file stays unchanged.

    Args:
        path: output file; its extension selects the format.
        cloud: cloud, points (N, 3), or path of a file with a cloud.
        on_warning: callback, called with one line on what the format cannot store. Defaults to `warnings.warn`.

    Raises:
        InputError: the extension is unknown, the format cannot store the points, or an argument is not a path or cloud.
        OSError: the file cannot be written.
    """
    path = as_path(path)
    lines: list[str] = []
    write = _writer(path)
    cloud = to_cloud(cloud)
    try:
        write(path, cloud, lines.append)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    report_warnings([f"{path}: {line}" for line in lines], on_warning)


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


def _writer(path: Path) -> Callable[[Path, Cloud, Warn], None]:
    try:
        writable = {extension: form for extension, form in CLOUDS.items() if form.write}
        is_known = path.name in CLOUDS or path.suffix.lower() in CLOUDS
        write = format_of(path, CLOUDS if is_known else writable).write
        if write is None:
            raise InputError(f"{path.suffix} files can only be read: write one of {', '.join(writable)}")
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    return write
