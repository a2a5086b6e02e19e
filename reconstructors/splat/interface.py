"""Interface of the rasterizers of all devices.

Each device has a module of `Kernels`: `reconstructors.splat.cpu`, `reconstructors.splat.cuda`, and
`reconstructors.splat.reference`, the slow implementation that the two are tested against. Tensors are on one device,
contiguous and float32; the reference computes and returns float64.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple, Protocol

from reconstructors.splat.view import View

if TYPE_CHECKING:
    from torch import Tensor


class GaussianTensors(NamedTuple):
    """N Gaussians as the rasterizers read them.

    Attributes:
        means: (N, 3).
        quats: (N, 4) wxyz of any norm.
        scales: (N, 3) standard deviations along the axes.
        opacities: (N,) 0 to 1.
        sh: (N, K, 3) spherical harmonics coefficients, K = 1, 4, 9 or 16; the color is their sum plus 0.5, clamped at
            0.
    """

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    sh: Tensor


class RasterOutput(NamedTuple):
    """The images of one view; w is the weight of a Gaussian at a pixel, its alpha times the transmittance before it.

    Attributes:
        color: (H, W, 3) sum of w times color, plus the transmittance times the background.
        transmittance: (H, W) transmittance behind the last Gaussian: 1 minus the sum of w.
        depth: (H, W) sum of w times the depth of the Gaussian's plane at the pixel; None if it was not requested,
            like those that follow.
        normal: (H, W, 3) sum of w times the unit normal in the camera's frame, towards the camera; or None.
        median_depth: (H, W) depth of the plane of the Gaussian at which the transmittance falls below 0.5, 0 if it
            stays above; or None. It has no gradient.
    """

    color: Tensor
    transmittance: Tensor
    depth: Tensor | None
    normal: Tensor | None
    median_depth: Tensor | None


class Gradients(NamedTuple):
    """Gradients of the loss with respect to the V Gaussians that were drawn.

    Attributes:
        ids: (V,) int64, indices of the Gaussians, ascending.
        means, quats, scales, opacities, sh: (V, 3), (V, 4), (V, 3), (V,), (V, K, 3) gradients.
        screen: (V, 2) gradient with respect to the projected mean, per pixel.
    """

    ids: Tensor
    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    sh: Tensor
    screen: Tensor


class Rasterizer(Protocol):
    """Renders a view and computes the gradients of that rendering; its buffers are reused for the next view."""

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
        """Render Gaussians over a background (3,).

        Args:
            gaussians: the Gaussians.
            view: the pinhole.
            background: (3,) color behind the Gaussians.
            geometry: whether to render the depth.
            normals: whether geometry includes normal and median depth.
            gradient: whether `backward` may follow.
        """
        ...

    def backward(
        self,
        color: Tensor,
        transmittance: Tensor | None,
        depth: Tensor | None,
        normal: Tensor | None,
    ) -> Gradients:
        """Return the gradients with respect to the Gaussians of the last `forward`.

        Args:
            color: (H, W, 3) gradient of the loss with respect to the color.
            transmittance: (H, W) likewise, or None for zero.
            depth: (H, W) likewise, or None for zero.
            normal: (H, W, 3) likewise, or None for zero.
        """
        ...


class ImageLoss(NamedTuple):
    """The loss (1 - w) l1 + w (1 - ssim) for a given weight w, and its gradient.

    Attributes:
        l1: mean absolute difference.
        ssim: mean structural similarity (Wang et al. 2004).
        gradient: (H, W, 3) gradient of the loss with respect to the image.
    """

    l1: float | Tensor
    ssim: float | Tensor
    gradient: Tensor


class Adam(Protocol):
    """One step of Adam, in place, on the rows `ids` (V,) of parameters (N, D) and their moments; other rows stay.

    `gradient` (V, D) has one row for each of `ids`; `learning_rate` is one number or one per column (D,); `step` counts
    the steps from 1, for all rows together.
    """

    def __call__(
        self,
        parameters: Tensor,
        first: Tensor,
        second: Tensor,
        gradient: Tensor,
        ids: Tensor,
        learning_rate: float | Tensor,
        step: int,
        betas: tuple[float, float] = ...,
        eps: float = ...,
    ) -> None:
        """Update parameters and moments."""


class Kernels(Protocol):
    """The names that the module of each device provides."""

    @property
    def Rasterizer(self) -> Callable[[], Rasterizer]:
        """Create a rasterizer."""
        ...

    @property
    def image_loss(self) -> Callable[[Tensor, Tensor, float], ImageLoss]:
        """Compute the loss of an image, its target and the weight of 1 - SSIM."""
        ...

    @property
    def adam(self) -> Adam:
        """Apply one step of Adam."""
        ...

    @property
    def morton_order(self) -> Callable[[Tensor], Tensor] | None:
        """Return the Morton order (N,) of means (N, 3); None if the device is equally fast with any order."""
        ...
