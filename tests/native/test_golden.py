"""Bit-identical results on every processor: hashes of all kernels on small inputs are compared with those in a file.

Inputs are integers or quotients of integers. Kernels call no function of the C library with platform-dependent
rounding; square roots and fused multiply-adds have one correct result. No tolerance is therefore needed. The weights
of PatchMatch and the bias correction of Adam use exp and pow; they are computed outside the kernels and are inputs.
"""

import pytest
from golden_kernels import (
    ARM_COMPILER,
    ARM_EMULATOR,
    COMPILER,
    HASHES,
    build,
    hashes,
    is_supported,
    is_x86,
    parse_hashes,
)

pytestmark = pytest.mark.slow  # compiles the kernels again


@pytest.fixture(scope="module")
def expected():
    return parse_hashes(HASHES.read_text())


@pytest.fixture(scope="module")
def program(tmp_path_factory):
    if COMPILER is None:
        pytest.skip("needs a C++ compiler")
    return build(COMPILER, tmp_path_factory.mktemp("native"), x86=is_x86())


@pytest.mark.parametrize("isa", ["baseline", "avx2", "avx512"])
def test_hashes_of_this_processor(program, expected, isa):
    if isa != "baseline" and not (is_x86() and is_supported(isa)):
        pytest.skip(f"this processor has no {isa}")
    computed = hashes(program, isa=isa)
    print("\n".join(f"{isa:10}{name:20}{value}" for name, value in computed.items()))
    assert computed == expected


@pytest.mark.skipif(ARM_COMPILER is None, reason="needs a compiler for ARM: Debian's g++-aarch64-linux-gnu")
@pytest.mark.skipif(ARM_EMULATOR is None, reason="needs an emulator of ARM: Debian's qemu-user")
def test_hashes_of_an_emulated_arm_processor(expected, tmp_path):
    computed = hashes(build(ARM_COMPILER, tmp_path, x86=False), emulator=ARM_EMULATOR)
    print("\n".join(f"{'aarch64':10}{name:20}{value}" for name, value in computed.items()))
    assert computed == expected
