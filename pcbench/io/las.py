"""Read and write LAS, LAZ and COPC. Only the compressed points need a library: lazrs, in a child process.

Coordinates are the stored integers times scale plus offset, in float64; nothing else is applied.
"""

from __future__ import annotations

from collections.abc import Collection
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pcbench.errors import InputError
from pcbench.geometry.cloud import Cloud, Storage
from pcbench.io import laz
from pcbench.io.color_depth import brightest
from pcbench.io.columns import plain_type
from pcbench.io.files import Fields, Warn
from pcbench.io.las_checks import count_records, warn_of_rest
from pcbench.io.las_crs import WKT, read_crs, to_wkt
from pcbench.io.las_grid import choose_grid
from pcbench.io.las_header import (
    EXTRA_LAYOUT,
    EXTRA_TYPES,
    HEADER,
    HEADER_1_4,
    POINT_FORMATS,
    VLR,
    ExtraDimension,
    LasHeader,
    read_extras,
    read_header,
)
from pcbench.io.las_records import (
    AXES,
    LasFilters,
    classes_of,
    coordinates,
    extra_columns,
    no_match_error,
    parse_filters,
    read_compressed_records,
    read_records,
    returns_of,
)
from pcbench.io.names import COLORS, XYZ, left_out_warning, standard_names, stored_attributes, take_normals
from pcbench.scratch import atomic_write

# Standard dimensions that become attributes, with the types in which they are written.
_STANDARD_TYPES: dict[str, np.dtype[Any]] = {
    "intensity": np.dtype("u2"),
    "classification": np.dtype("u1"),
    "return_number": np.dtype("u1"),
    "number_of_returns": np.dtype("u1"),
    "gps_time": np.dtype("f8"),
    "point_source_id": np.dtype("u2"),
}
_STANDARD_TIME, _HAS_WKT = 1, 16  # bits of the global encoding
_SECONDS_PER_WEEK = 604_800
_EXTRA_NORMALS = ("NormalX", "NormalY", "NormalZ")
# Names that LAS readers use for dimensions of points; extra bytes must not have them.
_RESERVED_NAMES = {name.lower() for form in POINT_FORMATS for name, _ in form} | {
    *("scan_angle_rank", "synthetic", "key_point", "withheld", "overlap", "scanner_channel"),
    *("scan_direction_flag", "edge_of_flight_line", "raw_classification", "bit_fields", "classification_flags"),
}


def read_las(
    path: Path,
    warn: Warn,
    classes: Collection[int] | None = None,
    returns: str | Collection[int] | None = None,
    allow_empty: bool = False,
) -> Fields:
    """Read the points of a LAS, LAZ or COPC file (all levels), optionally only some classes or returns.

    Attributes are intensity, classification, return_number, number_of_returns, gps_time and point_source_id, if the
    point format has them, and the extra bytes. Extra bytes are scaled if the file declares a scale; values marked as no
    data become NaN. Extra bytes with the names of normals (see `names`) become the normals. Colours are as stored.
    Warnings report points outside the header's bounds, and counts of returns that differ from the header's.

    Args:
        path: input file.
        warn: callback for warnings.
        classes: class numbers to keep, such as (2, 6) for ground and buildings.
        returns: returns to keep: "first", "last", or return numbers, such as (1, 2) or "1,2".
        allow_empty: whether the file may have no points, or none with these classes and returns.

    Raises:
        InputError: the file is damaged, or no point has these classes and returns.
        MissingExtra: the file is compressed, and lazrs is not installed.
        OSError: the file cannot be read.
    """
    filters = parse_filters(classes, returns)
    with path.open("rb") as file:
        header = read_header(file, warn, allow_empty)
    extras = read_extras(header, warn)
    records = read_all_records(path, header, extras, warn)
    fields = las_fields(filter_records(records, header, filters, allow_empty), header, extras, warn)
    return fields | brightest_of(records)


def read_all_records(path: Path, header: LasHeader, extras: list[ExtraDimension], warn: Warn) -> NDArray[Any]:
    """Read all point records of a LAS, LAZ or COPC file, and compare them with the header.

    Raises:
        InputError: the points are damaged or incomplete.
        MissingExtra: the file is compressed, and lazrs is not installed.
    """
    if header.compressed:
        records = read_compressed_records(path, header, extras)
    else:
        records = read_records(path, header, extras)
        warn_of_rest(header, warn)
    for line in count_records(records, header).warnings(header):
        warn(line)
    return records


