"""The rasterizer on the CPU: compiled loops with bit-identical results for any thread count and instruction set."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from reconstructors.splat.cpu import _rasterizer
from reconstructors.splat.interface import GaussianTensors, Gradients, ImageLoss, RasterOutput
from reconstructors.splat.view import View

if TYPE_CHECKING:
    from torch import Tensor


class CpuRasterizer:
    """Implements `reconstructors.splat.interface.Rasterizer`. Tensors are float32, contiguous and on the CPU.

    From one view to the next it keeps about 100 bytes per Gaussian and 32 bytes for each Gaussian in each tile of 16 x
    16 pixels that it touches; the gradients add 36 bytes to the latter (48 with depth, 60 with normals too).
    """

    def __init__(self) -> None:
        self._compiled = _rasterizer.Rasterizer()
        self._shape: tuple[int, ...] = ()

    def forward(
        self,
        gaussians: GaussianTensors,
        view: View,
        background: Tensor,
        *,
        geometry: bool,
        normals: bool = True,
        gradient: bool = True,
    ) -> RasterOutput:
        """Render the Gaussians; the tensors must stay unchanged until `backward`, which may always follow."""
        size = (view.height, view.width)
        new = gaussians.means.new_empty
        color, transmittance = new((*size, 3)), new(size)
        depth = new(size) if geometry else None
        normal, median_depth = (new((*size, 3)), new(size)) if geometry and normals else (None, None)
        self._compiled.forward(
            _array(gaussians.means),
            _array(gaussians.quats),
            _array(gaussians.scales),
            _array(gaussians.opacities),
            _array(gaussians.sh),
            np.ascontiguousarray(view.rotation, dtype=np.float32),
            view.position.astype(np.float32),
            np.array([view.fx, view.fy, view.cx, view.cy], dtype=np.float32),
            np.array(view.limits, dtype=np.float32),
            np.array([view.near, *view.cutoffs], dtype=np.float32),
            _array(background),
            _array(color),
            _array(transmittance),
            _array(depth),
            _array(normal),
            _array(median_depth),
        )
        self._shape = tuple(gaussians.sh.shape)
        return RasterOutput(color, transmittance, depth, normal, median_depth)

    def backward(
        self,
        color: Tensor,
        transmittance: Tensor | None,
        depth: Tensor | None,
        normal: Tensor | None,
    ) -> Gradients:
        """Return the gradients of the last rendering."""
        import torch

        count = self._compiled.drawn
        shapes = [(count, *rest) for rest in ((3,), (4,), (3,), (), self._shape[1:], (2,))]
        gradients = Gradients(torch.empty(count, dtype=torch.int64), *(color.new_empty(shape) for shape in shapes))
        self._compiled.backward(
            *map(_array, (color, transmittance, depth, normal)), *(_array(tensor) for tensor in gradients)
        )
        return gradients


Rasterizer = CpuRasterizer  # the name in `reconstructors.splat.interface.Kernels`
morton_order = None


def image_loss(image: Tensor, target: Tensor, ssim_weight: float) -> ImageLoss:
    """Compute the loss of `reconstructors.splat.reference.image_loss` in float32."""
    import torch

    gradient = torch.empty_like(image)
    l1, ssim = _rasterizer.image_loss(_array(image), _array(target), ssim_weight, _array(gradient))
    return ImageLoss(l1, ssim, gradient)


def adam(
    parameters: Tensor,
    first: Tensor,
    second: Tensor,
    gradient: Tensor,
    ids: Tensor,
    learning_rate: float | Tensor,
    step: int,
    betas: tuple[float, float] = (0.9, 0.999),
    eps: float = 1e-15,
) -> None:
    """Apply one step of Adam, in place, to the rows `ids` of parameters (N, D) and their moments; other rows stay.

    Args:
        parameters: (N, D) parameters.
        first: (N, D) first moments.
        second: (N, D) second moments.
        gradient: (V, D) gradient of the rows.
        ids: (V,) indices of the rows, ascending.
        learning_rate: one for all columns, or one per column (D,).
        step: number of steps from 1, for all rows together.
        betas: decay rates of the two moments.
        eps: added to the denominator.
    """
    import torch

    rates = torch.as_tensor(learning_rate, dtype=torch.float32).expand(parameters.shape[1]).contiguous()
    _rasterizer.adam(
        _array(parameters),
        _array(first),
        _array(second),
        _array(gradient),
        _array(ids),
        _array(rates),
        step,
        betas[0],
        betas[1],
        eps,
    )


def _array(tensor: Tensor | None) -> Any:
    """Return a numpy view of the tensor's memory."""
    return None if tensor is None else tensor.detach().numpy()
