"""The devices that the rasterizer's tests run on."""

import pytest
from splat_passes import Engine


def on_cpu():
    from reconstructors.splat import cpu

    return Engine(cpu, "cpu")


def on_cuda():
    torch = pytest.importorskip("torch")
    if not torch.cuda.is_available():
        pytest.skip("torch finds no CUDA device")
    from reconstructors.splat import cuda

    return Engine(cuda, "cuda")


@pytest.fixture(scope="session", params=[on_cpu, pytest.param(on_cuda, marks=pytest.mark.gpu)])
def engine(request):
    """Each device's kernels; `pytest -m gpu` runs those of CUDA."""
    pytest.importorskip("torch")
    return request.param()
