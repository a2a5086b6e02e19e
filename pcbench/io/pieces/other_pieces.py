"""Pieces of PLY are ranges of vertices, those of E57 scans, and those of EPT groups of nodes.

Files of other formats, and PLY files that are text or contain lists, are one piece. They have no header that tells
what `CloudFile` contains, so they are read when the cloud is opened, and again as a piece.
"""

from __future__ import annotations

from itertools import chain
from pathlib import Path

from pcbench.geometry.arrays import bounds
from pcbench.geometry.splats import has_splats
from pcbench.io.e57 import no_points_error, read_e57_header, read_e57_scan
from pcbench.io.ept import EptNode, has_node_normals, read_hierarchy, read_index, read_nodes
from pcbench.io.files import Fields, Warn, finite_cloud
from pcbench.io.formats import format_of
from pcbench.io.las_checks import LasCounts
from pcbench.io.las_records import LasFilters
from pcbench.io.pieces.las_pieces import group, split
from pcbench.io.pieces.types import CloudFile, Part, as_corner
from pcbench.io.ply import find_rows, has_normals, look_at_ply, read_ply, read_rows
from pcbench.io.ply_header import PlyHeader, read_header

_COORDINATE_BYTES, _NORMAL_BYTES, _VALUE_BYTES = 24, 24, 8


def describe_ply(
    path: Path, piece_points: int, warn: Warn, header: PlyHeader | None = None
) -> tuple[CloudFile, list[Part]]:
    """Describe a PLY file.

    Raises:
        InputError: the header is damaged, or the file is truncated.
        OSError: the file cannot be read.
    """
    header = header or look_at_ply(path).header
    rows = find_rows(path, warn, header)
    if rows is None:
        return _describe(read_ply(path, warn, header), path)
    normals = has_normals(path, rows)
    point_bytes = _COORDINATE_BYTES + _NORMAL_BYTES * normals + rows.dtype.itemsize
    crs, unit = rows.header.tag_value("crs"), rows.header.tag_value("unit")
    splats = has_splats(rows.dtype.names or ())
    file = CloudFile(path, rows.count, None, None, crs, unit, normals, rows.count * point_bytes, has_splats=splats)
    return file, split(rows.count, piece_points)


def read_ply_piece(
    path: Path, address: tuple[int, ...], filters: LasFilters, warn: Warn
) -> tuple[Fields, LasCounts | None]:
    """Read a range of vertices; raises the same errors as `describe_ply`."""
    rows = find_rows(path, warn)
    if rows is None or not address:
        return read_whole(path, address, filters, warn)
    first, end = address
    return read_rows(path, rows, first, end - first, warn), None


def count_ply(path: Path) -> int | None:
    """Return the number of vertices in the header; raises the same errors as `describe_ply`."""
    with path.open("rb") as file:
        vertex = read_header(file).element("vertex")
        return None if vertex is None else vertex.count


def describe_e57(path: Path, piece_points: int, warn: Warn) -> tuple[CloudFile, list[Part]]:
    """Describe the scans of an E57 file; raises the same errors as `read_e57`."""
    header = read_e57_header(path)
    scans = [(number, scan) for number, scan in enumerate(header.scans) if scan.points]
    if not scans:
        raise no_points_error(len(header.scans))
    count = sum(scan.points for _, scan in scans)
    normals = all(scan.has_normals for _, scan in scans)
    file = CloudFile(path, count, None, None, header.crs, "m", normals, count * (_COORDINATE_BYTES + 4 * _VALUE_BYTES))
    return file, [Part(scan.points, (number,)) for number, scan in scans]


def read_e57_piece(
    path: Path, address: tuple[int, ...], filters: LasFilters, warn: Warn
) -> tuple[Fields, LasCounts | None]:
    """Read one scan; raises the same errors as `read_e57`."""
    return read_e57_scan(path, address[0], warn), None


def describe_ept(path: Path, piece_points: int, warn: Warn) -> tuple[CloudFile, list[Part]]:
    """Describe a set of Entwine Point Tiles, given its ept.json; the address of a piece is its nodes.

    Raises:
        InputError: ept.json or the hierarchy is damaged, or a file is missing.
        OSError: ept.json cannot be read.
    """
    index = read_index(path, warn)
    nodes = read_hierarchy(index)
    parts = [
        Part(sum(node.points for node in nodes[first:end]), tuple(chain.from_iterable(nodes[first:end])))
        for first, end in group((node.points for node in nodes), piece_points)
    ]
    low, high = as_corner(index.bounds[:3]), as_corner(index.bounds[3:])
    nbytes = index.points * (_COORDINATE_BYTES + index.dtype.itemsize)
    return CloudFile(
        path, index.points, low, high, index.crs, index.unit, has_node_normals(index, nodes[0]), nbytes
    ), parts


def read_ept_piece(
    path: Path, address: tuple[int, ...], filters: LasFilters, warn: Warn
) -> tuple[Fields, LasCounts | None]:
    """Read a group of nodes; raises the same errors as `read_ept`."""
    width = len(EptNode._fields)
    nodes = [EptNode(*address[k : k + width]) for k in range(0, len(address), width)]
    return read_nodes(read_index(path, warn), nodes, filters, warn, allow_empty=True)


def count_ept(path: Path) -> int:
    """Return the number of points in ept.json; raises the same errors as `describe_ept`."""
    return read_index(path, lambda _: None).points


def describe_whole(path: Path, piece_points: int, warn: Warn) -> tuple[CloudFile, list[Part]]:
    """Describe a file by reading it; raises the same errors as `read_cloud`."""
    return _describe(format_of(path).read(path, warn), path)


def _describe(fields: Fields, path: Path) -> tuple[CloudFile, list[Part]]:
    """Describe a file that was read."""
    count = len(fields["points"])
    cloud = finite_cloud(fields, lambda _: None)
    low, high = map(as_corner, bounds(cloud.points))
    columns = cloud.points, cloud.normals, cloud.colors, *cloud.attributes.values()
    nbytes = sum(values.nbytes for values in columns if values is not None)
    normals, splats = cloud.normals is not None, has_splats(cloud.attributes)
    file = CloudFile(path, count, low, high, cloud.crs, cloud.unit, normals, nbytes, has_splats=splats)
    return file, [Part(count, ())]


def read_whole(
    path: Path, address: tuple[int, ...], filters: LasFilters, warn: Warn
) -> tuple[Fields, LasCounts | None]:
    """Read a whole file; raises the same errors as `read_cloud`."""
    return format_of(path).read(path, warn), None
