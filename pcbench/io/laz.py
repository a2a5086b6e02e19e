"""Compress and decompress the points of LAZ and COPC files with lazrs.

LAZ has no checksum. Of 390 files with a changed bit, byte or block, lazrs refused 255. 127 of the others had points
outside the header's bounds, see `las_checks`, and 8 only wrong times or colours.
COPC is LAZ whose chunks are the nodes of an octree, read in the order of the file without its hierarchy.

Martin Isenburg, "LASzip: lossless compression of LiDAR data", Photogrammetric Engineering & Remote Sensing, 2013.
"""

from __future__ import annotations

import struct
import sys
from collections.abc import Sequence
from io import BytesIO
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcbench.children import Limits, run_script
from pcbench.errors import InputError, MissingExtra
from pcbench.extras import require
from pcbench.io.las_header import LasHeader
from pcbench.io.laz_worker import clip_chunks

LASZIP = ("laszip encoded", 22204)
_LASZIP_LAYOUT = struct.Struct("<HHBBHIIqqH")  # compressor, coder, version (3), options, chunk size, 2 counts, items
_ITEM_LAYOUT = struct.Struct("<HHH")  # type, bytes, version
_VARIABLE_CHUNKS = 0xFFFFFFFF  # COPC: the chunk table states the number of points per chunk

# Bound of the decompressed size: this factor times the file size, plus bytes. Clouds shrink 3 to 20 times, grids more.
_MAX_GROWTH, _MAX_FREE_GROWTH_BYTES = 1000, 256 << 20
_WORKER = str(Path(__file__).with_name("laz_worker.py"))
_MAX_WORKER_MEMORY = 1 << 30  # bytes of address space besides twice the points: code, stacks, one heap per thread
_MAX_WORKER_SECONDS = 30.0  # plus the time for the points at `_MIN_WORKER_SPEED`
_MAX_RUNS = 200  # per child process: a command line has a limited length
_MIN_WORKER_SPEED = 1e6  # bytes per second; lazrs does 30 million on one core


class LazChunk(NamedTuple):
    """Number of points that are compressed together, and their compressed size in bytes."""

    points: int
    size: int


def read_chunks(file: BinaryIO, header: LasHeader) -> list[LazChunk]:
    """Read the chunk table: all chunks that contain points, in the order of the file.

    Raises:
        InputError: the table is damaged, or does not fit the header or the size of the file.
        MissingExtra: lazrs is not installed.
    """
    lazrs = require("lazrs")
    table = _check_chunks(file, header)
    file.seek(header.start)
    try:
        # `_check_chunks` has limited the number of chunks, from which lazrs allocates memory.
        entries = lazrs.read_chunk_table(file, lazrs.LazVlr(header.records[LASZIP]))
        chunks = [LazChunk(*entry) for entry in clip_chunks(entries, header.count)]
    except (lazrs.LazrsError, ValueError, OverflowError, OSError) as error:
        raise _damage_error(f"the chunk table cannot be read: {error}") from error
    if (size := sum(chunk.size for chunk in chunks)) > table - header.start - 8:
        raise _damage_error(f"the chunk table states {size} bytes of points, the file has {table - header.start - 8}")
    return chunks


class LazRun(NamedTuple):
    """Chunks `first` to `end` - 1 of a file.

    Attributes:
        path: the file.
        header: its header.
        first: index of the first chunk.
        end: index after the last chunk.
        points: number of points of these chunks.
        name: what messages call the file; empty if the caller names it.
    """

    path: Path
    header: LasHeader
    first: int
    end: int
    points: int
    name: str = ""


