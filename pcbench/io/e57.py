"""Read E57 files (ASTM E2807), the export format of laser scanners, with pye57 in a child process."""

from __future__ import annotations

import errno
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcbench.children import Limits, run_script
from pcbench.errors import InputError, MissingExtra
from pcbench.extras import require
from pcbench.io.files import Fields, Warn
from pcbench.io.names import COLORS, NORMALS, XYZ, Columns, scale_colors, standard_names, take_fields
from pcbench.regular_files import read_json
from pcbench.scratch import scratch_folder

_WORKER = str(Path(__file__).with_name("e57_worker.py"))
_MAX_MEMORY = 2 << 30  # bytes of address space for numpy and libE57Format; points are written block by block
_MIN_SPEED = 1e6  # bytes per second; libE57Format reads tens of millions


def read_e57(path: Path, warn: Warn) -> Fields:
    """Read all scans of an E57 file into one frame with their poses, in metres.

    Points that the file marks as invalid are dropped. Colours are scaled by the limits that a scan states, or else by
    `names.scale_colors`. If there are several scans, the attribute `scan` is the index of
    each point's scan, from 0. Intensity, times and all other fields that every scan has are attributes too; fields that
    some scans lack are left out.

    Raises:
        InputError: the file is damaged or contains no valid point.
        MissingExtra: pye57 is not installed or does not load.
        OSError: the file cannot be read.
    """
    with _worker_output(path, "all") as (folder, described):
        return _fields(folder, list(enumerate(described["scans"])), described["crs"], warn)


class E57Scan(NamedTuple):
    """Number of points of a scan, including points that the file marks as invalid, and whether they have normals."""

    points: int
    has_normals: bool


class E57Header(NamedTuple):
    """All scans of a file, and its coordinate reference system."""

    scans: tuple[E57Scan, ...]
    crs: str | None


def read_e57_header(path: Path) -> E57Header:
    """Describe the scans of a file without reading points; raises the same errors as `read_e57`."""
    with _worker_output(path, "headers") as (_, described):
        scans = (
            E57Scan(scan["points"], set(NORMALS) <= set(standard_names(scan["fields"], taken=XYZ)))
            for scan in described["scans"]
        )
        return E57Header(tuple(scans), described["crs"].strip() or None)


def read_e57_scan(path: Path, number: int, warn: Warn) -> Fields:
    """Read one scan as `read_e57` does; it may have no valid points. Raises the same errors."""
    with _worker_output(path, str(number)) as (folder, described):
        return _fields(folder, [(number, described["scans"][0])], described["crs"], warn, allow_empty=True)


def no_points_error(scans: int) -> InputError:
    """Return the error of a file whose scans have no valid points."""
    return InputError(f"expected at least one valid point, got none (scans: {scans}): export it again")


@contextmanager
def _worker_output(path: Path, wanted: str) -> Iterator[tuple[Path, dict[str, Any]]]:
    """Run the worker, and provide its folder and the content of `scans.json`."""
    require("pye57")
    with path.open("rb") as file:
        if file.read(8) != b"ASTM-E57":
            raise InputError(
                "expected an E57 file that starts with ASTM-E57, got something else: export it again as E57"
            )
    with scratch_folder() as folder:
        limits = Limits(seconds=30 + path.stat().st_size / _MIN_SPEED, memory=_MAX_MEMORY)
        done = run_script(
            _WORKER, str(path.resolve()), str(folder), wanted, limits=limits, environment={"OPENBLAS_NUM_THREADS": "1"}
        )
        if done.code == 3:
            raise MissingExtra("pye57", "e57", "it is installed but does not load")
        if done.code == 4:
            raise OSError(errno.ENOSPC, "no space left for temporary files", str(folder))
        if done.timed_out:
            raise InputError(f"damaged E57 data: not read within {limits.seconds:.0f} s: export the file again")
        if done.code:
            reason = "".join(c if c.isprintable() else " " for c in done.last_error_line)[:200]
            raise InputError(f"damaged E57 data: {reason or 'the reader crashed'}: export the file again")
        yield folder, read_json(folder / "scans.json")


def _fields(
    folder: Path, described: list[tuple[int, dict[str, Any]]], crs: str, warn: Warn, allow_empty: bool = False
) -> Fields:
    """Concatenate the scans that the worker wrote, given with their index."""
    scans = [(k, scan) for k, scan in described if scan["points"]]
    if dropped := sum(scan["dropped"] for _, scan in described):
        warn(
            f"dropped {dropped} of {dropped + sum(s['points'] for _, s in scans)} points that the file marks as invalid"
        )
    if not scans and allow_empty:
        return Fields(points=np.empty((0, 3)))
    if not scans:
        raise no_points_error(len(described))
    if empty := len(described) - len(scans):
        warn(f"{empty} of {len(described)} scans have no valid point with coordinates")
    everywhere = [name for name in scans[0][1]["fields"] if all(name in scan["fields"] for _, scan in scans)]
    if partial := sorted({name for _, scan in scans for name in scan["fields"]} - set(everywhere)):
        warn(f"left out fields that only some of {len(scans)} scans have: {', '.join(partial)}")

    def column(name: str) -> NDArray[np.float64]:
        return np.concatenate([np.fromfile(folder / f"{k}.{name}", np.float64) for k, _ in scans])

    names = standard_names(everywhere, taken=XYZ)
    columns: Columns = {name: column(field) for name, field in zip(names, everywhere, strict=True)}
    if columns.keys() >= set(COLORS):
        _scale_colors(columns, [scan for _, scan in scans])
    normals, colors, attributes = take_fields(columns, warn)
    if len(scans) > 1:
        attributes["scan"] = np.repeat([k for k, _ in scans], [scan["points"] for _, scan in scans]).astype(np.int32)
    return Fields(
        points=column("points").reshape(-1, 3),
        normals=normals,
        colors=colors,
        attributes=attributes,
        crs=crs.strip() or None,
        unit="m",
    )


def _scale_colors(columns: Columns, scans: Sequence[dict[str, Any]]) -> None:
    """Turn the colours of scans that state no limits into 8-bit ones by their values, as of other formats, in place.

    If those of a scan fit no scale, all stay as they are.
    """
    types = np.repeat([scan["color_type"] for scan in scans], [scan["points"] for scan in scans])
    scaled = {name: columns[name].copy() for name in COLORS}
    for kind in set(types) - {"u1"}:
        chosen = types == kind
        colors = scale_colors([columns[name][chosen].astype(kind) for name in COLORS])
        if colors is None:
            return
        for name, channel in zip(COLORS, colors.T, strict=True):
            scaled[name][chosen] = channel
    columns |= {name: channel.astype(np.uint8) for name, channel in scaled.items()}
