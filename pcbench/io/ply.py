"""Read and write PLY: ascii and binary, any order of elements and properties, list properties anywhere.

`ply_header` reads the header and `ply_body` the elements; this module converts them to a cloud or a mesh.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from pcbench.errors import InputError
from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.mesh import Mesh
from pcbench.io.columns import packed_rows, plain_type
from pcbench.io.files import MAX_PADDING, Fields, Look, Warn, check_end
from pcbench.io.names import (
    COLORS,
    NORMALS,
    PACKED_COLORS,
    XYZ,
    Columns,
    stored_attributes,
    take_fields,
    take_points,
)
from pcbench.io.ply_body import read_elements
from pcbench.io.ply_header import TYPE_NAMES, Element, PlyHeader, check_faces, check_vertices, read_header
from pcbench.io.ply_packed import ELEMENTS, check_packed, is_packed, unpack
from pcbench.io.polygons import left_out_surface, triangulate, triangulate_strips
from pcbench.io.splat_fields import DC, colors_of
from pcbench.scratch import atomic_write

ABOUT = "coordinates about"  # tag of the comment line with the origin that is added to all coordinates
_NORMAL_BLOCK = 1 << 16  # vertices


def look_at_ply(path: Path) -> Look:
    """Read the header of a PLY file; the grid of a scan is no mesh.

    Raises:
        InputError: the file does not start with a PLY header.
        OSError: the file cannot be read.
    """
    with path.open("rb") as file:
        header = read_header(file)
    return Look(any(not element.is_grid for element in header.surface), header)


def read_ply(path: Path, warn: Warn, header: PlyHeader | None = None) -> Fields:
    """Read the vertices of a PLY file as `read_ply_vertices` does, with a warning if they belong to a mesh."""
    header = header or look_at_ply(path).header
    fields = read_ply_vertices(path, warn, header)
    unknown = [e for e in header.elements if e.lists and e.count and e.name != "vertex" and e not in header.surface]
    if header.surface:
        warn(left_out_surface(len(fields["points"]), header.surface[0].count_text()))
    elif unknown:
        warn(
            f"left out {unknown[0].count_text()} with lists of numbers: if they are a surface, name the element 'face'"
            " and its list 'vertex_indices'"
        )
    return fields


def read_ply_vertices(path: Path, warn: Warn, header: PlyHeader | None = None) -> Fields:
    """Read the vertices of a PLY file: x y z, normals, colours; all other scalars are attributes.

    Coordinates become float64; those of an ascii file keep all digits, whatever type it declares. Attributes keep their
    type and, in native byte order, are strided views into the bytes read. List properties and other elements are
    checked for their size and left out. Normals that are all zero, as in Gaussian splats, are left out. The lines
    `comment crs EPSG:32617` and `comment unit m` set the crs and unit. `comment coordinates about X Y Z` is an origin
    that is added to all points, since floats have too few digits for projected coordinates. Compressed Gaussian splats
    are unpacked.

    Raises:
        InputError: the file is not a complete PLY file with at least one vertex.
        OSError: the file cannot be read.
    """
    # Damaged floats may be signalling NaNs or overflow a narrower type; they become NaN or Inf and are dropped later.
    with _open_body(path, header) as (file, header), np.errstate(invalid="ignore", over="ignore"):
        if is_packed(header):
            check_packed(header)
            tables = read_elements(file, header, warn, scalars=ELEMENTS)
            return unpack(*(tables[name].columns if name in tables else {} for name in ELEMENTS))
        check_vertices(header)
        columns = read_elements(file, header, warn, scalars=("vertex",))["vertex"].columns
        return _fields(columns, header, warn)


@dataclass(frozen=True)
class PlyRows:
    """Vertices of a binary file that are rows of one size.

    Attributes:
        header: header of the file.
        start: first byte of the vertices.
        dtype: type of a row, named as the properties.
    """

    header: PlyHeader
    start: int
    dtype: np.dtype[Any]

    @property
    def count(self) -> int:
        """Number of vertices."""
        return (self.header.element("vertex") or Element("vertex", 0)).count


def find_rows(path: Path, warn: Warn, header: PlyHeader | None = None) -> PlyRows | None:
    """Return the vertices of a file from its header, or None if they cannot be read in parts.

    They can if they are binary rows of one size, and their colours are bytes: the scale of others depends on all rows.

    Raises:
        InputError: the header is damaged, or the file is truncated.
        OSError: the file cannot be read.
    """
    with _open_body(path, header) as (file, header):
        if is_packed(header):
            return None
        check_vertices(header)
        start = header.nbytes
        if header.byte_order is None:
            return None
        for element in header.elements:
            if element.lists:
                return None
            dtype = np.dtype([(prop.name, prop.dtype) for prop in element.properties])
            if element.name == "vertex":
                break
            start += element.count * dtype.itemsize
        if any(dtype[name] != np.uint8 for name in set(COLORS) & set(dtype.names or ())):
            return None
        left = file.seek(0, 2) - start
        if left < element.count * dtype.itemsize:
            raise element.truncation_error(max(left, 0) // dtype.itemsize)
        if element is not header.elements[-1]:
            return None  # other elements are checked by reading all of them
        file.seek(start + element.count * dtype.itemsize)
        rest = file.read(MAX_PADDING)
        check_end(rest, left - element.count * dtype.itemsize, dtype.itemsize, "the last element", warn)
    return PlyRows(header, start, dtype)


def read_rows(path: Path, rows: PlyRows, first: int, count: int, warn: Warn) -> Fields:
    """Read some of the vertices of a file as `read_ply` does, but keep normals that are all zero.

    Raises:
        InputError: the file has become shorter.
        OSError: the file cannot be read.
    """
    table = np.fromfile(path, rows.dtype, count, offset=rows.start + first * rows.dtype.itemsize)
    if len(table) < count:
        raise InputError(f"truncated: got {first + len(table)} of {rows.count} vertices: copy or export the file again")
    with np.errstate(invalid="ignore", over="ignore"):
        columns = {name: table[name] for name in rows.dtype.names or ()}
        return _fields(columns, rows.header, warn, keep_zero_normals=True)


def has_normals(path: Path, rows: PlyRows) -> bool:
    """Return whether the vertices have normals that are not all zero; usually the first rows show it.

    Raises:
        OSError: the file cannot be read.
    """
    if not set(NORMALS) <= set(rows.dtype.names or ()):
        return False
    blocks = range(0, rows.count, _NORMAL_BLOCK)
    return any(
        np.fromfile(
            path, rows.dtype, min(_NORMAL_BLOCK, rows.count - first), offset=rows.start + first * rows.dtype.itemsize
        )[name].any()
        for first in blocks
        for name in NORMALS
    )


def _fields(columns: Columns, header: PlyHeader, warn: Warn, keep_zero_normals: bool = False) -> Fields:
    points = _points(columns, header)
    normals, colors, attributes = take_fields(columns, warn)
    if colors is None and attributes.keys() >= set(DC):  # splats
        colors = colors_of(np.stack([attributes[name] for name in DC], axis=1))
    return Fields(
        points=points,
        normals=normals if normals is not None and (keep_zero_normals or normals.any()) else None,
        colors=colors,
        attributes={name: c.astype(c.dtype.newbyteorder("="), copy=False) for name, c in attributes.items()},
        crs=header.tag_value("crs"),
        unit=header.tag_value("unit"),
    )


def read_ply_mesh(path: Path, warn: Warn, header: PlyHeader | None = None) -> Mesh:
    """Read polygons and triangle strips of a PLY file as triangles, with its crs and unit.

    Raises:
        InputError: the file is not a complete PLY file with at least one vertex and a list of vertices per face, or a
            surface is stored in another way.
        OSError: the file cannot be read.
    """
    with _open_body(path, header) as (file, header), np.errstate(invalid="ignore", over="ignore"):
        check_vertices(header)
        check_faces(header)
        names = [element.name for element in header.surface]
        tables = read_elements(file, header, warn, scalars=("vertex",), polygons=names)
        points = _points(tables["vertex"].columns, header)
    faces = [np.empty((0, 3), dtype=np.int64)]
    for name in names:
        polygons = tables[name].polygons
        assert polygons is not None  # check_faces
        faces.append(triangulate_strips(*polygons) if "strip" in name else triangulate(points, *polygons, warn))
    return Mesh(points, np.concatenate(faces), crs=header.tag_value("crs"), unit=header.tag_value("unit"))


@contextmanager
def _open_body(path: Path, header: PlyHeader | None) -> Iterator[tuple[BinaryIO, PlyHeader]]:
    """Open a file at the first byte after its header, which is read unless it is given."""
    with path.open("rb") as file:
        header = header or read_header(file)
        file.seek(header.nbytes)
        yield file, header


def _points(columns: Columns, header: PlyHeader) -> FloatArray:
    """Remove the coordinates from the columns and return them, with the origin in the header added."""
    points = take_points(columns)
    words = (header.tag_value(ABOUT) or "").split()
    try:
        origin = np.array([float(word) for word in words])
    except ValueError:
        return points
    if origin.shape == (3,) and np.isfinite(origin).all():
        points += origin
    return points


def write_ply(path: Path, cloud: Cloud, warn: Warn) -> None:
    """Write binary little-endian PLY: x y z double, nx ny nz float, red green blue uchar, attributes in their type.

    Normals are directions, for which the 7 digits of float are enough. Attributes of types that PLY lacks are converted
    to others: bool to uchar, half to float, the rest to the first of int, uint and double that holds the values
    (integers beyond 2^53 are rounded). `crs` and `unit` are written as comment lines.

    Raises:
        InputError: an attribute does not consist of numbers.
        OSError: the file cannot be written; an existing file is then unchanged.
    """
    columns: Columns = {name: cloud.points[:, axis] for axis, name in enumerate(XYZ)}
    if cloud.normals is not None:
        columns |= {name: cloud.normals[:, axis].astype(np.float32) for axis, name in enumerate(NORMALS)}
    if cloud.colors is not None:
        columns |= {name: cloud.colors[:, axis] for axis, name in enumerate(COLORS)}
    attributes = stored_attributes(cloud.attributes, "PLY", warn, reserved={*columns, *PACKED_COLORS})
    columns |= {name: _as_ply_type(values) for name, values in attributes.items()}
    write_vertices(path, columns, _tags(cloud))


def write_vertices(path: Path, columns: Columns, tags: Mapping[str, str]) -> None:
    """Write a binary little-endian PLY file that contains only vertices.

    Args:
        path: output file.
        columns: vertex properties (N,) by name, in order, of types that PLY supports.
        tags: comment lines, as text by tag.

    Raises:
        OSError: the file cannot be written; an existing file is then unchanged.
    """
    _write(path, columns, tags, None)


def write_ply_mesh(path: Path, mesh: Mesh) -> None:
    """Write a mesh as binary little-endian PLY: x y z as double, faces as lists of int, crs and unit as comment lines.

    Raises:
        OSError: the file cannot be written; an existing file is then unchanged.
    """
    columns: Columns = {name: mesh.vertices[:, axis] for axis, name in enumerate(XYZ)}
    _write(path, columns, _tags(mesh), mesh.faces)


def _write(path: Path, columns: Columns, tags: Mapping[str, str], triangles: NDArray[Any] | None) -> None:
    vertices = packed_rows(columns)
    comments = [f"comment {tag} {_one_line(text)}" for tag, text in tags.items()]
    properties = [f"property {TYPE_NAMES[column.dtype.str[1:]]} {name}" for name, column in columns.items()]
    lines = ["ply", "format binary_little_endian 1.0", *comments, f"element vertex {len(vertices)}", *properties]
    faces = np.empty(0 if triangles is None else len(triangles), dtype=[("count", "u1"), ("corners", "<i4", 3)])
    if triangles is not None:
        lines += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
        faces["count"], faces["corners"] = 3, triangles
    with atomic_write(path) as file:
        file.write(("\n".join([*lines, "end_header"]) + "\n").encode())
        for rows in (vertices, faces):
            file.write(rows.view(np.uint8).data)


def _tags(shape: Cloud | Mesh) -> dict[str, str]:
    return {tag: text for tag, text in (("crs", shape.crs), ("unit", shape.unit)) if text}


def _one_line(text: str) -> str:
    return " ".join("".join(char if char.isprintable() else " " for char in text).split())


def _as_ply_type(values: NDArray[Any]) -> NDArray[Any]:
    values = plain_type(values)
    if values.dtype.str[1:] in TYPE_NAMES:
        return values
    if values.dtype.kind in "iu":
        low, high = int(values.min()), int(values.max())
        for dtype in (np.int32, np.uint32):
            if np.iinfo(dtype).min <= low and high <= np.iinfo(dtype).max:
                return values.astype(dtype)
    return values.astype(np.float64)
