"""A rasterizer as a function that torch can differentiate. Importing this imports torch."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from reconstructors.splat.interface import GaussianTensors, Rasterizer
from reconstructors.splat.view import View


class Rasterize(torch.autograd.Function):  # type: ignore[misc]
    """Gaussians and a background in, the five images of `Drawn` out; shapes as in `Rasterizer`."""

    @staticmethod
    def forward(ctx: Any, rasterizer: Rasterizer, view: View, background: Tensor, *gaussians: Tensor) -> Any:
        drawn = rasterizer.forward(
            GaussianTensors(*(tensor.detach().contiguous() for tensor in gaussians)),
            view,
            background.detach(),
            geometry=True,
            gradient=any(ctx.needs_input_grad),
        )
        # Tensors of their own over the same memory: the rasterizer keeps those that it made; if it kept these, which
        # know what made them, both would live for ever.
        images = tuple(image.detach() for image in drawn if image is not None)
        ctx.rasterizer = rasterizer
        # The rasterizer reads them all again. Asking torch for them refuses what has been overwritten meanwhile.
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
        _background, *gaussians, drawn_color, drawn_transmittance, _depth, _normal, _median_depth = ctx.saved_tensors
        by_color = torch.zeros_like(drawn_color) if color is None else color.contiguous()
        others = [None if image is None else image.contiguous() for image in (transmittance, depth, normal)]
        pulled = ctx.rasterizer.backward(by_color, *others, None)
        by_gaussians = [
            _spread(rows, pulled.ids, tensor) if needed else None
            for tensor, rows, needed in zip(gaussians, pulled[1:6], ctx.needs_input_grad[3:], strict=True)
        ]
        by_background = (by_color * drawn_transmittance[..., None]).sum(dim=(0, 1)) if ctx.needs_input_grad[2] else None
        return None, None, by_background, *by_gaussians


def _spread(rows: Tensor, ids: Tensor, like: Tensor) -> Tensor:
    """Rows where they belong among those of all Gaussians, zeros elsewhere."""
    full = torch.zeros_like(like)
    full[ids] = rows
    return full
