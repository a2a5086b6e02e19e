"""The same bits from every processor: all kernels on small inputs, against hashes in a file.

Inputs are whole numbers or quotients of them, and no kernel calls a function of the C library whose result it may
choose (square roots and fused multiply-adds have one correct result), so there is nothing to tolerate. The weights of
PatchMatch and the bias correction of Adam, which take exp and pow, are computed outside the kernels and given here.
"""

import pytest
from golden_kernels import ARM_COMPILER, ARM_EMULATOR, COMPILER, HASHES, build, hashes, is_x86, parsed, runs_here

pytestmark = pytest.mark.slow  # compiles the kernels once more


@pytest.fixture(scope="module")
def expected():
    return parsed(HASHES.read_text())


@pytest.fixture(scope="module")
def program(tmp_path_factory):
    if COMPILER is None:
        pytest.skip("needs a C++ compiler")
    return build(COMPILER, tmp_path_factory.mktemp("native"), x86=is_x86())


@pytest.mark.parametrize("isa", ["baseline", "avx2", "avx512"])
def test_this_processor(program, expected, isa):
    if isa != "baseline" and not (is_x86() and runs_here(isa)):
        pytest.skip(f"this processor has no {isa}")
    found = hashes(program, isa=isa)
    print("\n".join(f"{isa:10}{name:20}{value}" for name, value in found.items()))
    assert found == expected


@pytest.mark.skipif(ARM_COMPILER is None, reason="needs a compiler for ARM: Debian's g++-aarch64-linux-gnu")
@pytest.mark.skipif(ARM_EMULATOR is None, reason="needs an emulator of ARM: Debian's qemu-user")
def test_arm(expected, tmp_path):
    found = hashes(build(ARM_COMPILER, tmp_path, x86=False), emulator=ARM_EMULATOR)
    print("\n".join(f"{'aarch64':10}{name:20}{value}" for name, value in found.items()))
    assert found == expected
