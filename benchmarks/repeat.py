"""Are reconstructions reproducible? python benchmarks/repeat.py [METHOD ...] [--scene FOLDER] [--runs 3]

Runs `sfm`, `mvs` and `splat` with small settings in new workspaces, on one CPU and on all, with few threads and many,
and next to busy processes. Prints one row per run with the SHA-256 of its cloud; exits with code 1 if clouds differ.
"""

import argparse
import sys
import tempfile
from pathlib import Path

from measure import setting

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

import textured_corner as corner
from repeats import CONDITIONS, FAST_SETTINGS, repeat


def main() -> int:
    """Run the methods and compare their clouds."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument(
        "methods", nargs="*", default=list(FAST_SETTINGS), metavar="METHOD", help=", ".join(FAST_SETTINGS)
    )
    parser.add_argument("--scene", type=Path, help="photographs; default: nine rendered ones of a textured corner")
    parser.add_argument("--runs", type=int, default=len(CONDITIONS))
    options = parser.parse_args()
    if unknown := [method for method in options.methods if method not in FAST_SETTINGS]:
        parser.error(f"unknown method {unknown[0]!r}: expected some of {', '.join(FAST_SETTINGS)}")
    print(setting())
    print(f"{'':7}{'CPUs':>5}{'threads':>8}{'busy':>5}{'points':>9}  sha256 of the cloud")
    reproducible = True
    with tempfile.TemporaryDirectory() as folder:
        scene = options.scene
        if scene is None:
            (corner_folder := Path(folder) / "corner").mkdir()
            scene = corner.write_scene(corner_folder, corner.cameras(9, corner.standard_intrinsics(320, 240)))
        for method in options.methods:
            hashes = set()
            for number in range(options.runs):
                conditions = CONDITIONS[number % len(CONDITIONS)]
                output = repeat(method, scene, Path(folder) / f"{method}-{number}", conditions)
                hashes.add(output.sha256)
                row = f"{method:7}{conditions.cpus:5}{conditions.threads:8}{conditions.busy:5}{output.points:9,}"
                print(f"{row}  {output.sha256}", flush=True)
            reproducible &= len(hashes) == 1
    print("all clouds of each method are equal" if reproducible else "clouds differ")
    return 0 if reproducible else 1


if __name__ == "__main__":
    sys.exit(main())
