"""Devices for the tests of the rasterizer."""

import pytest
from optional import import_or_skip
from splat_passes import Engine


def reference_engine():
    from reconstructors.splat import reference

    return Engine(reference, "cpu")


def cpu_engine():
    from reconstructors.splat import cpu

    return Engine(cpu, "cpu")


def emulated_cuda_engine():
    """The CUDA kernels and the code around them, on the CPU."""
    import_or_skip("torch")
    from cuda_emulator import EmulatedCuda

    return Engine(EmulatedCuda(), "cpu")


def cuda_engine():
    torch = import_or_skip("torch")
    if not torch.cuda.is_available():
        pytest.skip("torch finds no CUDA device")
    from reconstructors.splat import cuda

    return Engine(cuda, "cuda")


@pytest.fixture(
    scope="session", params=[cpu_engine, emulated_cuda_engine, pytest.param(cuda_engine, marks=pytest.mark.gpu)]
)
def engine(request):
    """The kernels of each device; `pytest -m gpu` runs those of CUDA."""
    import_or_skip("torch")
    return request.param()


@pytest.fixture(
    scope="session", params=[reference_engine, cpu_engine, pytest.param(cuda_engine, marks=pytest.mark.gpu)]
)
def any_engine(request):
    """The same with the reference rasterizer, which must also meet closed forms."""
    import_or_skip("torch")
    return request.param()
