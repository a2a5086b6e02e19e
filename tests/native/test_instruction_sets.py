"""Loops compiled once per instruction set give the same bits, and their units are not mixed by the linker."""

import json
import os
import platform
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from kernel_scripts import run_script
from repository import ROOT, TESTS

NATIVE = ROOT / "pcbench" / "native"
# The flags of CMakeLists.txt, which also has -fno-exceptions.
FLAGS = {
    "baseline": [],
    "avx2": ["-mavx2", "-mfma", "-mbmi", "-mbmi2", "-mpopcnt"],
    "avx512": ["-mavx512f", "-mavx512dq", "-mavx512bw", "-mavx512vl", "-mbmi", "-mbmi2", "-mpopcnt"],
}
COMPILER = shutil.which(os.environ.get("CXX", "c++"))


RECONSTRUCTORS = ROOT / "reconstructors"
# Folders and the namespaces of their loops.
NAMESPACES = {
    NATIVE / "points": "pcbench",
    RECONSTRUCTORS / "mvs" / "native": "pcbench::mvs",
    RECONSTRUCTORS / "splat" / "cpu": "pcbench::splat",
    RECONSTRUCTORS / "field" / "native": "pcbench::field",
}
IDS = ["points", "patchmatch", "rasterizer", "field"]
for_all_loops = pytest.mark.parametrize("folder", NAMESPACES, ids=IDS)
# AVX2 is compiled for two folders, which include all headers of vectors: only these distinguish it from AVX-512.
UNITS = [
    pytest.param(
        folder, isa, id=f"{name}-{isa}", marks=[] if isa == "avx512" or name == "points" else [pytest.mark.long]
    )
    for folder, name in zip(NAMESPACES, IDS, strict=True)
    for isa in FLAGS
    if isa != "avx2" or name in ("points", "patchmatch")
]


def compile_unit(folder, isa, *flags, out: Path):
    return subprocess.run(
        [
            COMPILER,
            "-std=c++17",
            "-fPIC",
            "-fopenmp",
            "-fno-exceptions",
            "-w",
            f"-I{NATIVE}",
            f"-I{folder}",
            f"-I{folder.parent}",
        ]
        + [*flags, "-c", str(folder / f"kernels_{isa}.cpp"), "-o", str(out)],
        capture_output=True,
        text=True,
    )


@pytest.mark.skipif(COMPILER is None or shutil.which("nm") is None, reason="needs a C++ compiler and nm")
@pytest.mark.skipif(os.uname().machine != "x86_64", reason="one instruction set only on this machine")
@pytest.mark.parametrize(("folder", "isa"), UNITS)
def test_weak_symbols_name_their_instruction_set(folder, isa, tmp_path):
    """The linker keeps one of several weak symbols of a name: a copy for AVX-512 would crash a machine without it.

    Without optimisation, every inline function and template that a compiler might emit appears in the object. Each
    must name its instruction set, also those of the standard library, which is therefore hardly used there.
    """
    compilation = compile_unit(folder, isa, "-O0", *FLAGS[isa], out=tmp_path / "unit.o")
    assert compilation.returncode == 0, compilation.stderr
    listing = subprocess.run(
        ["nm", "--demangle", "--defined-only", str(tmp_path / "unit.o")], capture_output=True, text=True
    )
    assert listing.returncode == 0, listing.stderr
    symbols = [line.split(maxsplit=2)[1:] for line in listing.stdout.splitlines()]
    weak = [name for kind, name in symbols if kind == "W"]  # functions only: data are the same for all instruction sets
    namespace = f"{NAMESPACES[folder]}::{isa}::"
    assert any(namespace in name for name in weak)  # otherwise the test would be empty
    assert [name for name in weak if namespace not in name] == []


@pytest.mark.skipif(COMPILER is None, reason="needs a C++ compiler")
@pytest.mark.parametrize("isa", ["avx2", "avx512"])
@for_all_loops
def test_a_unit_compiled_without_its_flags_is_refused(folder, isa, tmp_path):
    """Without its flags the unit would be a second baseline under another name."""
    compilation = compile_unit(folder, isa, "-fsyntax-only", out=tmp_path / "unit.o")
    assert compilation.returncode != 0
    assert "must be compiled with" in compilation.stderr


def cpu_flags():
    """CPU flags reported by the operating system; empty if it reports none."""
    info = Path("/proc/cpuinfo")
    lines = [line for line in info.read_text().splitlines() if line.startswith("flags")] if info.exists() else []
    return set(lines[0].split(":")[1].split()) if lines else set()


@pytest.mark.parametrize(
    "isa, flags", [("avx2", {"avx2", "fma"}), ("avx512", {"avx512f", "avx512dq", "avx512bw", "avx512vl"})]
)
def test_supported_instruction_sets_are_used(isa, flags):
    if not flags | {"bmi1", "bmi2", "popcnt"} <= cpu_flags():
        pytest.skip(f"this machine has no {isa}")
    script = "from pcbench.native import _core; print(_core.isa())"
    process = subprocess.run(
        [sys.executable, "-c", script], env={**os.environ, "PCBENCH_ISA": isa}, capture_output=True, text=True
    )
    assert process.stdout == isa + "\n", process.stderr


