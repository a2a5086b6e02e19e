"""Read the points of COLMAP sparse models: points3D.bin and points3D.txt. Formats: colmap.github.io/format.html."""

from __future__ import annotations

import os
import struct
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pcbench.errors import InputError
from pcbench.geometry.cloud import Cloud
from pcbench.io.colmap_folders import POINT_FILES, find_model, points_file
from pcbench.io.colmap_text import check_complete, data_lines, excerpt
from pcbench.io.files import (
    MAX_PADDING,
    Fields,
    Warn,
    check_end,
    check_readable,
    errors_named,
    finite_cloud,
    report_warnings,
)

# One point, without its track of (int32 image, int32 keypoint) entries.
_POINT = np.dtype(
    [("id", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("track_length", "<u8")], align=False
)
_TRACK_LENGTH_OFFSET = _POINT.itemsize - 8  # in bytes from the start of a point
_TRACK_ENTRY_BYTES = 8


def read_points3d(folder_or_file: str | os.PathLike[str], on_warning: Warn | None = None) -> Cloud:
    """Read the points of a COLMAP sparse model, as `read_cloud` does.

    Coordinates are in the model's arbitrary frame. Attributes: `point3D_id`; `reprojection_error`, the mean in
    pixels; `track_length`, the number of images that observe the point.

    Args:
        folder_or_file: points3D.bin, points3D.txt, or a folder with a model, see `find_model`.
        on_warning: callback, called with one line per warning. Defaults to `warnings.warn`.

    Raises:
        InputError: there is no model, or it is damaged. The message starts with the path.
    """
    lines: list[str] = []
    file = model_file(Path(folder_or_file), lambda note: lines.append(f"{folder_or_file}: {note}"))
    if file.name not in POINT_FILES:
        raise InputError(f"{folder_or_file}: expected a COLMAP model: a folder with {' or '.join(POINT_FILES)}")

    def warn(line: str) -> None:
        lines.append(f"{file}: {line}")

    with errors_named(file):
        check_readable(file)
        cloud = finite_cloud(read_colmap(file, warn), warn)
    report_warnings(lines, on_warning)
    return cloud


def model_file(path: Path, warn: Warn | None = None) -> Path:
    """Return the points file of the COLMAP model in a folder; return any other path unchanged, for its reader.

    Args:
        path: any path of a cloud.
        warn: callback, called with one line, without the path, that names all of several models.
    """
    try:
        folder = find_model(path, "points", warn) if path.is_dir() else None
    except OSError:  # no permission to list the folder
        folder = None
    return path if folder is None else points_file(folder) or path


def read_colmap(path: Path, warn: Warn) -> Fields:
    """Read the fields of a points3D file, see `read_points3d`.

    Raises:
        InputError: the file is incomplete or contains no points.
        OSError: the file cannot be read.
    """
    read = _read_binary if path.suffix.lower() == ".bin" else _read_text
    fields = read(path.read_bytes(), warn)
    if fields is None:
        raise InputError(f"expected at least one point, got a model with cameras alone: {_where_points_are(path)}")
    return fields


def _where_points_are(path: Path) -> str:
    """Return what to do with a model without points; scenes of `pcbench synth` have their cloud in truth/."""
    clouds = [folder / "truth" / "cloud.ply" for folder in path.parents[:3]]
    cloud = next(filter(Path.is_file, clouds), None)
    return "export it with its points" if cloud is None else f"name a cloud, such as {cloud}"


def _read_binary(data: bytes, warn: Warn) -> Fields | None:
    if len(data) < 8:
        raise InputError(f"expected a point count of 8 bytes, got {len(data)} bytes: copy or export the model again")
    (count,) = struct.unpack_from("<Q", data)
    # Tracks differ in length: each point determines where the next one starts.
    unpack = struct.Struct("<Q").unpack_from
    offsets: list[int] = []
    offset, size = 8, len(data)
    for _ in range(min(count, size // _POINT.itemsize)):
        end = offset + _POINT.itemsize
        if end > size or (end := end + _TRACK_ENTRY_BYTES * unpack(data, offset + _TRACK_LENGTH_OFFSET)[0]) > size:
            break
        offsets.append(offset)
        offset = end
    if len(offsets) < count:
        raise InputError(f"truncated: got {len(offsets)} of {count} points: copy or export the model again")
    check_end(data[offset:][:MAX_PADDING], size - offset, _POINT.itemsize, f"{count} points", warn)
    if not count:
        return None
    windows = np.lib.stride_tricks.sliding_window_view(np.frombuffer(data, np.uint8), _POINT.itemsize)
    rows = windows[offsets].view(_POINT)[:, 0]
    return _fields(rows["xyz"], rows["rgb"], rows["id"], rows["error"], rows["track_length"])


def _read_text(data: bytes, warn: Warn) -> Fields | None:
    """Parse lines of id, x y z, r g b, error, then (image, keypoint) pairs. Lines that start with # are comments."""
    ids: list[int] = []
    values: list[list[float]] = []
    for number, line in data_lines(data):
        if not line:
            continue
        words = line.split()
        try:
            if len(words) < 8 or len(words) % 2 or b"_" in line:
                raise ValueError
            row = [float(word) for word in words[1:8]]
            if not 0 <= int(words[0]) < 2**64 or not all(0 <= c <= 255 and c == int(c) for c in row[3:6]):
                raise ValueError
        except (ValueError, OverflowError):
            raise InputError(
                f"line {number}: expected id, x y z, r g b, error, then (image, keypoint) pairs; got {excerpt(line)}:"
                " copy or export the model again"
            ) from None
        ids.append(int(words[0]))
        values.append([*row, (len(words) - 8) / 2])
    if not values:
        return None
    check_complete(data, "points", len(values), warn)
    table = np.array(values)
    return _fields(table[:, :3], table[:, 3:6].astype(np.uint8), np.array(ids, np.uint64), table[:, 6], table[:, 7])


def _fields(xyz: NDArray[np.float64], rgb: NDArray[np.uint8], ids: NDArray[np.uint64], error: NDArray[np.float64],
            track_length: NDArray[np.generic]) -> Fields:  # fmt: skip
    return Fields(
        points=np.ascontiguousarray(xyz, dtype=np.float64),
        colors=np.ascontiguousarray(rgb),
        attributes={
            "point3D_id": ids.astype(np.uint64),
            "reprojection_error": error.astype(np.float64),
            "track_length": track_length.astype(np.int64),
        },
    )
