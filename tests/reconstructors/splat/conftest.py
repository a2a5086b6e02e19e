"""Devices for the tests of the rasterizer."""

import pytest
from optional import import_or_skip
from splat_passes import Engine


def reference_engine():
    from reconstructors.splat import reference

    return Engine(reference, "cpu")


def on_cpu():
    from reconstructors.splat import cpu

    return Engine(cpu, "cpu")


def on_emulated_cuda():
    """The CUDA kernels and the code around them, on the CPU."""
    import_or_skip("torch")
    from cuda_emulator import EmulatedCuda

    return Engine(EmulatedCuda(), "cpu")


def on_cuda():
    torch = import_or_skip("torch")
    if not torch.cuda.is_available():
        pytest.skip("torch finds no CUDA device")
    from reconstructors.splat import cuda

    return Engine(cuda, "cuda")


@pytest.fixture(scope="session", params=[on_cpu, on_emulated_cuda, pytest.param(on_cuda, marks=pytest.mark.gpu)])
def engine(request):
    """The kernels of each device; `pytest -m gpu` runs those of CUDA."""
    import_or_skip("torch")
    return request.param()


@pytest.fixture(scope="session", params=[reference_engine, on_cpu, pytest.param(on_cuda, marks=pytest.mark.gpu)])
def any_engine(request):
    """The same with the reference rasterizer, which must also meet closed forms."""
    import_or_skip("torch")
    return request.param()
