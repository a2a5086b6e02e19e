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

class MeshIndex:
    """
    A box tree over triangles; the caller has checked that vertices are finite.
    """

    def __init__(self, vertices: Annotated[NDArray[numpy.float64], dict(shape=(None, 3), order='C', device='cpu', writable=False)], faces: Annotated[NDArray[numpy.int64], dict(shape=(None, 3), order='C', device='cpu', writable=False)]) -> None: ...

    def __len__(self) -> int: ...

    def query(self, points: Annotated[NDArray[numpy.float64], dict(shape=(None, 3), order='C', device='cpu', writable=False)], distances: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu')], feet: Annotated[NDArray[numpy.float64], dict(shape=(None, 3), order='C', device='cpu')], faces: Annotated[NDArray[numpy.int64], dict(shape=(None,), order='C', device='cpu')], features: Annotated[NDArray[numpy.uint8], dict(shape=(None,), order='C', device='cpu')]) -> None:
        """
        Nearest points of the mesh, written in place: distances (N,), feet (N, 3), faces (N,), and features (N,):
        0-2 the face's corners, 3-5 its edges 01, 12, 20, 6 its inside.
        """
