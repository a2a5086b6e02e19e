"""Build and run `tests/native/golden`: every compiled kernel on small inputs, with a hash of each result.

After a change of the kernels, `python tests/golden_kernels.py > tests/native/golden/hashes.txt` renews the hashes.
"""

import os
import platform
import shutil
import subprocess
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from repository import ROOT

GOLDEN = ROOT / "tests" / "native" / "golden"
HASHES = GOLDEN / "hashes.txt"
NATIVE = ROOT / "pcbench" / "native"
_PATCHMATCH = ROOT / "reconstructors" / "mvs" / "native"
_SPLAT = ROOT / "reconstructors" / "splat"
# The flags of CMakeLists.txt.
_FLAGS = ["-std=c++17", "-O3", "-ffp-contract=off", "-Wall", "-Wextra", "-fopenmp", f"-I{NATIVE}", f"-I{GOLDEN}"]
_INSTRUCTIONS = {
    "baseline": [],
    "avx2": ["-mavx2", "-mfma", "-mbmi", "-mbmi2", "-mpopcnt"],
    "avx512": ["-mavx512f", "-mavx512dq", "-mavx512bw", "-mavx512vl", "-mbmi", "-mbmi2", "-mpopcnt"],
}
COMPILER = shutil.which(os.environ.get("CXX", "c++"))
ARM_COMPILER = shutil.which("aarch64-linux-gnu-g++")
ARM_EMULATOR = shutil.which("qemu-aarch64")


def build(compiler: str, folder: Path, *, x86: bool) -> Path:
    """Build the program. For another processor it is linked statically, since its libraries are not installed."""
    kernels = {NATIVE / "points": [], _PATCHMATCH: [_PATCHMATCH], _SPLAT / "cpu": [_SPLAT, _SPLAT / "cpu"]}
    units = [(GOLDEN / f"{name}.cpp", []) for name in ("main", "points", "mesh", "pairs")]
    units += [(GOLDEN / "patchmatch.cpp", [_PATCHMATCH]), (GOLDEN / "splats.cpp", [_SPLAT, _SPLAT / "cpu"])]
    units += [(NATIVE / "common" / "interrupt.cpp", []), (NATIVE / "points" / "dispatch.cpp", [])]
    units += [(_SPLAT / "cpu" / "rasterizer.cpp", [_SPLAT, _SPLAT / "cpu"])]
    commands = [(source, includes, []) for source, includes in units]
    for isa in _INSTRUCTIONS if x86 else ["baseline"]:
        flags = ["-fno-exceptions", "-w", *_INSTRUCTIONS[isa]]
        commands += [
            (source_folder / f"kernels_{isa}.cpp", includes, flags) for source_folder, includes in kernels.items()
        ]

    def compile_unit(indexed_command):
        index, (source, includes, flags) = indexed_command
        object_file = folder / f"{index}.o"
        paths = [f"-I{path}" for path in includes]
        defines = ["-DPCB_X86"] if x86 else []
        _check([compiler, *_FLAGS, *defines, *paths, *flags, "-c", source, "-o", object_file])
        return object_file

    with ThreadPoolExecutor(2) as pool:
        objects = list(pool.map(compile_unit, enumerate(commands)))
    program = folder / "golden"
    _check([compiler, "-fopenmp", *([] if compiler == COMPILER else ["-static"]), *objects, "-o", program])
    return program


def hashes(program: Path, *, isa: str = "baseline", emulator: str | None = None) -> dict[str, str]:
    """Run the program and return the hash of each result by name."""
    command = [program] if emulator is None else [emulator, program]
    environment = {**os.environ, "PCBENCH_ISA": isa, "OMP_NUM_THREADS": "2"}
    output = subprocess.run(command, capture_output=True, text=True, check=True, env=environment).stdout
    return parse_hashes(output)


def parse_hashes(text: str) -> dict[str, str]:
    """Parse lines of `name hash`; lines that begin with # are comments."""
    return dict(line.split(maxsplit=1) for line in text.splitlines() if not line.startswith("#"))


def is_supported(isa: str) -> bool:
    """Whether this processor supports an x86 instruction set."""
    flags = set(Path("/proc/cpuinfo").read_text().split()) if Path("/proc/cpuinfo").exists() else set()
    required = {
        "baseline": set(),
        "avx2": {"avx2", "fma", "bmi2"},
        "avx512": {"avx512f", "avx512dq", "avx512bw", "avx512vl"},
    }
    return required[isa] <= flags


def is_x86() -> bool:
    return platform.machine() in ("x86_64", "AMD64")


def _check(command: list) -> None:
    process = subprocess.run(command, capture_output=True, text=True)
    assert process.returncode == 0, process.stderr


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as temporary:
        assert COMPILER is not None
        for name, value in hashes(build(COMPILER, Path(temporary), x86=is_x86())).items():
            print(name, value)
