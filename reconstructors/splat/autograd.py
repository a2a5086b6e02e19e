"""The rasterizer as a torch autograd function. Importing this module imports torch."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from reconstructors.splat.interface import GaussianTensors, Rasterizer
from reconstructors.splat.view import View


class Rasterize(torch.autograd.Function):  # type: ignore[misc]
    """Maps Gaussians and a background to the five images of `RasterOutput`; shapes as in `Rasterizer`."""

    @staticmethod
    def forward(ctx: Any, rasterizer: Rasterizer, view: View, background: Tensor, *gaussians: Tensor) -> Any:
        """Render, and save what `backward` needs."""
        output = rasterizer.forward(
            GaussianTensors(*(tensor.detach().contiguous() for tensor in gaussians)),
            view,
            background.detach(),
            geometry=True,
            gradient=any(ctx.needs_input_grad),
        )
        # Detached tensors share the memory. The rasterizer keeps those it created; if it kept these, which refer to the
        # graph, the reference cycle would never be freed.
        images = tuple(image.detach() for image in output if image is not None)
        ctx.rasterizer = rasterizer
        # The rasterizer reads all of them again. Saved tensors raise an error if they were overwritten in between.
        ctx.save_for_backward(background, *gaussians, *images)
        ctx.mark_non_differentiable(images[-1])
        ctx.set_materialize_grads(False)
        return images

    @staticmethod
    @once_differentiable  # type: ignore[untyped-decorator]
    def backward(
        ctx: Any,
        color: Tensor | None,
        transmittance: Tensor | None,
        depth: Tensor | None,
        normal: Tensor | None,
        _: None,
    ) -> Any:
        """Return the gradients with respect to the background and the Gaussians."""
        _background, *gaussians, drawn_color, drawn_transmittance, _depth, _normal, _median_depth = ctx.saved_tensors
        grad_color = torch.zeros_like(drawn_color) if color is None else color.contiguous()
        others = [None if image is None else image.contiguous() for image in (transmittance, depth, normal)]
        gradients = ctx.rasterizer.backward(grad_color, *others)
        grad_gaussians = [
            _scatter(rows, gradients.ids, tensor) if needed else None
            for tensor, rows, needed in zip(gaussians, gradients[1:6], ctx.needs_input_grad[3:], strict=True)
        ]
        grad_background = (
            (grad_color * drawn_transmittance[..., None]).sum(dim=(0, 1)) if ctx.needs_input_grad[2] else None
        )
        return None, None, grad_background, *grad_gaussians


def _scatter(rows: Tensor, ids: Tensor, like: Tensor) -> Tensor:
    """Return a tensor of the shape of `like` with the rows at `ids` and zeros elsewhere."""
    full = torch.zeros_like(like)
    full[ids] = rows
    return full
