"""Compress and decompress the points of LAZ and COPC files with lazrs.

LAZ has no checksum, and lazrs decodes damaged bytes without an error. Decoded points are therefore encoded again:
LASzip and lazrs write the same bytes for the same points, so different bytes mean damage or another writer.

Martin Isenburg, "LASzip: lossless compression of LiDAR data", Photogrammetric Engineering & Remote Sensing, 2013.
"""

from __future__ import annotations

import struct
import sys
from collections.abc import Sequence
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcbench.children import ChildResult, Limits, run_script
from pcbench.errors import InputError, MissingExtra
from pcbench.extras import require
from pcbench.io.copc import check_hierarchy
from pcbench.io.files import Warn, errors_named
from pcbench.io.las_header import LasHeader
from pcbench.io.laz_worker import clip_chunks

LASZIP = ("laszip encoded", 22204)
_LASZIP_LAYOUT = struct.Struct("<HHBBHIIqqH")  # compressor, coder, version (3), options, chunk size, 2 counts, items
_ITEM_LAYOUT = struct.Struct("<HHH")  # type, bytes, version
_VARIABLE_CHUNKS = 0xFFFFFFFF  # COPC: the chunk table states the number of points per chunk

# Bound of the decompressed size: this factor times the file size, plus bytes. Clouds shrink 3 to 20 times, grids more.
_MAX_GROWTH, _MAX_FREE_GROWTH_BYTES = 1000, 256 << 20
_EXIT_SOME_DIFFER, _EXIT_ALL_DIFFER = 4, 5  # exit statuses of the worker: encoding the points again gives other bytes
UNVERIFIED = (
    "could not verify the compressed points: encoding them again gives other bytes, so they are damaged or were written"
    " by a program other than LASzip and lazrs"
)
_WORKER = str(Path(__file__).with_name("laz_worker.py"))
_MAX_WORKER_MEMORY = 1 << 30  # bytes of address space besides twice the points: code, stacks, one heap per thread
_MAX_WORKER_SECONDS = 30.0  # plus the time for the points at `_MIN_WORKER_SPEED`
_MAX_JOBS = 200  # files per child process: a command line has a limited length
_MIN_WORKER_SPEED = 1e6  # bytes per second; lazrs does 30 million on one core, in both directions


class LazChunk(NamedTuple):
    """Number of points that are compressed together, and their compressed size in bytes."""

    points: int
    size: int


