"""Decompress chunks of LAZ in a child process, from standard input to standard output.

Usage: `laz_worker.py START LASZIP COUNT BYTES FIRST END`, for the chunks FIRST to END - 1 of a file with COUNT points.

lazrs trusts the sizes in a file; on damaged data it may request 55 GB and abort. LAZ also lacks a checksum: damaged
bytes in the middle may decode to other times or colours. Since encoding is deterministic, the decoded points are
encoded again and compared with the file.

`pcbench.io.laz` runs this script: without pcbench and numpy it starts in 25 ms. Exit status: 0; 3 if lazrs does not
load; 4 if the encoding of some points differs (their count and the index of the first one in the file go to standard
error); 5 if that of all points differs; any other value if the data are damaged.
"""

import io
import sys

_MAX_BATCH_BYTES = 32 << 20  # decompressed at a time: enough chunks to occupy all cores


def main(start: int, laszip: bytes, count: int, record_bytes: int, first: int, end: int) -> None:
    """Decompress and verify the points of some chunks of a LAZ file."""
    try:
        import lazrs
    except ImportError:
        sys.exit(3)

    source, target = sys.stdin.buffer, sys.stdout.buffer
    source.seek(start)
    vlr = lazrs.LazVlr(laszip)
    table = clip_chunks(lazrs.read_chunk_table(source, vlr), count)
    chunks = table[first:end]
    index = sum(points for points, _ in table[:first])  # of the next point
    source.seek(start + 8 + sum(size for _, size in table[:first]))  # 8: pointer to the chunk table
    wanted = sum(points for points, _ in chunks)
    damaged: list[tuple[int, int]] = []  # first point and point count of each damaged chunk
    while chunks:
        batch = _take_batch(chunks, record_bytes)
        compressed = source.read(sum(size for _, size in batch))
        points_bytes = bytearray(sum(points for points, _ in batch) * record_bytes)
        lazrs.decompress_points_with_chunk_table(compressed, laszip, points_bytes, batch)
        target.write(points_bytes)
        offset = 0
        encoded = _encode(points_bytes, [points * record_bytes for points, _ in batch], vlr)
        for (points, size), encoded_chunk in zip(batch, encoded, strict=True):
            if compressed[offset : offset + size] != encoded_chunk:
                damaged.append((index, points))
            offset, index = offset + size, index + points
    target.flush()
    number = sum(points for _, points in damaged)
    if number == wanted:
        sys.exit(5)
    if damaged:
        print(number, damaged[0][0], file=sys.stderr)
        sys.exit(4)


def clip_chunks(table: list[tuple[int, int]], count: int) -> list[tuple[int, int]]:
    """Return the point count and compressed size in bytes of each chunk that contains some of the `count` points.

    If all chunks have the same point count, the table states it for the last one too, which is rarely full.

    Raises:
        ValueError: the chunks contain fewer points.
    """
    chunks = []
    for points, size in table:
        if count and points:
            chunks.append((min(points, count), size))
            count -= chunks[-1][0]
    if count:
        raise ValueError("the chunks contain too few points")
    return chunks


def _take_batch(chunks: list[tuple[int, int]], record_bytes: int) -> list[tuple[int, int]]:
    """Remove the next chunks to decompress together from the front of `chunks`, and return them."""
    number, room = 0, _MAX_BATCH_BYTES
    while number < len(chunks) and (not number or chunks[number][0] * record_bytes <= room):
        room -= chunks[number][0] * record_bytes
        number += 1
    batch, chunks[:number] = chunks[:number], []
    return batch


def _encode(points: bytearray, sizes: list[int], vlr: "lazrs.LazVlr") -> list[bytes]:  # type: ignore[name-defined]  # noqa: F821
    """Compress each chunk of `sizes` bytes of points."""
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
    except lazrs.LazrsError:  # an old encoding that lazrs can read but not write
        return [b""] * len(sizes)
    data, offset, result = buffer.getbuffer(), 8, []
    for _, size in table:
        result.append(bytes(data[offset : offset + size]))
        offset += size
    return result


if __name__ == "__main__":
    main(int(sys.argv[1]), bytes.fromhex(sys.argv[2]), *map(int, sys.argv[3:]))