QUERY_SCRIPT = """
import hashlib, json, sys
import numpy as np
sys.path[:0] = {path!r}
from point_shapes import SHAPES
from pcbench.native import _core
from pcbench.deformation.polynomials import normal_equations
from pcbench.geometry.neighbors import Index, match_both_directions

digest = hashlib.sha256()
for shape in SHAPES:
    rng = np.random.default_rng(1)
    large = shape.__name__ in ("uniform", "clustered", "utm")  # enough for several tasks during construction
    a, b = shape(rng, 40_000 if large else 4_000), shape(rng, 3_000)
    index, axes = Index(a), np.tile([0.6, 0.0, 0.8], (20, 1))
    extent = np.ptp(a, axis=0).max()
    results = [*match_both_directions(index, Index(b)), index.query(b), index.query(b[:20]), index.nearest_other()]
    results += [index.query(b[:500], 7), index.local_planes(8, np.arange(0, len(a), 211))[:2]]
    planes, turn = index.local_planes(8, np.arange(0, len(a), 11)), np.eye(4)[[1, 0, 2, 3]]
    results += [planes[:2], planes.nearest_other, index.nearest_of_moved(Index(b), turn)[1]]
    followed = index.follow(Index(b))
    results += [followed.nearest(np.eye(4) * scale)[1] for scale in (1.01, 1.001, 1.0)]
    results += [index.query_radius(b[:20], 0.01 * extent), index.query_cylinder(b[:20], axes, 0.01 * extent, extent)]
    results += [index.count_near(Index(b), 0.01 * extent * rng.random((len(b), 3)))]
    results += [index.query_index_with_ties(Index(b), slack)[1:] for slack in ((0.01 * extent) ** 2, 1e-8)]
    unit = rng.uniform(-1, 1, (1_003, 3))
    results += [normal_equations(unit, unit[::-1], unit[:, 0], unit[:, 1], np.array([0, 17, 17, 400]))]
    for result in results:
        for array in result:
            digest.update(array.tobytes())
print(json.dumps([_core.isa(), digest.hexdigest()]))
"""


def run_queries(**environment):
    """Run many queries in a fresh process and return its output with a digest of the results."""
    script = QUERY_SCRIPT.format(path=[str(TESTS)])
    return subprocess.run(
        [sys.executable, "-c", script], env={**os.environ, **environment}, capture_output=True, text=True
    )


@pytest.fixture(scope="module")
def baseline_digest():
    process = run_queries(PCBENCH_ISA="baseline", OMP_NUM_THREADS="1")
    assert process.returncode == 0, process.stderr
    isa, digest = json.loads(process.stdout)
    assert isa == "baseline"
    return digest


def test_results_do_not_depend_on_the_number_of_threads(baseline_digest):
    process = run_queries(PCBENCH_ISA="baseline", OMP_NUM_THREADS="3")
    assert json.loads(process.stdout) == ["baseline", baseline_digest]


@pytest.mark.parametrize("isa", ["avx2", "avx512"])
def test_results_do_not_depend_on_the_instruction_set(baseline_digest, isa):
    process = run_queries(PCBENCH_ISA=isa, OMP_NUM_THREADS="2")
    if "error: PCBENCH_ISA: " in process.stderr or "InputError: PCBENCH_ISA: " in process.stderr:
        pytest.skip(f"this machine has no {isa}")
    assert json.loads(process.stdout) == [isa, baseline_digest], process.stderr


# The squared distance of a point from itself or a copy is 0: a key that combines it with a small number is denormal.
FLUSHED_SCRIPT = """
import ctypes
import numpy as np
from pcbench.geometry.neighbors import Index

points = np.random.default_rng(0).random((2000, 3))
points[:300] = points[1000:1300]
expected = [Index(points).query(points, k) for k in (8, 16, 24, 100)]
library, state = ctypes.CDLL("libm.so.6"), (ctypes.c_uint32 * 8)()
library.fegetenv(state)
state[7] |= 0x8040  # MXCSR: results and inputs that are denormal count as zero
library.fesetenv(state)
found = [Index(points).query(points, k) for k in (8, 16, 24, 100)]
print([int((a.indices != b.indices).sum() + (a.distances != b.distances).sum()) for a, b in zip(expected, found)])
"""


@pytest.mark.skipif(
    platform.machine() != "x86_64" or platform.libc_ver()[0] != "glibc", reason="sets the x86-64 state of glibc"
)
@pytest.mark.parametrize("isa", ["baseline", "avx2", "avx512"])
def test_threads_that_flush_denormal_numbers_find_the_same_neighbors(isa):
    """`torch.set_flush_denormal` does so, and libraries linked with -ffast-math. The only thread searches."""
    process = run_script(FLUSHED_SCRIPT, PCBENCH_ISA=isa, OMP_NUM_THREADS="1")
    if "InputError: PCBENCH_ISA: " in process.stderr:
        pytest.skip(f"this machine has no {isa}")
    assert process.stdout == "[0, 0, 0, 0]\n", process.stderr


def test_an_unknown_instruction_set_is_refused():
    process = run_queries(PCBENCH_ISA="sse9")
    assert process.returncode != 0
    assert "PCBENCH_ISA" in process.stderr and "'sse9'" in process.stderr


def test_a_command_reports_an_unknown_instruction_set_in_one_line(tmp_path):
    np.save(tmp_path / "a.npy", np.eye(3))
    command = [sys.executable, "-m", "pcbench.cli", "compare", "a.npy", "a.npy"]
    process = subprocess.run(
        command, cwd=tmp_path, env={**os.environ, "PCBENCH_ISA": "sse9"}, capture_output=True, text=True
    )
    assert process.returncode == 2
    assert process.stderr.count("\n") == 1 and process.stderr.startswith("error: PCBENCH_ISA: ")
