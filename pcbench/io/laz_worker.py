"""Decompresses LAZ in a process of its own: `laz_worker.py START LASZIP COUNT BYTES`; the file is standard input, the
points go to standard output.

lazrs believes what a file says, and on damaged data may ask for 55 GB and abort. Nor has LAZ a checksum: bytes damaged
in the middle may decode, to other times or colours. But the encoding of given points is always the same, so they are
encoded again and compared with the file.

Run by `pcbench.io.laz`, never imported: a script that needs neither pcbench nor numpy starts in 25 ms. The exit status
is 0, 3 where lazrs does not load, 4 where some of the points encode to other bytes (their number, and that of the first
of them, stand on standard error), 5 where all of them do, or anything else where the data are damaged.
"""

import io
import os
import sys

_MAX_BATCH_BYTES = 32 << 20  # bytes decompressed at a time: enough chunks to occupy all cores


def main(start: int, laszip: bytes, count: int, record_bytes: int) -> None:
    try:
        import lazrs
    except ImportError:
        sys.exit(3)

    source, target = sys.stdin.buffer, sys.stdout.buffer
    source.seek(start)
    vlr = lazrs.LazVlr(laszip)
    chunks = _clip_chunks(lazrs.read_chunk_table(source, vlr), count)
    source.seek(start)
    decompressor = lazrs.ParLasZipDecompressor(source, laszip)
    offset, first = start + 8, 0  # in the file, behind where its chunk table is; among the points
    damaged: list[tuple[int, int]] = []  # first point and number of the points of a chunk
    while chunks:
        batch = _take_batch(chunks, record_bytes)
        points_bytes = bytearray(sum(points for points, _ in batch) * record_bytes)
        decompressor.decompress_many(points_bytes)
        target.write(points_bytes)
        encoded = _encode(points_bytes, [points * record_bytes for points, _ in batch], vlr)
        for (points, size), encoded_chunk in zip(batch, encoded, strict=True):
            if os.pread(source.fileno(), size, offset) != encoded_chunk:
                damaged.append((first, points))
            offset, first = offset + size, first + points
    target.flush()
    number = sum(points for _, points in damaged)
    if number == count:
        sys.exit(5)
    if damaged:
        print(number, damaged[0][0], file=sys.stderr)
        sys.exit(4)


def _clip_chunks(table: list[tuple[int, int]], count: int) -> list[tuple[int, int]]:
    """Number of points and compressed bytes of each chunk that holds some of the `count` points.

    Where all chunks have one size, the last one is rarely full.
    """
    chunks = []
    for points, size in table:
        if count and points:
            chunks.append((min(points, count), size))
            count -= chunks[-1][0]
    if count:
        sys.exit("the chunks hold too few points")
    return chunks


def _take_batch(chunks: list[tuple[int, int]], record_bytes: int) -> list[tuple[int, int]]:
    """The next chunks to be decompressed together, taken from the front of `chunks`."""
    number, room = 0, _MAX_BATCH_BYTES
    while number < len(chunks) and (not number or chunks[number][0] * record_bytes <= room):
        room -= chunks[number][0] * record_bytes
        number += 1
    batch, chunks[:number] = chunks[:number], []
    return batch


def _encode(points: bytearray, sizes: list[int], vlr: "lazrs.LazVlr") -> list[bytes]:  # type: ignore[name-defined]  # noqa: F821
    """Each chunk, of so many bytes of points, compressed."""
    import lazrs

    buffer = io.BytesIO()
    try:
        compressor = lazrs.ParLasZipCompressor(buffer, vlr)
        if vlr.uses_variable_size_chunks():
            view, ends = memoryview(points), [sum(sizes[: k + 1]) for k in range(len(sizes))]
            compressor.compress_chunks([view[end - size : end] for end, size in zip(ends, sizes, strict=True)])
        else:
            compressor.compress_many(points)
        compressor.done()
        buffer.seek(0)
        table = lazrs.read_chunk_table(buffer, vlr)
    except lazrs.LazrsError:  # an old encoding that is only read
        return [b""] * len(sizes)
    data, offset, result = buffer.getbuffer(), 8, []
    for _, size in table:
        result.append(bytes(data[offset : offset + size]))
        offset += size
    return result


if __name__ == "__main__":
    main(int(sys.argv[1]), bytes.fromhex(sys.argv[2]), int(sys.argv[3]), int(sys.argv[4]))
