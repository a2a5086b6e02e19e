"""
Compiled kernels of pcbench; call them through the modules that own them.
"""

from typing import Annotated

import numpy
from numpy.typing import NDArray


def plane_fits(points: Annotated[NDArray[numpy.float64], dict(shape=(None, 3), order='C', device='cpu', writable=False)], neighbors: Annotated[NDArray[numpy.int64], dict(shape=(None, None), order='C', device='cpu', writable=False)], normals: Annotated[NDArray[numpy.float64], dict(shape=(None, 3), order='C', device='cpu')], variation: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu')]) -> None:
    """
    Fit a plane to each row of neighbours: unit normals (M, 3) and surface variation (M,) are written in place.
    """
