"""COLMAP's dense stereo in a process of its own: `colmap_child probe` ends with code 0 where it can run, else it says
why not; `colmap_child match WORKSPACE ITERATIONS` makes the maps of a dense workspace.
"""

from __future__ import annotations

import ctypes
import sys
from pathlib import Path


def lacking() -> str | None:
    """What is not there. The driver is asked first: importing pycolmap does no harm, its CUDA code may."""
    import pycolmap

    if not pycolmap.has_cuda:
        return "this pycolmap is built without CUDA"
    try:
        driver = ctypes.CDLL("libcuda.so.1")
    except OSError:
        return "there is no CUDA driver"
    count = ctypes.c_int(0)
    if driver.cuInit(0) or driver.cuDeviceGetCount(ctypes.byref(count)) or not count.value:
        return "there is no GPU"
    return None


def match(workspace: Path, iterations: int) -> None:
    import pycolmap

    options = pycolmap.PatchMatchOptions()
    options.num_iterations = iterations
    options.geom_consistency = True
    options.cache_size = 4.0
    pycolmap.patch_match_stereo(workspace, options=options)


def main(arguments: list[str]) -> int:
    if (why := lacking()) is not None:
        print(why, file=sys.stderr)
        return 1
    if arguments[0] == "match":
        match(Path(arguments[1]), int(arguments[2]))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
