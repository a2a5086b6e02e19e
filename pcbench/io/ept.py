"""Read Entwine Point Tiles (EPT): ept.json, a hierarchy of octree nodes, and one file of points per node.

Nodes are LAZ or binary files. The order of the points is that of the node keys: depth, x, y, z.
Specification: https://entwine.io/en/latest/entwine-point-tile.html, version 1.0.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcbench.errors import InputError
from pcbench.geometry.cloud import Storage
from pcbench.io.files import Fields, Warn, errors_named
from pcbench.io.las import brightest_of, filter_records, las_fields
from pcbench.io.las_checks import LasCounts, count_records
from pcbench.io.las_crs import WKT, read_crs
from pcbench.io.las_header import EXTRA_BYTES, LasHeader, read_extras, read_header
from pcbench.io.las_records import LasFilters, has_normals, no_match_error, parse_filters, record_type
from pcbench.io.laz import LazRun, decompress, read_chunks
from pcbench.io.names import COLORS, NORMALS, XYZ, standard_names
from pcbench.regular_files import read_json

_EXTENSIONS = {"laszip": "laz", "binary": "bin"}
_KINDS = {"signed": "i", "unsigned": "u", "float": "f", "floating": "f"}  # PDAL says floating
_MAX_DEPTH = 30  # 2^30 nodes per axis
_XYZ, _COLORS, _NORMALS = ("X", "Y", "Z"), ("Red", "Green", "Blue"), ("NormalX", "NormalY", "NormalZ")
# Dimensions that the reader of LAS leaves out too.
_LEFT_OUT = {
    *("ScanDirectionFlag", "EdgeOfFlightLine", "ScanAngleRank", "ScanAngle", "UserData", "ScanChannel"),
    *("ClassFlags", "ClassificationFlags", "Synthetic", "KeyPoint", "Withheld", "Overlap"),
}


class EptNode(NamedTuple):
    """Octree node: its key, and its number of points."""

    depth: int
    x: int
    y: int
    z: int
    points: int

    @property
    def name(self) -> str:
        """Name of its file without the extension."""
        return f"{self.depth}-{self.x}-{self.y}-{self.z}"


@dataclass(frozen=True)
class EptIndex:
    """Content of an ept.json.

    Attributes:
        folder: folder that contains it.
        data_type: "laszip" or "binary".
        points: number of points.
        bounds: minimum x, y, z and maximum x, y, z of the points.
        crs: coordinate reference system, or None.
        unit: unit of the coordinates, or None.
        names: names of the dimensions, in the order of a binary record.
        dtype: type of a binary record; dimensions are named by index.
        scales: scale of each dimension.
        offsets: offset of each dimension.
    """

    folder: Path
    data_type: str
    points: int
    bounds: tuple[float, ...]
    crs: str | None
    unit: str | None
    names: tuple[str, ...]
    dtype: np.dtype[Any]
    scales: tuple[float, ...]
    offsets: tuple[float, ...]

    def node_path(self, node: EptNode) -> Path:
        """Return the file of a node."""
        return self.folder / "ept-data" / f"{node.name}.{_EXTENSIONS[self.data_type]}"


def read_ept(
    path: Path,
    warn: Warn,
    classes: Collection[int] | None = None,
    returns: str | Collection[int] | None = None,
    allow_empty: bool = False,
) -> Fields:
    """Read all nodes of an EPT data set, given its ept.json; the arguments and attributes are those of `read_las`.

    Raises:
        InputError: a file of the data set is missing or damaged, the points are compressed with Zstandard, or no point
            has these classes and returns.
        MissingExtra: the nodes are LAZ, and lazrs is not installed.
        OSError: ept.json cannot be read.
    """
    filters = parse_filters(classes, returns)
    index = read_index(path, warn)
    fields, counts = read_nodes(index, read_hierarchy(index), filters, warn, allow_empty)
    for line in counts.warnings() if counts is not None else ():
        warn(line)
    return fields


def read_index(path: Path, warn: Warn) -> EptIndex:
    """Read ept.json.

    Raises:
        InputError: it is damaged, or describes points in a format that is not supported.
    """
    content = read_json(path)
    try:
        data_type, hierarchy = content["dataType"], content.get("hierarchyType", "json")
        count = content["points"]
        bounds = tuple(map(float, content.get("boundsConforming") or content["bounds"]))
        dimensions = [_dimension(entry) for entry in content["schema"]]
        srs = content.get("srs") or {}
        wkt = srs.get("wkt") or ""
        code = f"{srs['authority']}:{srs['horizontal']}" if srs.get("authority") and srs.get("horizontal") else ""
        code += f"+{srs['vertical']}" if code and srs.get("vertical") else ""
        names = tuple(name for name, *_ in dimensions)
        scales, offsets = tuple(scale for *_, scale, _ in dimensions), tuple(offset for *_, offset in dimensions)
        system = str(wkt or code)
    except InputError:  # also a ValueError, but its message is complete
        raise
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise InputError(
            "expected an ept.json with dataType, points, bounds and schema, got something else: copy the folder again"
        ) from error
    if data_type not in _EXTENSIONS or hierarchy != "json":
        got = data_type if data_type not in _EXTENSIONS else f"{hierarchy} hierarchy"
        raise InputError(
            f"expected EPT data of type laszip or binary, got {str(got)[:40]!r}, which is not supported: write it again"
            " as laszip"
        )
    if not isinstance(count, int) or not 0 < count < 1 << 62 or len(bounds) != 6:
        raise InputError(
            f"expected a number of points and six bounds, got {str(count)[:40]} and {len(bounds)}:"
            " copy the folder again"
        )
    if missing := [name for name in _XYZ if name not in names]:
        raise InputError(
            f"expected the dimensions X, Y and Z in the schema; missing: {', '.join(missing)}: write it again"
        )
    if len(set(names)) < len(names) or not all(map(math.isfinite, (*scales, *offsets, *bounds))) or 0 in scales:
        raise InputError("expected unique dimensions with finite scales and offsets in the schema: write it again")
    crs, unit = read_crs({WKT: system.encode()}, warn) if system else (None, None)
    dtype = np.dtype([(f"{k}", kind) for k, (_, kind, *_) in enumerate(dimensions)])
    return EptIndex(path.parent, data_type, count, bounds, crs, unit, names, dtype, scales, offsets)


def _dimension(entry: dict[str, Any]) -> tuple[str, str, float, float]:
    """Return name, type, scale and offset of a dimension of the schema."""
    name, kind, size = str(entry["name"]), entry["type"], entry["size"]
    if kind not in _KINDS or size not in (1, 2, 4, 8) or (_KINDS[kind] == "f" and size == 1):
        raise InputError(
            "expected dimensions of type signed, unsigned or float with 1, 2, 4 or 8 bytes in the schema, got"
            f" {str(kind)[:20]!r} with {str(size)[:20]} bytes for {name[:40]!r}: write it again, for example with"
            " pdal or untwine"
        )
    return name, f"<{_KINDS[kind]}{size}", float(entry.get("scale") or 1.0), float(entry.get("offset") or 0.0)


def read_hierarchy(index: EptIndex) -> tuple[EptNode, ...]:
    """Read the nodes that contain points, in the order of their keys, and compare them with the files.

    Raises:
        InputError: the hierarchy is damaged, does not add up to the number of points, or names missing files.
    """
    counts: dict[tuple[int, int, int, int], int] = {}
    pages, loaded = ["0-0-0-0"], set[str]()
    while pages:
        page = pages.pop()
        loaded.add(page)
        with errors_named(f"ept-hierarchy/{page}.json"):
            entries = read_json(index.folder / "ept-hierarchy" / f"{page}.json")
            for name, count in entries.items() if isinstance(entries, dict) else [("", 0)]:
                key = _node_key(name)
                if key is None or not isinstance(count, int) or count < -1 or (count == -1 and name in loaded):
                    raise InputError(
                        f"expected point counts of nodes, got {name[:40]!r}: {str(count)[:40]}: copy it again"
                    )
                if count == -1:
                    pages.append(name)
                elif count:
                    counts[key] = count
    nodes = tuple(EptNode(*key, counts[key]) for key in sorted(counts))
    if (total := sum(node.points for node in nodes)) != index.points:
        raise InputError(f"ept.json states {index.points} points, the hierarchy {total}: copy the folder again")
    for node in nodes:
        size = _file_size(index.node_path(node))
        if size is None or (index.data_type == "binary" and size != node.points * index.dtype.itemsize):
            expected = f"{node.points * index.dtype.itemsize} bytes" if index.data_type == "binary" else "a file"
            raise InputError(
                f"{index.node_path(node).name}: expected {expected} with {node.points} points, got"
                f" {'no file' if size is None else f'{size} bytes'}: copy the folder again"
            )
    return nodes


def _file_size(path: Path) -> int | None:
    try:
        return path.stat().st_size
    except OSError:
        return None


def _node_key(name: str) -> tuple[int, int, int, int] | None:
    """Parse a key D-X-Y-Z; return None if it is not one, or outside the octree."""
    words = name.split("-")
    if len(words) != 4 or not all(word.isdecimal() and len(word) < 12 for word in words):
        return None
    depth, x, y, z = map(int, words)
    return (depth, x, y, z) if depth <= _MAX_DEPTH and max(x, y, z) < 1 << depth else None


def read_nodes(
    index: EptIndex, nodes: Sequence[EptNode], filters: LasFilters, warn: Warn, allow_empty: bool
) -> tuple[Fields, LasCounts | None]:
    """Read the points of nodes that pass the filters; also return counts over all points of LAZ nodes.

    Raises:
        InputError: the file of a node is damaged, or no point passes the filters, unless this is allowed.
        MissingExtra: the nodes are LAZ, and lazrs is not installed.
    """
    read = _read_laszip if index.data_type == "laszip" else _read_binary
    fields, counts = read(index, nodes, filters, warn, allow_empty)
    fields["crs"], fields["unit"] = index.crs, index.unit
    return fields, counts


def has_node_normals(index: EptIndex, node: EptNode) -> bool:
    """Return whether the points of a node have normals.

    Raises:
        InputError: the header of a LAZ node is damaged.
    """
    if index.data_type == "binary":
        return set(_NORMALS) <= set(index.names)
    with errors_named(index.node_path(node).name), index.node_path(node).open("rb") as file:
        return has_normals(read_extras(read_header(file, lambda _: None), lambda _: None))


def _read_laszip(
    index: EptIndex, nodes: Sequence[EptNode], filters: LasFilters, warn: Warn, allow_empty: bool
) -> tuple[Fields, LasCounts | None]:
    lines: list[str] = []
    runs: list[LazRun] = []
    for node in nodes:
        path = index.node_path(node)
        with errors_named(path.name), path.open("rb") as file:
            header = read_header(file, lines.append)
            if header.count != node.points or not header.compressed:
                raise InputError(f"expected LAZ with {node.points} points, got {header.count}: copy the file again")
            extras = read_extras(header, lines.append)
            runs.append(LazRun(path, header, 0, len(read_chunks(file, header)), header.count, path.name))
            if _layout(header) != _layout(runs[0].header):
                raise InputError(
                    "expected the point format, scale and offset of other nodes, got others: copy it again"
                )
    records = decompress(runs).view(record_type(header, extras))
    for line in dict.fromkeys(lines):  # one line, not one per node
        warn(line)
    first = 0
    for run in runs:  # each node has its own bounds
        of_node = records[first : first + run.points]
        for line in count_records(of_node, run.header).bounds_warnings(run.header):
            warn(f"{run.name}: {line}")
        first += run.points
    counts = count_records(records, replace(header, bounds=None))
    fields = las_fields(filter_records(records, header, filters, allow_empty), header, extras, warn)
    return fields | brightest_of(records), counts


def _layout(header: LasHeader) -> tuple[object, ...]:
    """Return what the headers of all nodes must have in common to read their points together."""
    extra_bytes = header.records.get(EXTRA_BYTES)
    return header.point_format, header.record_bytes, header.scales, header.offsets, extra_bytes


def _read_binary(
    index: EptIndex, nodes: Sequence[EptNode], filters: LasFilters, warn: Warn, allow_empty: bool
) -> tuple[Fields, LasCounts | None]:
    parts = []
    for node in nodes:
        with errors_named(index.node_path(node).name):
            records = np.fromfile(index.node_path(node), index.dtype)
            if len(records) != node.points:
                raise InputError(f"truncated: got {len(records)} of {node.points} points: copy the file again")
            parts.append(records)
    records = np.concatenate(parts)
    columns = {name: records[f"{k}"] for k, name in enumerate(index.names)}
    highest = _highest_color(index, columns)
    if filters != LasFilters():
        wanted = ["Classification"] * (filters.classes is not None)
        wanted += ["ReturnNumber", "NumberOfReturns"] * (filters.returns is not None)
        if missing := [name for name in wanted if name not in columns]:
            raise InputError(f"expected dimensions to filter by {filters}; missing: {', '.join(missing)}")
        zeros = np.zeros(len(records), np.uint8)
        classes, return_numbers, return_counts = (
            columns.get(name, zeros) for name in ("Classification", "ReturnNumber", "NumberOfReturns")
        )
        keep = filters.keep(classes, return_numbers, return_counts)
        if not allow_empty and not keep.any():
            raise no_match_error(filters, classes, return_numbers)
        columns = {name: column[keep] for name, column in columns.items()}
    return _binary_fields(index, columns, highest), None


def _highest_color(index: EptIndex, columns: dict[str, NDArray[Any]]) -> int | None:
    """Return the largest value of the colours; None if there are none, or none that fit into 16 bits."""
    scales = dict(zip(index.names, zip(index.scales, index.offsets, strict=True), strict=True))
    if not all(name in columns and columns[name].dtype.kind == "u" and scales[name] == (1.0, 0.0) for name in _COLORS):
        return None
    highest = max(int(columns[name].max(initial=0)) for name in _COLORS)
    return highest if highest < 1 << 16 else None


def _binary_fields(index: EptIndex, columns: dict[str, NDArray[Any]], highest_color: int | None) -> Fields:
    factors = dict(zip(index.names, zip(index.scales, index.offsets, strict=True), strict=True))
    columns = {name: column.astype(column.dtype.newbyteorder("=")) for name, column in columns.items()}
    points = np.stack(
        [columns.pop(name).astype(np.float64) * factors[name][0] + factors[name][1] for name in _XYZ], axis=1
    )
    columns = {
        name: column if factors[name] == (1.0, 0.0) else column * factors[name][0] + factors[name][1]
        for name, column in columns.items()
    }
    colors = normals = None
    depth = Fields()
    if highest_color is not None:
        colors = np.stack([columns.pop(name) for name in _COLORS], axis=1)
        if colors.dtype != np.uint8:
            colors, depth = colors.astype(np.uint16), Fields(brightest=highest_color)
    if set(_NORMALS) <= columns.keys():
        normals = np.stack([columns.pop(name) for name in _NORMALS], axis=1)
    attributes = {name: column for name, column in columns.items() if name not in _LEFT_OUT}
    names = standard_names(list(attributes), taken=(*XYZ, *COLORS, *NORMALS))
    attributes = dict(zip(names, attributes.values(), strict=True))
    (x, x0), (y, y0), (z, z0) = (factors[name] for name in _XYZ)
    stored = Storage((x, y, z), (x0, y0, z0), None if colors is None else 8)
    return Fields(points=points, normals=normals, colors=colors, attributes=attributes, stored=stored) | depth
