"""
The compiled voxel radiance field; call it through reconstructors.field.
"""

from typing import Annotated

import numpy
from numpy.typing import NDArray


def isa() -> str:
    """The instruction set in use: baseline, avx2 or avx512."""

def render(values: Annotated[NDArray[numpy.float32], dict(shape=(None, 16), order='C', device='cpu', writable=False)], links: Annotated[NDArray[numpy.int32], dict(shape=(None, None, None), order='C', device='cpu', writable=False)], occupied: Annotated[NDArray[numpy.uint8], dict(shape=(None, None, None), order='C', device='cpu', writable=False)], background: Annotated[NDArray[numpy.float32], dict(shape=(16), order='C', device='cpu', writable=False)], step: float, origins: Annotated[NDArray[numpy.float32], dict(shape=(None, 3), order='C', device='cpu', writable=False)], directions: Annotated[NDArray[numpy.float32], dict(shape=(None, 3), order='C', device='cpu', writable=False)], color: Annotated[NDArray[numpy.float32], dict(shape=(None, 3), order='C', device='cpu')], transmittance: Annotated[NDArray[numpy.float32], dict(shape=(None,), order='C', device='cpu')], depth: Annotated[NDArray[numpy.float32], dict(shape=(None,), order='C', device='cpu')], median: Annotated[NDArray[numpy.float32], dict(shape=(None,), order='C', device='cpu')], normal: Annotated[NDArray[numpy.float32], dict(shape=(None, 3), order='C', device='cpu')]) -> None:
    """Renders rays; lengths are in voxels, distances along the rays."""

def gradients(values: Annotated[NDArray[numpy.float32], dict(shape=(None, 16), order='C', device='cpu', writable=False)], links: Annotated[NDArray[numpy.int32], dict(shape=(None, None, None), order='C', device='cpu', writable=False)], occupied: Annotated[NDArray[numpy.uint8], dict(shape=(None, None, None), order='C', device='cpu', writable=False)], background: Annotated[NDArray[numpy.float32], dict(shape=(16), order='C', device='cpu', writable=False)], step: float, origins: Annotated[NDArray[numpy.float32], dict(shape=(None, 3), order='C', device='cpu', writable=False)], directions: Annotated[NDArray[numpy.float32], dict(shape=(None, 3), order='C', device='cpu', writable=False)], offsets: Annotated[NDArray[numpy.float32], dict(shape=(None,), order='C', device='cpu', writable=False)], targets: Annotated[NDArray[numpy.float32], dict(shape=(None, 3), order='C', device='cpu', writable=False)], gradients: Annotated[NDArray[numpy.float32], dict(shape=(None, 16), order='C', device='cpu')], touched: Annotated[NDArray[numpy.uint8], dict(shape=(None,), order='C', device='cpu')], weights: Annotated[NDArray[numpy.float32], dict(shape=(None,), order='C', device='cpu')], grad_background: Annotated[NDArray[numpy.float32], dict(shape=(16), order='C', device='cpu')]) -> float:
    """
    Adds the gradients of the squared color errors of rays, and returns the sum of these errors.
    """

def update(values: Annotated[NDArray[numpy.float32], dict(shape=(None, 16), order='C', device='cpu')], moments: Annotated[NDArray[numpy.float32], dict(shape=(None, 16), order='C', device='cpu')], gradients: Annotated[NDArray[numpy.float32], dict(shape=(None, 16), order='C', device='cpu')], touched: Annotated[NDArray[numpy.uint8], dict(shape=(None,), order='C', device='cpu')], vertices: Annotated[NDArray[numpy.int32], dict(shape=(None,), order='C', device='cpu', writable=False)], links: Annotated[NDArray[numpy.int32], dict(shape=(None, None, None), order='C', device='cpu', writable=False)], rates: Annotated[NDArray[numpy.float32], dict(shape=(16), order='C', device='cpu', writable=False)], smoothing: Annotated[NDArray[numpy.float32], dict(shape=(16), order='C', device='cpu', writable=False)]) -> None:
    """
    One step of RMSProp with total variation on the touched rows, in place; clears their gradients.
    """