def filter_records(records: NDArray[Any], header: LasHeader, filters: LasFilters, allow_empty: bool) -> NDArray[Any]:
    """Return the records that pass the filters.

    Raises:
        InputError: there are none, unless this is allowed.
    """
    if filters == LasFilters():
        return records
    classes, returns = classes_of(records, header), returns_of(records, header)
    keep = filters.keep(classes, *returns)
    if not allow_empty and not keep.any():
        raise no_match_error(filters, classes, returns[0])
    return records[keep]


def brightest_of(records: NDArray[Any]) -> Fields:
    """Return the field `brightest` of point records before filters, if they have colours."""
    if "red" not in (records.dtype.names or ()):
        return Fields()
    return Fields(brightest=max(brightest(records[name]) for name in COLORS))


def las_fields(records: NDArray[Any], header: LasHeader, extras: list[ExtraDimension], warn: Warn) -> Fields:
    """Return the fields of a cloud from its point records, with 16-bit colours."""
    attributes: dict[str, NDArray[Any]] = {"intensity": records["intensity"].copy()}
    attributes["classification"] = classes_of(records, header).copy()
    attributes["return_number"], attributes["number_of_returns"] = returns_of(records, header)
    names = records.dtype.names or ()
    if "gps_time" in names:
        attributes["gps_time"] = records["gps_time"].copy()
    attributes["point_source_id"] = records["point_source_id"].copy()

    for name, column in extra_columns(records, extras):
        if name in attributes or not name.isprintable():
            warn(f"left out the extra bytes {name[:40]!r}: the name is already used or not printable")
        else:
            attributes[name] = column
    attribute_names = standard_names(list(attributes), taken=(*XYZ, *COLORS))
    attributes = dict(zip(attribute_names, attributes.values(), strict=True))
    normals = take_normals(attributes)
    crs, unit = read_crs(header.records, warn)
    return Fields(
        points=coordinates(records, header),
        normals=normals,
        colors=np.stack([records[name] for name in COLORS], axis=1) if "red" in names else None,
        attributes=attributes,
        crs=crs,
        unit=unit,
        stored=Storage(header.scales, header.offsets),
    )


# ---- writer -------------------------------------------------------------------------------------------------------


