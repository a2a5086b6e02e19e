"""
The compiled Gaussian rasterizer; call it through reconstructors.splat.
"""

from typing import Annotated

import numpy
from numpy.typing import NDArray


def isa() -> str:
    """The instruction set in use: baseline, avx2 or avx512."""

class Rasterizer:
    """Renders Gaussians and computes gradients; the buffers are reused."""

    def __init__(self) -> None: ...

    def forward(self, means: Annotated[NDArray[numpy.float32], dict(shape=(None, 3), order='C', device='cpu', writable=False)], quaternions: Annotated[NDArray[numpy.float32], dict(shape=(None, 4), order='C', device='cpu', writable=False)], scales: Annotated[NDArray[numpy.float32], dict(shape=(None, 3), order='C', device='cpu', writable=False)], opacities: Annotated[NDArray[numpy.float32], dict(shape=(None,), order='C', device='cpu', writable=False)], harmonics: Annotated[NDArray[numpy.float32], dict(shape=(None, None, 3), order='C', device='cpu', writable=False)], rotation: Annotated[NDArray[numpy.float32], dict(shape=(3, 3), order='C', device='cpu', writable=False)], position: Annotated[NDArray[numpy.float32], dict(shape=(3), order='C', device='cpu', writable=False)], pinhole: Annotated[NDArray[numpy.float32], dict(shape=(4), order='C', device='cpu', writable=False)], limits: Annotated[NDArray[numpy.float32], dict(shape=(4), order='C', device='cpu', writable=False)], cutoffs: Annotated[NDArray[numpy.float32], dict(shape=(4), order='C', device='cpu', writable=False)], background: Annotated[NDArray[numpy.float32], dict(shape=(3), order='C', device='cpu', writable=False)], color: Annotated[NDArray[numpy.float32], dict(shape=(None, None, 3), order='C', device='cpu')], transmittance: Annotated[NDArray[numpy.float32], dict(shape=(None, None), order='C', device='cpu')], depth: Annotated[NDArray[numpy.float32], dict(shape=(None, None), order='C', device='cpu')] | None, normal: Annotated[NDArray[numpy.float32], dict(shape=(None, None, 3), order='C', device='cpu')] | None, median_depth: Annotated[NDArray[numpy.float32], dict(shape=(None, None), order='C', device='cpu')] | None) -> None:
        """
        Renders the images. pinhole: fx, fy, cx, cy; limits: left, right, top, bottom of x / z and y / z; cutoffs: nearest depth, minimum alpha, its logarithm to base 2, minimum transmittance.
        """

    def backward(self, grad_color: Annotated[NDArray[numpy.float32], dict(shape=(None, None, 3), order='C', device='cpu', writable=False)], grad_transmittance: Annotated[NDArray[numpy.float32], dict(shape=(None, None), order='C', device='cpu', writable=False)] | None, grad_depth: Annotated[NDArray[numpy.float32], dict(shape=(None, None), order='C', device='cpu', writable=False)] | None, grad_normal: Annotated[NDArray[numpy.float32], dict(shape=(None, None, 3), order='C', device='cpu', writable=False)] | None, ids: Annotated[NDArray[numpy.int64], dict(shape=(None,), order='C', device='cpu')], means: Annotated[NDArray[numpy.float32], dict(shape=(None, 3), order='C', device='cpu')], quaternions: Annotated[NDArray[numpy.float32], dict(shape=(None, 4), order='C', device='cpu')], scales: Annotated[NDArray[numpy.float32], dict(shape=(None, 3), order='C', device='cpu')], opacities: Annotated[NDArray[numpy.float32], dict(shape=(None,), order='C', device='cpu')], harmonics: Annotated[NDArray[numpy.float32], dict(shape=(None, None, 3), order='C', device='cpu')], screen: Annotated[NDArray[numpy.float32], dict(shape=(None, 2), order='C', device='cpu')]) -> None:
        """
        Computes the gradients with respect to the Gaussians of the last forward pass, one row for each.
        """

    @property
    def drawn(self) -> int:
        """Number of Gaussians that the last forward pass drew."""

    @property
    def instances(self) -> int:
        """Number of pairs of a Gaussian and a tile that it touches."""

    @property
    def bytes(self) -> int:
        """Size of the buffers in bytes."""

def image_loss(image: Annotated[NDArray[numpy.float32], dict(shape=(None, None, 3), order='C', device='cpu', writable=False)], target: Annotated[NDArray[numpy.float32], dict(shape=(None, None, 3), order='C', device='cpu', writable=False)], ssim_weight: float, gradient: Annotated[NDArray[numpy.float32], dict(shape=(None, None, 3), order='C', device='cpu')]) -> tuple[float, float]:
    """
    Mean absolute difference and mean SSIM; writes the gradient of (1 - w) L1 + w (1 - SSIM).
    """

def adam(parameters: Annotated[NDArray[numpy.float32], dict(shape=(None, None), order='C', device='cpu')], first: Annotated[NDArray[numpy.float32], dict(shape=(None, None), order='C', device='cpu')], second: Annotated[NDArray[numpy.float32], dict(shape=(None, None), order='C', device='cpu')], gradient: Annotated[NDArray[numpy.float32], dict(shape=(None, None), order='C', device='cpu', writable=False)], rows: Annotated[NDArray[numpy.int64], dict(shape=(None,), order='C', device='cpu', writable=False)], rates: Annotated[NDArray[numpy.float32], dict(shape=(None,), order='C', device='cpu', writable=False)], step: int, beta1: float, beta2: float, epsilon: float) -> None:
    """One step of Adam on some rows, in place."""
