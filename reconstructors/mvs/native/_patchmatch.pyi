"""
Compiled PatchMatch stereo; call it through reconstructors.mvs.patchmatch.
"""

from typing import Annotated

import numpy
from numpy.typing import NDArray


def isa() -> str:
    """The instruction set in use: baseline, avx2 or avx512."""

class Matcher:
    """Search for one photograph's depth map."""

    def __init__(self, gray: Annotated[NDArray[numpy.uint8], dict(shape=(None, None), order='C', device='cpu', writable=False)], pinhole: Annotated[NDArray[numpy.float32], dict(shape=(4), order='C', device='cpu', writable=False)], valid: Annotated[NDArray[numpy.uint8], dict(shape=(None, None), order='C', device='cpu', writable=False)] | None, nearest: float, farthest: float, pixels_per_depth: float, min_variance: float, half_patches: bool, seed: int) -> None: ...

    def add_source(self, gray: Annotated[NDArray[numpy.uint8], dict(shape=(None, None), order='C', device='cpu', writable=False)], motion: Annotated[NDArray[numpy.float32], dict(shape=(3, 4), order='C', device='cpu', writable=False)], depth: Annotated[NDArray[numpy.float32], dict(shape=(None, None), order='C', device='cpu', writable=False)] | None, back: Annotated[NDArray[numpy.float32], dict(shape=(3, 4), order='C', device='cpu', writable=False)], visible: Annotated[NDArray[numpy.float32], dict(shape=(None, None), order='C', device='cpu', writable=False)] | None) -> None:
        """
        Add a source image.

        Args:
            gray: grey levels (H, W) of the source.
            motion: (3, 4), from homogeneous pixels times depth of the reference to those of the source.
            depth: depth map of the source, None without one; agreement with it is part of the cost.
            back: (3, 4), from homogeneous pixels times depth of the source to those of the reference.
            visible: (H, W), 0 where a mask hides the source; None without a mask.
        """

    def run(self, planes: Annotated[NDArray[numpy.float32], dict(shape=(None, None, 4), order='C', device='cpu')], cost: Annotated[NDArray[numpy.float32], dict(shape=(None, None), order='C', device='cpu')], view_costs: Annotated[NDArray[numpy.float32], dict(shape=(None, None, None), order='C', device='cpu')], sweeps: int, first: int = 0) -> None:
        """
        Improve planes in place.

        Args:
            planes: (H, W, 4), depth and normal of each pixel. A plane whose depth is outside the range is replaced by a random one.
            cost: (H, W), written.
            view_costs: (H, W, sources), written.
            sweeps: number of sweeps.
            first: index of the first sweep; perturbations shrink with it.
        """

def confirm(depth: Annotated[NDArray[numpy.float32], dict(shape=(None, None), order='C', device='cpu', writable=False)], normal: Annotated[NDArray[numpy.float32], dict(shape=(None, None, 3), order='C', device='cpu', writable=False)], confidence: Annotated[NDArray[numpy.float32], dict(shape=(None, None), order='C', device='cpu', writable=False)], rows: Annotated[NDArray[numpy.int64], dict(shape=(None,), order='C', device='cpu', writable=False)], columns: Annotated[NDArray[numpy.int64], dict(shape=(None,), order='C', device='cpu', writable=False)], other_depth: Annotated[NDArray[numpy.float32], dict(shape=(None, None), order='C', device='cpu', writable=False)], other_normal: Annotated[NDArray[numpy.float32], dict(shape=(None, None, 3), order='C', device='cpu', writable=False)], other_confidence: Annotated[NDArray[numpy.float32], dict(shape=(None, None), order='C', device='cpu', writable=False)], other_pinhole: Annotated[NDArray[numpy.float64], dict(shape=(4), order='C', device='cpu', writable=False)], to_other: Annotated[NDArray[numpy.float64], dict(shape=(3, 4), order='C', device='cpu', writable=False)], back: Annotated[NDArray[numpy.float64], dict(shape=(3, 4), order='C', device='cpu', writable=False)], turn: Annotated[NDArray[numpy.float64], dict(shape=(3, 3), order='C', device='cpu', writable=False)], min_confidence: float, max_pixels: float, max_depth: float, min_cosine: float, depths: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu')], sees_through: Annotated[NDArray[numpy.bool_], dict(shape=(None,), order='C', device='cpu')]) -> None:
    """
    Confirm depths of a map by another map; see reconstructors.mvs.filter.confirm.
    """
