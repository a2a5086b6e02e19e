"""The compressed points of LAZ and COPC files, through lazrs.

LAZ has no checksums, and lazrs decodes damaged bytes to whatever they mean. What was decoded is therefore encoded
again: LASzip and lazrs write the same bytes for the same points, so that other bytes are damage, or another program's.

Martin Isenburg, "LASzip: lossless compression of LiDAR data", Photogrammetric Engineering & Remote Sensing, 2013.
"""

from __future__ import annotations

import struct
import sys
from io import BytesIO
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from pcbench.children import Limits, run_script
from pcbench.errors import InputError, MissingExtra
from pcbench.extras import require
from pcbench.io.files import Warn
from pcbench.io.las_header import LasHeader

LASZIP = ("laszip encoded", 22204)
_LASZIP_LAYOUT = struct.Struct("<HHBBHIIqqH")  # compressor, coder, version (3), options, chunk size, 2 counts, items
_ITEM_LAYOUT = struct.Struct("<HHH")  # type, bytes, version
_VARIABLE_CHUNKS = 0xFFFFFFFF  # COPC: the chunk table tells how many points a chunk has

# A file may grow so many times when unpacked: real clouds shrink 3 to 20 times, a bare grid a few hundred times.
_MAX_GROWTH, _MAX_FREE_GROWTH_BYTES = 1000, 256 << 20
_EXIT_SOME_DIFFER, _EXIT_ALL_DIFFER = 4, 5  # exit statuses of the worker: points that encode to other bytes
_WORKER = str(Path(__file__).with_name("laz_worker.py"))
_MAX_WORKER_MEMORY = 1 << 30  # bytes of address space, beside twice the points: code, stacks, one heap a thread
_MAX_WORKER_SECONDS = 30.0  # and what it takes for the points at this speed at least:
_MIN_WORKER_SPEED = 1e6  # bytes a second, where lazrs does 30 million on one core, both ways


def decompress(file: BinaryIO, header: LasHeader, warn: Warn) -> NDArray[np.uint8]:
    """The point records as they would stand in a LAS file, (count * record_bytes,).

    A warning says where nothing vouches for them: no chunk of them, encoded again, gives the bytes in the file. Where
    some chunks do, one program wrote all, and the others are damaged.

    Raises:
        InputError: the compressed data are damaged.
        MissingExtra: lazrs is not installed.
    """
    require("lazrs")
    _check_chunks(file, header)
    if not sys.executable:
        raise InputError(
            "LAZ is unpacked by a Python process of its own, and this program names no Python: write a .las"
        )
    total = header.count * header.record_bytes
    points = np.empty(total, dtype=np.uint8)
    done = run_script(
        _WORKER,
        str(header.start),
        header.records[LASZIP].hex(),
        str(header.count),
        str(header.record_bytes),
        limits=Limits(seconds=_MAX_WORKER_SECONDS + total / _MIN_WORKER_SPEED, memory=_MAX_WORKER_MEMORY + 2 * total),
        environment={"MALLOC_ARENA_MAX": "4"},  # each arena takes 64 MiB of the address space allowed
        stdin=file,
        into=points.data,
    )
    if done.code == 3:
        raise MissingExtra("lazrs", "las", "it is installed but does not load")
    if done.code == _EXIT_SOME_DIFFER and done.received == total and len(words := done.last_words.split()) == 2:
        raise _damage_error(
            f"{words[0]} of {header.count} points, from point {int(words[1]) + 1} on, do not encode to the bytes that"
            " they were decoded from"
        )
    if done.code == _EXIT_ALL_DIFFER and done.received == total:
        warn(
            "the compressed points are damaged, or were written by another program than LASzip and lazrs: encoded again"
            " they give other bytes, so nothing vouches for them"
        )
    elif done.code or done.received < total:
        raise _damage_error(f"{done.received // header.record_bytes} of {header.count} points could be decompressed")
    return points


def _damage_error(reason: str) -> InputError:
    return InputError(f"damaged LAZ data: {reason}: copy or export the file again")


def _check_chunks(file: BinaryIO, header: LasHeader) -> None:
    """The LASzip record and the place and length of the chunk table, which stands behind the points."""
    record = header.records.get(LASZIP, b"")
    if len(record) < _LASZIP_LAYOUT.size:
        raise _damage_error("the header has no LASzip record")
    compressor, *_, chunk_size, _, _, items = _LASZIP_LAYOUT.unpack_from(record)
    if compressor not in (2, 3):
        raise InputError(f"expected LASzip compressor 2 or 3 (in chunks), got {compressor}: compress the file again")
    if len(record) < _LASZIP_LAYOUT.size + items * _ITEM_LAYOUT.size:
        raise _damage_error("the LASzip record is not complete")
    item_bytes = sum(_ITEM_LAYOUT.unpack_from(record, _LASZIP_LAYOUT.size + k * _ITEM_LAYOUT.size)[1] for k in range(items))
    if item_bytes != header.record_bytes:
        raise _damage_error(f"its LASzip record has {item_bytes} bytes a point, the header {header.record_bytes}")

    size = file.seek(0, 2)
    table = _read_integer(file, header.start, "<q")
    if table == -1:  # written as a stream: the place stands at the very end
        table = _read_integer(file, size - 8, "<q")
    if not header.start + 8 <= table <= size - 8:
        raise InputError(
            f"truncated LAZ data: the chunk table should stand at byte {table}, the file has {size}:"
            " copy or export the file again"
        )
    chunks = _read_integer(file, table + 4, "<I")
    if chunks * header.record_bytes > table - header.start - 8:  # each chunk starts with a point as it is
        raise _damage_error(f"{chunks} chunks do not fit into {table - header.start - 8} bytes")
    if chunk_size != _VARIABLE_CHUNKS and header.count > chunks * chunk_size:
        raise _damage_error(f"{chunks} chunks of {chunk_size} points cannot hold {header.count} points")
    unpacked = header.count * header.record_bytes
    if unpacked > _MAX_FREE_GROWTH_BYTES + _MAX_GROWTH * size:
        raise _damage_error(f"{size} bytes would unpack to {unpacked}")


def _read_integer(file: BinaryIO, offset: int, code: str) -> int:
    layout = struct.Struct(code)
    file.seek(max(offset, 0))
    data = file.read(layout.size)
    if len(data) < layout.size:
        raise InputError("truncated LAZ data: the file ends before its points: copy or export the file again")
    return int(layout.unpack(data)[0])


def laszip_record(point_format: int, extra_bytes: int) -> bytes:
    """The LASzip record for new files."""
    lazrs = require("lazrs")
    return bytes(lazrs.LazVlr.new_for_compression(point_format, extra_bytes).record_data())


def compress(points: memoryview, laszip: bytes, start: int) -> memoryview:
    """Point records as they stand in a LAZ file from its byte `start`.

    In memory, not into the file: lazrs would turn "No space left on device" into an error of its own.
    """
    import lazrs

    buffer = BytesIO(bytes(start))  # the chunk table's place is counted from the start of the file
    buffer.seek(start)
    compressor = lazrs.ParLasZipCompressor(buffer, lazrs.LazVlr(laszip))
    compressor.compress_many(points)
    compressor.done()
    return buffer.getbuffer()[start:]
