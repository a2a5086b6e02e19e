"""Decompress chunks of LAZ in a child process to standard output.

Usage: `laz_worker.py (FILE START LASZIP COUNT BYTES FIRST END)...`, for the chunks FIRST to END - 1 of each FILE, which
has COUNT points; the file - is standard input.

lazrs trusts the sizes in a file; on damaged data it may request 55 GB and abort. LAZ also lacks a checksum: damaged
bytes in the middle may decode to other times or colours. Since encoding is deterministic, the decoded points are
encoded again and compared with the file.

`pcbench.io.laz` runs this script: without pcbench and numpy it starts in 25 ms. Exit status: 0; 3 if lazrs does not
load; 4 if the encoding of some points differs (their count and the index of the first one go to standard error: its
index in a single file, or among the points of several files); 5 if that of all points differs; any other value if the
data are damaged.
"""

import io
import sys

_MAX_BATCH_BYTES = 32 << 20  # decompressed at a time: enough chunks to occupy all cores


def main(*arguments: str) -> None:
    """Decompress and verify the points of some chunks of each file."""
    import lazrs

    damaged: list[tuple[int, int]] = []  # first point and point count of each damaged chunk
    wanted = 0
    for k in range(0, len(arguments), 7):
        name, start, laszip, *numbers = arguments[k : k + 7]
        count, record_bytes, first, end = map(int, numbers)
        with open(0 if name == "-" else name, "rb") as file:  # noqa: PTH123
            file.seek(int(start))
            table = clip_chunks(lazrs.read_chunk_table(file, lazrs.LazVlr(bytes.fromhex(laszip))), count)
            before = wanted + sum(points for points, _ in table[:first])
            file.seek(int(start) + 8 + sum(size for _, size in table[:first]))  # 8: pointer to the chunk table
            found = _decompress(file, bytes.fromhex(laszip), record_bytes, table[first:end])
            damaged += [(before + index, points) for index, points in found]
            wanted += sum(points for points, _ in table[first:end])
    sys.stdout.buffer.flush()
    number = sum(points for _, points in damaged)
    if number == wanted:
        sys.exit(5)
    if damaged:
        print(number, damaged[0][0], file=sys.stderr)
        sys.exit(4)


def _decompress(
    source: io.BufferedReader, laszip: bytes, record_bytes: int, chunks: list[tuple[int, int]]
) -> list[tuple[int, int]]:
    """Write the points of chunks from the current position; return the first point and point count of damaged ones."""
    import lazrs

    vlr = lazrs.LazVlr(laszip)
    damaged, index = [], 0
    while chunks:
        batch = _take_batch(chunks, record_bytes)
        compressed = source.read(sum(size for _, size in batch))
        points_bytes = bytearray(sum(points for points, _ in batch) * record_bytes)
        lazrs.decompress_points_with_chunk_table(compressed, laszip, points_bytes, batch)
        sys.stdout.buffer.write(points_bytes)
        offset = 0
        encoded = _encode(points_bytes, [points * record_bytes for points, _ in batch], vlr)
        for (points, size), encoded_chunk in zip(batch, encoded, strict=True):
            if compressed[offset : offset + size] != encoded_chunk:
                damaged.append((index, points))
            offset, index = offset + size, index + points
    return damaged


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


def _encode(points: bytearray, sizes: list[int], vlr: "lazrs.LazVlr") -> list[bytes]:
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
    try:
        import lazrs
    except ImportError:
        sys.exit(3)
    main(*sys.argv[1:])
