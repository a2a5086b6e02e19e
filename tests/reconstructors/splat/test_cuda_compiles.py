"""The CUDA kernels are compiled by NVRTC, on a machine without a GPU: that none was run on one, no test can tell."""

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from pcbench.errors import InputError
from reconstructors.splat import cuda
from reconstructors.splat.cuda import kernels

ARCHITECTURES = ("sm_80", "sm_90", "sm_120")
EVERY = kernels.every_kernel()
# Of each kernel the one that is compiled to most: all harmonics, all images, and what the derivative needs.
LARGEST = list({kernel.name: kernel for kernel in EVERY}.values())


@pytest.fixture
def nvrtc(monkeypatch, tmp_path):
    """The module that compiles, with an empty cache."""
    pytest.importorskip("cuda.core", reason="cuda-core, of the extras `cuda` and `dev`, is not installed")
    from reconstructors.splat.cuda import nvrtc

    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return nvrtc


def assert_is_code_of(cubin, kernel):
    assert cubin[:4] == b"\x7fELF" and int.from_bytes(cubin[18:20], "little") == 190  # of the machine CUDA
    assert f".text.{kernel.name}\0".encode() in cubin


@pytest.mark.parametrize("architecture", ARCHITECTURES)
@pytest.mark.parametrize("kernel", LARGEST, ids=lambda kernel: kernel.name)
def test_every_kernel_compiles(nvrtc, kernel, architecture):
    assert_is_code_of(nvrtc.compiled(kernel, architecture), kernel)


@pytest.mark.slow
@pytest.mark.parametrize("architecture", ARCHITECTURES)
@pytest.mark.parametrize(
    "kernel", EVERY, ids=lambda kernel: "-".join([kernel.name, *(str(n) for _, n in kernel.constants)])
)
def test_every_kernel_compiles_with_all_of_its_constants(nvrtc, kernel, architecture):
    assert_is_code_of(nvrtc.compiled(kernel, architecture), kernel)


def test_what_was_compiled_is_kept(nvrtc, monkeypatch, tmp_path):
    kernel = kernels.compact()
    cubin = nvrtc.compiled(kernel, "sm_90")
    (file,) = (tmp_path / "pcbench").iterdir()
    assert file.read_bytes() == cubin

    def refuse(*_):
        raise AssertionError("compiled again")

    from cuda import core

    with monkeypatch.context() as patched:
        patched.setattr(core, "Program", refuse)
        assert nvrtc.compiled(kernel, "sm_90") == cubin
        for other, architecture in [(kernel, "sm_80"), (replace(kernel, threads=64), "sm_90")]:
            with pytest.raises(RuntimeError, match=r"compiled again|does not compile"):
                nvrtc.compiled(other, architecture)


def test_a_cache_that_cannot_be_written_is_done_without(nvrtc, monkeypatch, tmp_path):
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    assert_is_code_of(nvrtc.compiled(kernels.compact(), "sm_90"), kernels.compact())


def test_what_does_not_compile_says_why(nvrtc, tmp_path):
    (tmp_path / "wrong.cu").write_text("constexpr int kAnswer = unheard_of;\n")
    kernel = replace(kernels.compact(), before=(tmp_path / "wrong.cu",))
    with pytest.raises(RuntimeError, match=r"compact for sm_90(.|\n)*unheard_of"):
        nvrtc.compiled(kernel, "sm_90")


def test_what_a_launch_asks_of_cuda_core_is_there(nvrtc):
    """As far as that can be seen without a GPU."""
    from cuda import core

    module = core.ObjectCode.from_cubin(nvrtc.compiled(kernels.compact(), "sm_90"))
    shape = core.LaunchConfig(grid=7, block=128)
    assert (shape.grid, shape.block) == ((7, 1, 1), (128, 1, 1))
    assert callable(module.get_kernel) and callable(core.Stream.from_handle) and callable(core.launch)
    assert {"compute_capability", "set_current"} <= set(dir(core.Device))


def outcome(code):
    """What a fresh interpreter prints."""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=os.environ)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


COMPILE = """
from pcbench.errors import MissingExtra
from reconstructors.splat.cuda import kernels, nvrtc
try:
    nvrtc.compiled(kernels.compact(), "sm_90")
except MissingExtra as error:
    print(error)
"""


def test_importing_needs_neither_torch_nor_cuda():
    without = "import sys; sys.modules['torch'] = sys.modules['cuda'] = None\n"
    assert outcome(without + "from reconstructors.splat.cuda import Rasterizer") == ""
    assert outcome(without + COMPILE).startswith("cuda-core is needed for this")


def test_without_nvrtc_the_extra_is_named(nvrtc):
    break_it = """
from cuda.bindings import nvrtc
def fail(): raise RuntimeError("no libnvrtc.so\\nanywhere")
nvrtc.nvrtcVersion = fail
"""
    assert outcome(break_it + COMPILE) == "NVRTC is needed for this (no libnvrtc.so): pip install 'pcbench[cuda]'"


def test_tensors_of_the_cpu_are_refused():
    torch = pytest.importorskip("torch")
    image, rows = torch.zeros(4, 4, 3), torch.zeros(2, 3)
    ids = torch.arange(2)
    for call in (
        lambda: cuda.image_loss(image, image, 0.2),
        lambda: cuda.adam(rows, rows, rows, rows, ids, 0.1, 1),
        lambda: cuda.morton_order(rows),
    ):
        with pytest.raises(InputError, match="expected tensors on a CUDA device, got cpu"):
            call()


def test_the_sources_are_ascii_and_their_numbers_are_floats():
    """NVRTC takes 0.5 for a double, which is slow on a GPU and rounds otherwise than the CPU's."""
    import re

    for file in [*Path(cuda.__file__).parent.glob("*.cu"), Path(cuda.__file__).parents[1] / "maths.h"]:
        text = file.read_text(encoding="ascii")
        code = re.sub(r"//.*|0x[0-9a-f]+", "", text)
        assert not re.findall(r"\b\d+\.\d*(?:e[+-]?\d+)?(?![\w.])|\b\d+e[+-]?\d+\b", code), file.name
        assert "#include" not in code
