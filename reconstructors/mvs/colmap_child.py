"""COLMAP's dense stereo in a separate process.

`colmap_child probe` exits with code 0 if it can run, otherwise it prints why not. `colmap_child match WORKSPACE
ITERATIONS` computes the maps of a dense workspace.
"""

from __future__ import annotations

import ctypes
import sys
from pathlib import Path

from reconstructors.sfm.log import log_without_files


def missing_requirement() -> str | None:
    """Return what is missing to run on a GPU, None if nothing is.

    The driver is queried first: importing pycolmap is safe, but its CUDA code may crash without a GPU.
    """
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
    """Run COLMAP's dense stereo in a workspace."""
    import pycolmap

    options = pycolmap.PatchMatchOptions()
    options.num_iterations = iterations
    options.geom_consistency = True
    options.cache_size = 4.0
    pycolmap.patch_match_stereo(workspace, options=options)


def main(arguments: list[str]) -> int:
    """Run a subcommand; return the exit code."""
    if (problem := missing_requirement()) is not None:
        print(problem, file=sys.stderr)
        return 1
    if arguments[0] == "match":
        log_without_files()
        match(Path(arguments[1]), int(arguments[2]))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
