"""Decompress chunks of LAZ in a child process to standard output.

Usage: `laz_worker.py (FILE START LASZIP COUNT BYTES FIRST END)...`, for the chunks FIRST to END - 1 of each FILE, which
has COUNT points of BYTES bytes.

lazrs trusts the sizes in a file; on damaged data it may request 55 GB and abort. `pcbench.io.laz` runs this script:
without pcbench and numpy it starts in 25 ms. Exit status: 0; 3 if lazrs does not load; any other value if the data are
damaged.
"""

import sys

_MAX_BATCH_BYTES = 32 << 20  # decompressed at a time: enough chunks to occupy all cores


def main(*arguments: str) -> None:
    """Decompress some chunks of each file."""
    try:
        import lazrs
    except ImportError:
        sys.exit(3)
    for k in range(0, len(arguments), 7):
        name, start, laszip, *numbers = arguments[k : k + 7]
        count, record_bytes, first, end = map(int, numbers)
        record = bytes.fromhex(laszip)
        with open(name, "rb") as file:  # noqa: PTH123
            file.seek(int(start))
            table = clip_chunks(lazrs.read_chunk_table(file, lazrs.LazVlr(record)), count)
            file.seek(int(start) + 8 + sum(size for _, size in table[:first]))  # 8: pointer to the chunk table
            chunks = table[first:end]
            while chunks:
                batch = _take_batch(chunks, record_bytes)
                compressed = file.read(sum(size for _, size in batch))
                points = bytearray(sum(points for points, _ in batch) * record_bytes)
                lazrs.decompress_points_with_chunk_table(compressed, record, points, batch)
                rest = memoryview(points)
                while rest:  # standard output is not buffered: a signal or a debugger may end a write early
                    rest = rest[sys.stdout.buffer.write(rest) :]


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


if __name__ == "__main__":
    main(*sys.argv[1:])
