"""Decompresses LAZ in a process of its own: `laz_worker.py START LASZIP COUNT BYTES`; the file is standard input, the
points go to standard output.

lazrs believes what a file says, and on damaged data may ask for 55 GB and abort. Run by `pcbench.io.laz`, never
imported: a script that needs neither pcbench nor numpy starts in 25 ms. The exit status is 0, 3 where lazrs does not
load, or anything else where the data are damaged.
"""

import sys

_MAX_PIECE = 32 << 20  # bytes decompressed at a time: enough chunks to occupy all cores


def main(start: int, laszip: bytes, count: int, record_bytes: int) -> None:
    try:
        import lazrs
    except ImportError:
        sys.exit(3)

    source, target = sys.stdin.buffer, sys.stdout.buffer
    source.seek(start)
    decompressor = lazrs.ParLasZipDecompressor(source, laszip)
    step = max(1, _MAX_PIECE // record_bytes)
    for first in range(0, count, step):
        piece = bytearray(min(step, count - first) * record_bytes)
        decompressor.decompress_many(piece)
        target.write(piece)
    target.flush()


if __name__ == "__main__":
    main(int(sys.argv[1]), bytes.fromhex(sys.argv[2]), int(sys.argv[3]), int(sys.argv[4]))
