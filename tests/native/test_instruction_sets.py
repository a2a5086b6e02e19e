"""The search loops are compiled once for each instruction set: the same bits from each, and no mixing of them."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from repository import ROOT, TESTS

NATIVE = ROOT / "pcbench" / "native"
# These, and -fno-exceptions, as in CMakeLists.txt.
FLAGS = {
    "baseline": [],
    "avx2": ["-mavx2", "-mfma", "-mbmi", "-mbmi2", "-mpopcnt"],
    "avx512": ["-mavx512f", "-mavx512dq", "-mavx512bw", "-mavx512vl", "-mbmi", "-mbmi2", "-mpopcnt"],
}
COMPILER = shutil.which(os.environ.get("CXX", "c++"))


GUESTS = ROOT / "reconstructors"
# Folders, and the namespaces of their loops.
LOOPS = {
    NATIVE / "points": "pcbench",
    GUESTS / "mvs" / "native": "pcbench::mvs",
    GUESTS / "splat" / "cpu": "pcbench::splat",
}
of_all_loops = pytest.mark.parametrize("folder", LOOPS, ids=["points", "patchmatch", "rasterizer"])


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
@pytest.mark.parametrize("isa", FLAGS)
@of_all_loops
def test_no_symbol_of_an_instruction_set_can_be_taken_for_that_of_another(folder, isa, tmp_path):
    """The linker keeps one of several weak symbols of a name: a copy for AVX-512 would crash a machine without it.

    Compiled without optimisation, when no call is inlined that is not bound to be: every inline function and template
    that any compiler might leave in the object shows. Each must name its instruction set. So must what the standard
    library adds, which is why it is hardly used there.
    """
    built = compile_unit(folder, isa, "-O0", *FLAGS[isa], out=tmp_path / "unit.o")
    assert built.returncode == 0, built.stderr
    listed = subprocess.run(
        ["nm", "--demangle", "--defined-only", str(tmp_path / "unit.o")], capture_output=True, text=True
    )
    assert listed.returncode == 0, listed.stderr
    symbols = [line.split(maxsplit=2)[1:] for line in listed.stdout.splitlines()]
    weak = [name for kind, name in symbols if kind == "W"]  # functions; data are the same for all
    own = f"{LOOPS[folder]}::{isa}::"
    assert any(own in name for name in weak)  # else nothing was looked at
    assert [name for name in weak if own not in name] == []


@pytest.mark.skipif(COMPILER is None, reason="needs a C++ compiler")
@pytest.mark.parametrize("isa", ["avx2", "avx512"])
@of_all_loops
def test_a_unit_compiled_without_its_instructions_is_refused(folder, isa, tmp_path):
    """Without its flags it would be a second baseline under the name of another."""
    built = compile_unit(folder, isa, "-fsyntax-only", out=tmp_path / "unit.o")
    assert built.returncode != 0
    assert "must be compiled with" in built.stderr


def cpu_flags():
    """What the kernel says that this machine can do; none where it does not say."""
    info = Path("/proc/cpuinfo")
    lines = [line for line in info.read_text().splitlines() if line.startswith("flags")] if info.exists() else []
    return set(lines[0].split(":")[1].split()) if lines else set()


@pytest.mark.parametrize(
    "isa, needs", [("avx2", {"avx2", "fma"}), ("avx512", {"avx512f", "avx512dq", "avx512bw", "avx512vl"})]
)
def test_what_this_machine_can_do_is_used(isa, needs):
    if not needs | {"bmi1", "bmi2", "popcnt"} <= cpu_flags():
        pytest.skip(f"this machine has no {isa}")
    script = "from pcbench.native import _core; print(_core.isa())"
    done = subprocess.run(
        [sys.executable, "-c", script], env={**os.environ, "PCBENCH_ISA": isa}, capture_output=True, text=True
    )
    assert done.stdout == isa + "\n", done.stderr


ANSWERS = """
import hashlib, json, sys
import numpy as np
sys.path[:0] = {path!r}
from point_shapes import SHAPES
from pcbench.native import _core
from pcbench.geometry.neighbors import Index, match_both_ways

digest = hashlib.sha256()
for shape in SHAPES:
    rng = np.random.default_rng(1)
    large = shape.__name__ in ("uniform", "clustered", "utm")  # enough for several tasks in the build
    a, b = shape(rng, 40_000 if large else 4_000), shape(rng, 3_000)
    index, axes = Index(a), np.tile([0.6, 0.0, 0.8], (20, 1))
    extent = np.ptp(a, axis=0).max()
    answers = [*match_both_ways(index, Index(b)), index.query(b), index.query(b[:500], 7), index.nearest_other()]
    planes, turn = index.local_planes(8, np.arange(0, len(a), 11)), np.eye(4)[[1, 0, 2, 3]]
    answers += [planes[:2], planes.nearest_other, index.nearest_of_moved(Index(b), turn)[1]]
    answers += [index.query_radius(b[:20], 0.01 * extent), index.query_cylinder(b[:20], axes, 0.01 * extent, extent)]
    answers += [index.nearest_of_with_ties(Index(b), slack)[1:] for slack in ((0.01 * extent) ** 2, 1e-8)]
    for answer in answers:
        for array in answer:
            digest.update(array.tobytes())
print(json.dumps([_core.isa(), digest.hexdigest()]))
"""


def answers_with(**environment):
    """A digest of many answers from a fresh process."""
    script = ANSWERS.format(path=[str(TESTS)])
    return subprocess.run(
        [sys.executable, "-c", script], env={**os.environ, **environment}, capture_output=True, text=True
    )


@pytest.fixture(scope="module")
def baseline_answers():
    done = answers_with(PCBENCH_ISA="baseline", OMP_NUM_THREADS="1")
    assert done.returncode == 0, done.stderr
    isa, digest = json.loads(done.stdout)
    assert isa == "baseline"
    return digest


def test_the_same_bits_with_any_number_of_threads(baseline_answers):
    for threads in ("2", "3"):
        done = answers_with(PCBENCH_ISA="baseline", OMP_NUM_THREADS=threads)
        assert json.loads(done.stdout) == ["baseline", baseline_answers]


@pytest.mark.parametrize("isa", ["avx2", "avx512"])
def test_the_same_bits_with_any_instruction_set(baseline_answers, isa):
    done = answers_with(PCBENCH_ISA=isa, OMP_NUM_THREADS="2")
    if "error: PCBENCH_ISA: " in done.stderr or "InputError: PCBENCH_ISA: " in done.stderr:
        pytest.skip(f"this machine has no {isa}: there is nothing to compare with the baseline")
    assert json.loads(done.stdout) == [isa, baseline_answers], done.stderr


def test_an_unknown_instruction_set_is_refused():
    done = answers_with(PCBENCH_ISA="sse9")
    assert done.returncode != 0
    assert "PCBENCH_ISA" in done.stderr and "'sse9'" in done.stderr


def test_a_command_refuses_an_unknown_instruction_set_in_one_line(tmp_path):
    np.save(tmp_path / "a.npy", np.eye(3))
    command = [sys.executable, "-m", "pcbench.cli", "compare", "a.npy", "a.npy"]
    done = subprocess.run(
        command, cwd=tmp_path, env={**os.environ, "PCBENCH_ISA": "sse9"}, capture_output=True, text=True
    )
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1 and done.stderr.startswith("error: PCBENCH_ISA: ")
