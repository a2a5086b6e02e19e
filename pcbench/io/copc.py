"""Check the hierarchy of a COPC file, a LAZ file whose chunks are the nodes of an octree.

pcbench reads the nodes in the order of the file, from the chunk table of LAZ. Other programs find them through the
hierarchy, so both must agree. Specification: https://copc.io, version 1.0.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from pcbench.errors import InputError
from pcbench.io.las_header import LasHeader

COPC_INFO = ("copc", 1)
_INFO = struct.Struct("<3d d d QQ")  # centre, half size, spacing, offset and size of the root page
_ENTRY = np.dtype([("key", "<i4", 4), ("offset", "<u8"), ("size", "<i4"), ("points", "<i4")])
_PAGE = -1  # point count of an entry that refers to another page


def check_hierarchy(file: BinaryIO, header: LasHeader, chunks: Sequence[tuple[int, int]]) -> None:
    """Check that the nodes of the hierarchy are the chunks of the file; do nothing if it is not a COPC file.

    Args:
        file: input file.
        header: header of the file.
        chunks: number of points and compressed size in bytes of each chunk, in the order of the file.

    Raises:
        InputError: a page lies outside the file, or the nodes are not the chunks.
    """
    record = header.records.get(COPC_INFO)
    if record is None:
        return
    if len(record) < _INFO.size:
        raise _damage_error(f"the info record has {len(record)} bytes")
    *_, offset, size = _INFO.unpack_from(record)
    entries = _read_entries(file, offset, size)
    nodes = entries[np.argsort(entries["offset"], kind="stable")]
    points, sizes = np.array(chunks, dtype=np.int64).reshape(-1, 2).T
    offsets = header.start + 8 + np.cumsum(sizes) - sizes
    stated = int(nodes["points"].sum(dtype=np.int64))
    if len(nodes) != len(points) or stated != header.count:
        raise _damage_error(
            f"it has {len(nodes)} nodes with {stated} points, the file {len(points)} chunks with {header.count}"
        )
    differs = (nodes["offset"] != offsets) | (nodes["size"] != sizes) | (nodes["points"] != points)
    if differs.any():
        node = nodes[int(np.argmax(differs))]
        raise _damage_error(
            f"node {'-'.join(map(str, node['key']))} with {node['points']} points at byte {node['offset']} is not a"
            " chunk of the file"
        )


def _read_entries(file: BinaryIO, offset: int, size: int) -> NDArray[Any]:
    """Return the entries of all nodes with points, from all pages."""
    end = file.seek(0, 2)
    pages, found, left = [(offset, size)], [np.empty(0, _ENTRY)], end // _ENTRY.itemsize
    while pages:
        offset, size = pages.pop()
        left -= max(size // _ENTRY.itemsize, 1)
        if size <= 0 or size % _ENTRY.itemsize or offset + size > end or left < 0:
            raise _damage_error(
                f"a page of {size} bytes at byte {offset} does not fit into the {end} bytes of the file"
            )
        file.seek(offset)
        entries = np.frombuffer(file.read(size), _ENTRY)
        references = entries[entries["points"] == _PAGE]
        pages += zip(references["offset"].tolist(), references["size"].tolist(), strict=True)
        if (entries["points"] < _PAGE).any():
            raise _damage_error("it states negative numbers of points")
        found.append(entries[entries["points"] > 0])
    return np.concatenate(found)


def _damage_error(reason: str) -> InputError:
    return InputError(f"damaged COPC hierarchy: {reason}: write the file again")
