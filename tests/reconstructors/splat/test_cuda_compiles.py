"""Compilation of the CUDA kernels by NVRTC, which needs no GPU."""

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from optional import import_or_skip
from splat_passes import Engine, random_image_gradients, run_pass
from splat_scenes import make_scene, whole_tile_image
from wording import check_error

from reconstructors.splat import cuda
from reconstructors.splat.cuda import kernels

ARCHITECTURES = ("sm_80", "sm_90", "sm_120")
ALL_KERNELS = kernels.all_kernels()
# The variant of each kernel with the most code: all harmonics, all images, and the state for the gradient.
LARGEST_VARIANTS = list({kernel.name: kernel for kernel in ALL_KERNELS}.values())


@pytest.fixture
def nvrtc(monkeypatch, tmp_path):
    """The module `nvrtc` with an empty cache."""
    import_or_skip("cuda.core")
    from reconstructors.splat.cuda import nvrtc

    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return nvrtc


def assert_code_of(cubin, kernel):
    assert cubin[:4] == b"\x7fELF" and int.from_bytes(cubin[18:20], "little") == 190  # of the machine CUDA
    assert f".text.{kernel.name}\0".encode() in cubin


@pytest.mark.parametrize(
    "architecture", [ARCHITECTURES[0], *(pytest.param(each, marks=pytest.mark.long) for each in ARCHITECTURES[1:])]
)
@pytest.mark.parametrize("kernel", LARGEST_VARIANTS, ids=lambda kernel: kernel.name)
def test_every_kernel_compiles(nvrtc, kernel, architecture):
    assert_code_of(nvrtc.compile_kernel(kernel, architecture), kernel)


@pytest.mark.slow
@pytest.mark.parametrize("architecture", ARCHITECTURES)
@pytest.mark.parametrize(
    "kernel", ALL_KERNELS, ids=lambda kernel: "-".join([kernel.name, *(str(n) for _, n in kernel.constants)])
)
def test_every_kernel_compiles_with_all_of_its_constants(nvrtc, kernel, architecture):
    assert_code_of(nvrtc.compile_kernel(kernel, architecture), kernel)


def test_compiled_kernels_are_cached(nvrtc, monkeypatch, tmp_path):
    kernel = kernels.compact()
    cubin = nvrtc.compile_kernel(kernel, "sm_90")
    (file,) = (tmp_path / "pcbench").iterdir()
    assert file.read_bytes()[32:] == cubin

    def fail(*_):
        raise AssertionError("compiled again")

    from cuda import core

    with monkeypatch.context() as patch:
        patch.setattr(core, "Program", fail)
        assert nvrtc.compile_kernel(kernel, "sm_90") == cubin
        for other, architecture in [(kernel, "sm_80"), (replace(kernel, threads=64), "sm_90")]:
            with pytest.raises(RuntimeError, match=r"compiled again|does not compile"):
                nvrtc.compile_kernel(other, architecture)
    file.write_bytes(file.read_bytes()[:-1] + b"x")
    assert nvrtc.compile_kernel(kernel, "sm_90") == cubin


def test_a_cache_folder_that_is_not_writable_is_ignored(nvrtc, monkeypatch, tmp_path):
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    assert_code_of(nvrtc.compile_kernel(kernels.compact(), "sm_90"), kernels.compact())


def test_a_compilation_error_has_the_log(nvrtc, tmp_path):
    (tmp_path / "wrong.cu").write_text("constexpr int kAnswer = unheard_of;\n")
    kernel = replace(kernels.compact(), headers=(tmp_path / "wrong.cu",))
    with pytest.raises(RuntimeError, match=r"compact for sm_90(.|\n)*unheard_of"):
        nvrtc.compile_kernel(kernel, "sm_90")


class Driver:
    """cuda.core without the parts that need a GPU: the emulator runs what the driver would run."""

    def __init__(self, nvrtc, core, emulator):
        self.nvrtc, self.core, self.emulator, self.streams = nvrtc, core, emulator, set()
        self.Device = lambda index: SimpleNamespace(compute_capability=(9, 0), set_current=lambda: None)
        self.ObjectCode = SimpleNamespace(from_cubin=self.module)
        self.Stream = SimpleNamespace(from_handle=lambda handle: handle)

    def __getattr__(self, name):
        return getattr(self.core, name)

    def module(self, cubin):
        assert callable(self.core.ObjectCode.from_cubin(cubin).get_kernel)

        def kernel(name):
            variants = (kernel for kernel in ALL_KERNELS if kernel.name == name)
            return next(kernel for kernel in variants if self.nvrtc.compile_kernel(kernel, "sm_90") == cubin)

        return SimpleNamespace(get_kernel=kernel)

    def launch(self, stream, shape, kernel, *arguments):
        holder = import_or_skip("cuda.core._kernel_arg_handler").ParamHolder(arguments)
        assert (shape.block, shape.grid[1:]) == ((kernel.threads, 1, 1), (1, 1))
        self.streams.add(stream)
        self.emulator.run(kernel, shape.grid[0], holder.ptr)


