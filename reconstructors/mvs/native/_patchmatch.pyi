"""
Compiled PatchMatch stereo; call it through reconstructors.mvs.patchmatch.
"""

from typing import Annotated

import numpy
from numpy.typing import NDArray


def isa() -> str:
    """The instruction set in use: baseline, avx2 or avx512."""

class Matcher:
    """The search for one photograph's depth map."""

    def __init__(self, gray: Annotated[NDArray[numpy.uint8], dict(shape=(None, None), order='C', device='cpu', writable=False)], pinhole: Annotated[NDArray[numpy.float32], dict(shape=(4), order='C', device='cpu', writable=False)], valid: Annotated[NDArray[numpy.uint8], dict(shape=(None, None), order='C', device='cpu', writable=False)] | None, nearest: float, farthest: float, pixels_per_depth: float, least_variance: float, seed: int) -> None: ...

    def add_source(self, gray: Annotated[NDArray[numpy.uint8], dict(shape=(None, None), order='C', device='cpu', writable=False)], motion: Annotated[NDArray[numpy.float32], dict(shape=(3, 4), order='C', device='cpu', writable=False)], depth: Annotated[NDArray[numpy.float32], dict(shape=(None, None), order='C', device='cpu', writable=False)] | None, back: Annotated[NDArray[numpy.float32], dict(shape=(3, 4), order='C', device='cpu', writable=False)], shown: Annotated[NDArray[numpy.float32], dict(shape=(None, None), order='C', device='cpu', writable=False)] | None) -> None:
        """
        motion: from homogeneous pixels times depth of the reference to those of the source (3, 4); back: the other way. With a depth map, agreement with it is part of the cost; shown: 0 where a mask hides it.
        """

    def run(self, planes: Annotated[NDArray[numpy.float32], dict(shape=(None, None, 4), order='C', device='cpu')], cost: Annotated[NDArray[numpy.float32], dict(shape=(None, None), order='C', device='cpu')], view_costs: Annotated[NDArray[numpy.float32], dict(shape=(None, None, None), order='C', device='cpu')], sweeps: int, first: int = 0) -> None:
        """
        Improves the planes (depth and normal of each pixel) in place; one whose depth is outside the range is begun at random.
        """