def read_chunks(file: BinaryIO, header: LasHeader) -> list[LazChunk]:
    """Read the chunk table: all chunks that contain points, in the order of the file.

    Raises:
        InputError: the table is damaged, or does not fit the header, the size of the file or the hierarchy of COPC.
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
    check_hierarchy(file, header, chunks)
    return chunks


def decompress(
    file: BinaryIO, header: LasHeader, chunks: Sequence[LazChunk], warn: Warn, first: int = 0, end: int | None = None
) -> NDArray[np.uint8]:
    """Decompress chunks to the bytes of point records as in a LAS file, (points * record_bytes,).

    If the encoding of all chunks differs from the file, a warning says that the points could not be verified. If only
    some chunks differ, these are damaged, since one program wrote all of them.

    Args:
        file: input file.
        header: header of the file.
        chunks: all chunks of the file, see `read_chunks`.
        warn: callback for warnings.
        first: index of the first chunk to decompress.
        end: index after the last chunk to decompress; None: to the end of the file.

    Raises:
        InputError: the compressed data are damaged.
        MissingExtra: lazrs is not installed.
    """
    end = len(chunks) if end is None else end
    count = sum(chunk.points for chunk in chunks[first:end])
    points = np.empty(count * header.record_bytes, dtype=np.uint8)
    done = _run_worker(points, _job("-", header, first, end), file)
    if done.received < len(points):
        raise _damage_error(f"decompressed only {done.received // header.record_bytes} of {count} points")
    differing, index = count, sum(chunk.points for chunk in chunks[:first])
    if done.code == _EXIT_SOME_DIFFER:
        differing, index = map(int, done.last_error_line.split())
    elif done.code == _EXIT_ALL_DIFFER:
        other = first - 1 if first else end  # another chunk shows whether lazrs reproduces the bytes of this writer
        if other == len(chunks) or _differs(file, header, chunks, other):
            warn(UNVERIFIED)
            return points
    if done.code:
        raise _damage_error(
            f"{differing} of {count} points, from point {index + 1} on, failed verification: encoding them again gives"
            " other bytes"
        )
    return points


def _differs(file: BinaryIO, header: LasHeader, chunks: Sequence[LazChunk], number: int) -> bool:
    """Return whether encoding the points of a chunk again gives other bytes."""
    points = np.empty(chunks[number].points * header.record_bytes, dtype=np.uint8)
    return _run_worker(points, _job("-", header, number, number + 1), file).code != 0


def decompress_files(files: Sequence[tuple[Path, LasHeader]], warn: Warn) -> NDArray[np.uint8]:
    """Decompress all points of several files of one program, which is faster than one file after the other.

    Args:
        files: files and their headers, with records of one size.
        warn: callback for warnings, as in `decompress`.

    Raises:
        InputError: a file is damaged. The message starts with its name.
        MissingExtra: lazrs is not installed.
    """
    record_bytes = files[0][1].record_bytes
    points = np.empty(sum(header.count for _, header in files) * record_bytes, dtype=np.uint8)
    start = 0
    for k in range(0, len(files), _MAX_JOBS):
        batch = files[k : k + _MAX_JOBS]
        jobs: list[str] = []
        for path, header in batch:
            with errors_named(path.name), path.open("rb") as file:
                jobs += _job(str(path.resolve()), header, 0, len(read_chunks(file, header)))
        ends = np.cumsum([header.count * record_bytes for _, header in batch])
        done = _run_worker(points[start : start + int(ends[-1])], jobs)
        what, first = "", done.received
        if done.received < ends[-1]:
            what = "its points cannot be decompressed"
        elif done.code == _EXIT_SOME_DIFFER:
            what = "failed verification: encoding its points again gives other bytes"
            first = int(done.last_error_line.split()[1]) * record_bytes
        elif done.code:
            warn(UNVERIFIED)
        if what:
            raise InputError(f"{batch[int(np.searchsorted(ends, first, side='right'))][0].name}: {_damage_error(what)}")
        start += int(ends[-1])
    return points


def _job(name: str, header: LasHeader, first: int, end: int) -> list[str]:
    """Return the worker's arguments for some chunks of a file."""
    numbers = (header.count, header.record_bytes, first, end)
    return [name, str(header.start), header.records[LASZIP].hex(), *map(str, numbers)]


def _run_worker(points: NDArray[np.uint8], jobs: Sequence[str], stdin: BinaryIO | None = None) -> ChildResult:
    """Decompress chunks into `points` in a child process; if it fails, fewer bytes count as received.

    Raises:
        MissingExtra: lazrs does not load.
    """
    if not sys.executable:
        raise InputError(
            "expected a Python interpreter to decompress LAZ in a child process, got none: convert the file to .las"
        )
    size = len(points)
    done = run_script(
        _WORKER,
        *jobs,
        limits=Limits(seconds=_MAX_WORKER_SECONDS + size / _MIN_WORKER_SPEED, memory=_MAX_WORKER_MEMORY + 2 * size),
        environment={"MALLOC_ARENA_MAX": "4"},  # each arena takes 64 MiB of the allowed address space
        stdin=stdin,
        into=points.data,
    )
    if done.code == 3:
        raise MissingExtra("lazrs", "las", "it is installed but does not load")
    if done.code not in (0, _EXIT_SOME_DIFFER, _EXIT_ALL_DIFFER) and done.received == size:
        return replace(done, received=max(size - 1, 0))
    return done


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
