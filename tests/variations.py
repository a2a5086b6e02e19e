"""Run parts of the test suite as on other machines: `python tests/variations.py [NAME ...]`, all variations by default.

Each variation runs only the tests that depend on it, so all of them take a few minutes on two cores.
"""

import os
import subprocess
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

from optional import break_system_libraries

ROOT = Path(__file__).parents[1]

KERNELS = (
    "tests/geometry/test_neighbors.py",
    "tests/geometry/test_normals.py",
    "tests/measure/test_metrics.py",
    "tests/registration/test_icp.py",
    "tests/reconstructors/mvs/test_patchmatch.py",
    "tests/reconstructors/splat/test_rasterize.py",
    "tests/reconstructors/splat/test_twins.py",
    "tests/reconstructors/field/test_gradients.py",
)
TOLERANCES = (
    "tests/deformation/test_polynomials.py",
    "tests/geometry/test_cameras.py",
    "tests/geometry/test_transform.py",
    "tests/measure/test_images.py",
    "tests/registration/test_weighted_pairs.py",
    "tests/reconstructors/splat/test_maths.py",
    "tests/reconstructors/splat/test_reference.py",
    "tests/scenes/test_camera_formats.py",
)
OPTIONAL = (
    "tests/geometry/test_cloud.py",
    "tests/geometry/test_poisson.py",
    "tests/io/test_io_pcd.py",
    "tests/measure/test_deviation.py",
    "tests/measure/test_presets.py",
    "tests/report/test_plot.py",
    "tests/scenes/test_pictures.py",
    "tests/scenes/test_synthetic_files.py",
    "tests/studies/bench/test_demo.py",
)
# Make numpy, torch, MKL and the C library choose their kernels as on a processor without AVX2 and FMA.
OLDER_PROCESSOR = {
    "NPY_DISABLE_CPU_FEATURES": "AVX2 FMA3",
    "ATEN_CPU_CAPABILITY": "default",
    "MKL_ENABLE_INSTRUCTIONS": "SSE4_2",
    "GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX2,-FMA,-AVX2_Usable,-FMA_Usable",
}


class Variation(NamedTuple):
    """Additional environment variables, and the tests to run with them."""

    environment: dict[str, str]
    tests: tuple[str, ...]


def variations(folder: Path) -> dict[str, Variation]:
    return {
        "baseline": Variation({"PCBENCH_ISA": "baseline", "OMP_NUM_THREADS": "1"}, KERNELS),
        "avx2": Variation({"PCBENCH_ISA": "avx2", "OMP_NUM_THREADS": "7"}, KERNELS),
        "older-processor": Variation(OLDER_PROCESSOR, TOLERANCES),
        "no-system-libraries": Variation(break_system_libraries(folder), OPTIONAL),
    }


def is_supported(environment: dict[str, str]) -> bool:
    """Whether this processor has the instruction set of a variation; other failures are left to the tests."""
    if environment.get("PCBENCH_ISA") not in ("avx2", "avx512"):
        return True
    command = [sys.executable, "-c", "import pcbench.native"]
    return subprocess.run(command, env=os.environ | environment, capture_output=True).returncode == 0


def main(names: list[str], seed: int) -> int:
    failed_names = []
    with TemporaryDirectory() as folder:
        all_variations = variations(Path(folder))
        if unknown := set(names) - set(all_variations):
            sys.exit(f"expected variations among {', '.join(all_variations)}, got {', '.join(sorted(unknown))}")
        for name in names or all_variations:
            environment, tests = all_variations[name]
            print(
                f"-- {name}: --shuffle={seed} {' '.join(f'{key}={value!r}' for key, value in environment.items())}",
                flush=True,
            )
            if not is_supported(environment):
                print("skipped: this processor lacks the instruction set")
                continue
            # Report failures only.
            command = [sys.executable, "-m", "pytest", "-n", "2", "-q", "-r", "fE", f"--shuffle={seed}", *tests]
            if subprocess.run(command, cwd=ROOT, env=os.environ | environment).returncode:
                failed_names.append(name)
    return print(f"failed: {', '.join(failed_names)}") or 1 if failed_names else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:], int(time.time())))
