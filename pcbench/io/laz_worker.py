"""Decompresses LAZ in a process of its own: the file is standard input, the points go to standard output.

lazrs believes what a file says, and on damaged data may ask for 55 GB and abort. Run by `pcbench.io.laz`, never
imported: a script that needs neither pcbench nor numpy starts in 25 ms. The exit status is 0, 3 where lazrs does not
load, or anything else where the data are damaged.
"""

import json
import resource
import sys

_PIECE = 32 << 20  # bytes decompressed at a time: enough chunks to occupy all cores


def main() -> None:
    job = json.loads(sys.argv[1])
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    _, hard = resource.getrlimit(resource.RLIMIT_AS)
    limit = job["memory"] if hard == resource.RLIM_INFINITY else min(job["memory"], hard)
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    sys.path[:] = job["sys_path"]
    try:
        import lazrs
    except ImportError:
        sys.exit(3)

    source, target = sys.stdin.buffer, sys.stdout.buffer
    source.seek(job["start"])
    decompressor = lazrs.ParLasZipDecompressor(source, bytes.fromhex(job["laszip"]))
    step = max(1, _PIECE // job["record_bytes"])
    for first in range(0, job["count"], step):
        piece = bytearray(min(step, job["count"] - first) * job["record_bytes"])
        decompressor.decompress_many(piece)
        target.write(piece)
    target.flush()


if __name__ == "__main__":
    main()