def test_the_driver_gets_arguments_in_the_layout_of_the_kernels(nvrtc, monkeypatch):
    """Tests the launcher and cuda.core's argument packing; the emulator runs the kernels instead of a GPU."""
    torch = import_or_skip("torch")
    from contextlib import nullcontext

    from cuda import core
    from cuda_emulator import Emulator

    driver = Driver(nvrtc, core, Emulator())
    monkeypatch.setattr(nvrtc, "_core", lambda: driver)
    monkeypatch.setattr(torch.cuda, "device", lambda index: nullcontext())
    monkeypatch.setattr(torch.cuda, "current_stream", lambda: SimpleNamespace(cuda_stream=0))
    launchers = nvrtc.Gpu(-1), Emulator()  # torch calls the CPU number -1
    image = torch.rand(20, 24, 3, generator=torch.Generator().manual_seed(2))
    losses, models, orders, passes = [], [], [], []
    for launcher in launchers:
        losses.append(cuda.image_loss(image, image.flip(0).contiguous(), 0.2, launcher=launcher))
        models.append([image[0].clone(), torch.zeros(24, 3), torch.zeros(24, 3)])
        ids = torch.arange(0, 24, 2)
        cuda.adam(*models[-1], image[1][ids], ids, 0.01, 7, launcher=launcher)
        orders.append([cuda.morton_order(image[0], launcher)])
        rasterizer, scene = cuda.Rasterizer(launcher), make_scene(whole_tile_image)
        image_gradients = random_image_gradients(scene)._replace(depth=None, normal=None)
        passes.append(
            run_pass(Engine(cuda, "cpu"), scene, image_gradients, rasterizer, geometry=False).arrays().values()
        )
    for parts in (losses, models, orders):
        assert all(torch.equal(*pair) for pair in zip(*parts, strict=True))
    assert all(np.array_equal(*pair) for pair in zip(*passes, strict=True))
    assert driver.streams == {1}  # the driver's handle of the default stream
    assert set(driver.emulator.launched) == {kernel.name for kernel in ALL_KERNELS}


def run_code(code):
    """Return what a fresh interpreter prints."""
    process = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=os.environ)
    assert process.returncode == 0, process.stderr
    return process.stdout.strip()


COMPILE_SCRIPT = """
from pcbench.errors import MissingExtra
from reconstructors.splat.cuda import kernels, nvrtc
try:
    nvrtc.compile_kernel(kernels.compact(), "sm_90")
except MissingExtra as error:
    print(error)
"""


def test_importing_needs_neither_torch_nor_cuda():
    block_imports = "import sys; sys.modules['torch'] = sys.modules['cuda'] = None\n"
    assert run_code(block_imports + "from reconstructors.splat.cuda import Rasterizer") == ""
    assert run_code(block_imports + COMPILE_SCRIPT).startswith("cuda-core is needed for this")


def test_without_nvrtc_the_extra_is_named(nvrtc):
    break_nvrtc = """
from cuda.bindings import nvrtc
def fail(): raise RuntimeError("no libnvrtc.so\\nanywhere")
nvrtc.nvrtcVersion = fail
"""
    assert (
        run_code(break_nvrtc + COMPILE_SCRIPT)
        == "NVRTC is needed for this (no libnvrtc.so): pip install 'pcbench[cuda]'"
    )


def test_cpu_tensors_are_refused():
    torch = import_or_skip("torch")
    image, rows = torch.zeros(4, 4, 3), torch.zeros(2, 3)
    ids = torch.arange(2)
    for call in (
        lambda: cuda.image_loss(image, image, 0.2),
        lambda: cuda.adam(rows, rows, rows, rows, ids, 0.1, 1),
        lambda: cuda.morton_order(rows),
    ):
        with check_error():
            call()


def test_the_sources_are_ascii_and_their_literals_are_floats():
    """A literal like 0.5 is a double, which is slow on a GPU and rounds differently from the CPU's floats."""
    import re

    for file in [*Path(cuda.__file__).parent.glob("*.cu"), Path(cuda.__file__).parents[1] / "maths.h"]:
        text = file.read_text(encoding="ascii")
        code = re.sub(r"//.*|0x[0-9a-f]+", "", text)
        assert not re.findall(r"\b\d+\.\d*(?:e[+-]?\d+)?(?![\w.])|\b\d+e[+-]?\d+\b", code), file.name
        assert "#include" not in code