def write_las(path: Path, cloud: Cloud, warn: Warn) -> None:
    """Write LAS 1.4, compressed if the name ends in .laz.

    Coordinates are rounded to a step per axis, see `pcbench.io.las_grid.choose_grid`. Attributes with the names of
    standard dimensions are written there if their values fit, others and the normals (as float) as extra bytes. The crs
    becomes a WKT record, if pyproj knows it. LAS cannot store the unit without a crs.

    Args:
        path: output file.
        cloud: cloud to write.
        warn: callback for a line on what LAS cannot store.

    Raises:
        InputError: 32 bits cannot store the coordinates, or an attribute does not consist of numbers.
        MissingExtra: lazrs (for .laz) or pyproj (for a crs) is not installed.
        OSError: the file cannot be written; an existing file is then unchanged.
    """
    compressed = path.suffix.lower() == ".laz"
    if path.name.lower().endswith(".copc.laz"):
        raise InputError("COPC files can only be read: write a plain .laz or .las file")
    steps, offsets, integers = choose_grid(cloud, warn)
    standard, extras = _assign_attributes(cloud, warn)
    point_format = 6 if cloud.colors is None else 7
    layout = np.dtype(
        POINT_FORMATS[point_format] + [(f"extra {k}", a.dtype.str) for k, a in enumerate(extras.values())]
    )
    records = np.zeros(len(cloud), dtype=layout)
    for axis, column in zip(AXES, integers.T, strict=True):
        records[axis] = column
    for name in ("intensity", "classification", "gps_time", "point_source_id"):
        if name in standard:
            records[name] = standard[name]
    return_number = standard.get("return_number", np.ones(len(cloud), np.uint8))
    return_count = standard.get("number_of_returns", np.maximum(return_number, 1))
    records["returns"] = return_number | return_count << 4
    if cloud.colors is not None:
        for name, column in zip(COLORS, cloud.colors.T, strict=True):
            records[name] = column * np.uint16(257)  # 255 becomes 65535
    for k, column in enumerate(extras.values()):
        records[f"extra {k}"] = column

    extra_bytes = layout.itemsize - np.dtype(POINT_FORMATS[point_format]).itemsize
    vlrs = {}
    if cloud.crs:
        with suppress(InputError):
            vlrs[WKT] = to_wkt(cloud.crs)
    lost = {"the unit": None if WKT in vlrs else cloud.unit, "the crs": None if WKT in vlrs else cloud.crs}
    if line := left_out_warning("LAS without a known crs", lost):
        warn(line)
    if extras:
        vlrs["LASF_Spec", 4] = b"".join(_describe_extra(name, column) for name, column in extras.items())
    if compressed:
        vlrs[laz.LASZIP] = laz.laszip_record(point_format, extra_bytes)
    if any(len(data) > 0xFFFF for data in vlrs.values()) or layout.itemsize > 0xFFFF:
        raise InputError(f"LAS cannot store {len(extras)} attributes and a crs of this size: write a .ply")
    block = b"".join(
        VLR.pack(0, user.encode(), record_id, len(data), b"") + data for (user, record_id), data in vlrs.items()
    )
    corners = (
        np.stack([integers.max(axis=0), integers.min(axis=0)], axis=1) * np.array(steps)[:, None]
        + np.array(offsets)[:, None]
    )
    by_return = np.bincount(return_number, minlength=16)[1:16].tolist()
    head = HEADER.pack(
        b"LASF", 0, _global_encoding(records["gps_time"], WKT in vlrs), b"", 1, 4, b"pcbench", b"pcbench", 0, 0,
        HEADER.size + HEADER_1_4.size, HEADER.size + HEADER_1_4.size + len(block), len(vlrs),
        point_format | (128 if compressed else 0), layout.itemsize, 0, 0, 0, 0, 0, 0,
        *steps, *offsets, *corners.reshape(-1).tolist(),
    ) + HEADER_1_4.pack(0, 0, 0, len(cloud), *by_return)  # fmt: skip
    points = records.view(np.uint8).data
    if compressed:
        points = laz.compress(points, vlrs[laz.LASZIP], len(head + block))
    with atomic_write(path) as file:
        file.write(head + block)
        file.write(points)


def _global_encoding(times: NDArray[Any], has_wkt: bool) -> int:
    """Return the bits of the header that say what GPS times (N,) are, and that the system is given as WKT.

    Times within a week may be seconds of the week; others can only be adjusted standard GPS time.
    """
    is_week = bool((np.nan_to_num(times) >= 0).all() and (np.nan_to_num(times) <= _SECONDS_PER_WEEK).all())
    return (0 if is_week else _STANDARD_TIME) | (_HAS_WKT if has_wkt else 0)


def _assign_attributes(cloud: Cloud, warn: Warn) -> tuple[dict[str, NDArray[Any]], dict[str, NDArray[Any]]]:
    """Split attributes into standard dimensions and extra bytes, both in the types to write."""
    standard = {
        name: values.astype(_STANDARD_TYPES[name])
        for name, values in cloud.attributes.items()
        if name in _STANDARD_TYPES and _fits(name, values)
    }
    extras: dict[str, NDArray[Any]] = {}
    if cloud.normals is not None:
        extras |= {name: cloud.normals[:, k].astype("<f4") for k, name in enumerate(_EXTRA_NORMALS)}
    others = stored_attributes(
        {name: values for name, values in cloud.attributes.items() if name not in standard},
        "LAS",
        warn,
        reserved=_RESERVED_NAMES | _STANDARD_TYPES.keys() | {name.lower() for name in extras},
        forbidden=r"[^\w !-~]",
        most_bytes=32,
    )
    return standard, extras | {name: plain_type(values) for name, values in others.items()}


def _fits(name: str, values: NDArray[Any]) -> bool:
    """Return whether the standard dimension of this name holds the values exactly."""
    if values.dtype.kind not in "biuf":
        return False
    with np.errstate(invalid="ignore", over="ignore"):
        stored = values.astype(_STANDARD_TYPES[name])
    return np.array_equal(stored, values, equal_nan=True) and not ("return" in name and (stored > 15).any())


def _describe_extra(name: str, column: NDArray[Any]) -> bytes:
    kind = EXTRA_TYPES.index(column.dtype.str.lstrip("|")) + 1
    return EXTRA_LAYOUT.pack(b"", kind, 0, name.encode(), b"", b"", b"", b"", *[0.0] * 6, b"")
