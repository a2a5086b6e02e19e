"""The search loops are compiled once for each instruction set: no copy may stand in for another."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from repository import ROOT

NATIVE = ROOT / "pcbench" / "native"
# As in CMakeLists.txt.
FLAGS = {
    "baseline": [],
    "avx2": ["-mavx2", "-mbmi", "-mbmi2", "-mpopcnt"],
    "avx512": ["-mavx512f", "-mavx512dq", "-mavx512vl", "-mbmi", "-mbmi2", "-mpopcnt"],
}
COMPILER = shutil.which(os.environ.get("CXX", "c++"))


def unit(isa):
    return NATIVE / "points" / f"kernels_{isa}.cpp"


def compile_unit(isa, *flags, out: Path):
    return subprocess.run(
        [COMPILER, "-std=c++17", "-fPIC", "-fopenmp", "-ffp-contract=off", "-w", f"-I{NATIVE}", *flags]
        + ["-c", str(unit(isa)), "-o", str(out)],
        capture_output=True,
        text=True,
    )


@pytest.mark.skipif(COMPILER is None or shutil.which("nm") is None, reason="needs a C++ compiler and nm")
@pytest.mark.skipif(os.uname().machine != "x86_64", reason="one instruction set only on this machine")
@pytest.mark.parametrize("isa", FLAGS)
def test_no_symbol_of_an_instruction_set_can_be_taken_for_that_of_another(isa, tmp_path):
    """The linker keeps one of several weak symbols of a name: a copy for AVX-512 would crash a machine without it.

    Compiled without optimisation, when no call is inlined that is not bound to be: every inline function and template
    that any compiler might leave in the object shows. Each must name its instruction set. So must what the standard
    library adds, which is why it is hardly used there.
    """
    built = compile_unit(isa, "-O0", *FLAGS[isa], out=tmp_path / "unit.o")
    assert built.returncode == 0, built.stderr
    listed = subprocess.run(
        ["nm", "--demangle", "--defined-only", str(tmp_path / "unit.o")], capture_output=True, text=True
    )
    assert listed.returncode == 0, listed.stderr
    symbols = [line.split(maxsplit=2)[1:] for line in listed.stdout.splitlines()]
    weak = [name for kind, name in symbols if kind == "W"]  # functions; data are the same for all
    own = f"pcbench::{isa}::"
    assert any(own in name for name in weak)  # else nothing was looked at
    assert [name for name in weak if own not in name] == []


@pytest.mark.skipif(COMPILER is None, reason="needs a C++ compiler")
@pytest.mark.parametrize("isa", ["avx2", "avx512"])
def test_a_unit_compiled_without_its_instructions_is_refused(isa, tmp_path):
    """Without its flags it would be a second baseline under the name of another."""
    built = compile_unit(isa, "-fsyntax-only", out=tmp_path / "unit.o")
    assert built.returncode != 0
    assert "must be compiled with" in built.stderr


def cpu_flags():
    """What the kernel says that this machine can do; none where it does not say."""
    info = Path("/proc/cpuinfo")
    lines = [line for line in info.read_text().splitlines() if line.startswith("flags")] if info.exists() else []
    return set(lines[0].split(":")[1].split()) if lines else set()


@pytest.mark.parametrize("isa, needs", [("avx2", {"avx2"}), ("avx512", {"avx512f", "avx512dq", "avx512vl"})])
def test_what_this_machine_can_do_is_used(isa, needs):
    if not needs | {"bmi1", "bmi2", "popcnt"} <= cpu_flags():
        pytest.skip(f"this machine has no {isa}")
    script = "from pcbench.native import _core; print(_core.isa())"
    done = subprocess.run(
        [sys.executable, "-c", script], env={**os.environ, "PCBENCH_ISA": isa}, capture_output=True, text=True
    )
    assert done.stdout == isa + "\n", done.stderr
