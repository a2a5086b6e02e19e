"""The rasterizer on the CPU: compiled loops, the same bits at any thread count and on every instruction set."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from reconstructors.splat.cpu import _rasterizer
from reconstructors.splat.interface import Drawn, GaussianTensors, ImageLoss, Pulled
from reconstructors.splat.view import View

if TYPE_CHECKING:
    from torch import Tensor


class CpuRasterizer:
    """See `reconstructors.splat.interface.Rasterizer`. Tensors are float32, contiguous and on the CPU.

    It holds, from one view to the next, some 100 bytes a Gaussian, 32 for each Gaussian in each tile of 16 x 16 pixels
    that it touches, and for the derivatives 44 more of those (68 with geometry).
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
        gradient: bool = True,
    ) -> Drawn:
        """The image; the tensors must stay as they are until `backward`, which may always follow: it needs no more."""
        size = (view.height, view.width)
        new = gaussians.means.new_empty
        color, transmittance = new((*size, 3)), new(size)
        depth, normal, median_depth = (new(size), new((*size, 3)), new(size)) if geometry else (None,) * 3
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
            view.near,
            _array(background),
            _array(color),
            _array(transmittance),
            _array(depth),
            _array(normal),
            _array(median_depth),
        )
        self._shape = tuple(gaussians.sh.shape)
        return Drawn(color, transmittance, depth, normal, median_depth)

    def backward(
        self,
        color: Tensor,
        transmittance: Tensor | None,
        depth: Tensor | None,
        normal: Tensor | None,
        error: Tensor | None,
    ) -> Pulled:
        """The derivatives of what `forward` drew last."""
        import torch

        count = self._compiled.drawn
        shapes = [(count, *rest) for rest in ((3,), (4,), (3,), (), self._shape[1:], (2,), (), ())]
        pulled = Pulled(torch.empty(count, dtype=torch.int64), *(color.new_empty(shape) for shape in shapes))
        self._compiled.backward(
            *map(_array, (color, transmittance, depth, normal, error)), *(_array(tensor) for tensor in pulled)
        )
        return pulled


Rasterizer = CpuRasterizer  # the name in `reconstructors.splat.interface.Kernels`
morton_order = None


def image_loss(image: Tensor, target: Tensor, ssim_weight: float) -> ImageLoss:
    """See `reconstructors.splat.reference.image_loss`, in float32."""
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
    """One step of Adam, in place, on the rows `ids` (rising) of parameters (N, D) and their moments; other rows stay.

    Args:
        learning_rate: of all columns, or of each (D,).
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
    """The same memory as numpy sees it."""
    return None if tensor is None else tensor.detach().numpy()