def decompress(runs: Sequence[LazRun]) -> NDArray[np.uint8]:
    """Decompress chunks of files with records of one size to bytes as in a LAS file, (points * record_bytes,).

    Several files are decompressed together, which is faster than one after the other.

    Raises:
        InputError: the compressed data are damaged.
        MissingExtra: lazrs is not installed or does not load.
    """
    if not sys.executable:
        raise InputError(
            "expected a Python interpreter to decompress LAZ in a child process, got none: convert the file to .las"
        )
    record_bytes = runs[0].header.record_bytes
    points = np.empty(sum(run.points for run in runs) * record_bytes, dtype=np.uint8)
    start = 0
    for k in range(0, len(runs), _MAX_RUNS):
        batch = runs[k : k + _MAX_RUNS]
        ends = np.cumsum([run.points * record_bytes for run in batch])
        size = int(ends[-1])
        done = run_script(
            _WORKER,
            *(argument for run in batch for argument in _arguments(run)),
            limits=Limits(seconds=_MAX_WORKER_SECONDS + size / _MIN_WORKER_SPEED, memory=_MAX_WORKER_MEMORY + 2 * size),
            environment={"MALLOC_ARENA_MAX": "4"},  # each arena takes 64 MiB of the allowed address space
            into=points[start : start + size].data,
        )
        if done.code == 3:
            raise MissingExtra("lazrs", "las", "it is installed but does not load")
        if done.code or done.received < size:
            received = min(done.received, size - 1)
            number = int(np.searchsorted(ends, received, side="right"))
            run, lost = batch[number], -(-(int(ends[number]) - received) // record_bytes)
            error = _damage_error(f"decompressed only {run.points - lost} of {run.points} points")
            raise InputError(f"{run.name}: {error}") if run.name else error
        start += size
    return points


def _arguments(run: LazRun) -> list[str]:
    """Return the worker's arguments."""
    header = run.header
    numbers = (header.count, header.record_bytes, run.first, run.end)
    return [str(run.path.resolve()), str(header.start), header.records[LASZIP].hex(), *map(str, numbers)]


def _damage_error(reason: str) -> InputError:
    return InputError(f"damaged LAZ data: {reason}: copy or export the file again")


def _check_chunks(file: BinaryIO, header: LasHeader) -> int:
    """Check the LASzip record, and the position and length of the chunk table after the points; return its position."""
    record = header.records.get(LASZIP, b"")
    if len(record) < _LASZIP_LAYOUT.size:
        raise _damage_error("the header has no LASzip record")
    compressor, *_, chunk_size, _, _, items = _LASZIP_LAYOUT.unpack_from(record)
    if compressor not in (2, 3):
        raise InputError(f"expected LASzip compressor 2 or 3 (chunked), got {compressor}: compress the file again")
    if len(record) < _LASZIP_LAYOUT.size + items * _ITEM_LAYOUT.size:
        raise _damage_error("the LASzip record is incomplete")
    item_bytes = sum(
        _ITEM_LAYOUT.unpack_from(record, _LASZIP_LAYOUT.size + k * _ITEM_LAYOUT.size)[1] for k in range(items)
    )
    if item_bytes != header.record_bytes:
        raise _damage_error(f"the LASzip record states {item_bytes} bytes per point, the header {header.record_bytes}")

    size = file.seek(0, 2)
    table = _read_integer(file, header.start, "<q")
    if table == -1:  # written as a stream: the position is stored at the end of the file
        table = _read_integer(file, size - 8, "<q")
    if not header.start + 8 <= table <= size - 8:
        raise InputError(
            f"truncated LAZ data: expected the chunk table at byte {table}, the file has {size} bytes:"
            " copy or export the file again"
        )
    chunks = _read_integer(file, table + 4, "<I")
    if chunks * header.record_bytes > table - header.start - 8:  # each chunk starts with an uncompressed point
        raise _damage_error(f"{chunks} chunks do not fit into {table - header.start - 8} bytes")
    if chunk_size != _VARIABLE_CHUNKS and header.count > chunks * chunk_size:
        raise _damage_error(f"{chunks} chunks of {chunk_size} points cannot hold {header.count} points")
    unpacked = header.count * header.record_bytes
    if unpacked > _MAX_FREE_GROWTH_BYTES + _MAX_GROWTH * size:
        raise _damage_error(f"{size} bytes would decompress to {unpacked} bytes")
    return table


def _read_integer(file: BinaryIO, offset: int, code: str) -> int:
    layout = struct.Struct(code)
    file.seek(max(offset, 0))
    data = file.read(layout.size)
    if len(data) < layout.size:
        raise InputError("truncated LAZ data: the file ends before its points: copy or export the file again")
    return int(layout.unpack(data)[0])


def laszip_record(point_format: int, extra_bytes: int) -> bytes:
    """Return the LASzip record for a new file."""
    lazrs = require("lazrs")
    return bytes(lazrs.LazVlr.new_for_compression(point_format, extra_bytes).record_data())


def compress(points: memoryview, laszip: bytes, start: int) -> memoryview:
    """Compress point records as stored in a LAZ file from byte `start`.

    This happens in memory because lazrs would replace "No space left on device" with its own error.

    Args:
        points: point records of a LAS file.
        laszip: LASzip record of the file.
        start: offset of the points in the file, in bytes.
    """
    import lazrs

    buffer = BytesIO(bytes(start))  # the position of the chunk table is relative to the start of the file
    buffer.seek(start)
    compressor = lazrs.ParLasZipCompressor(buffer, lazrs.LazVlr(laszip))
    compressor.compress_many(points)
    compressor.done()
    return buffer.getbuffer()[start:]
