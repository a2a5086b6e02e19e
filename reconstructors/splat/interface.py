"""What the rasterizers of every device take and give.

Each device has a module of `Kernels`: `reconstructors.splat.cpu`, `reconstructors.splat.cuda`, and the plain
`reconstructors.splat.reference` that the two are tested against. Tensors are of one device, contiguous and float32; the
reference works and answers in float64.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple, Protocol

from reconstructors.splat.view import View

if TYPE_CHECKING:
    from torch import Tensor


class GaussianTensors(NamedTuple):
    """N Gaussians as they are drawn.

    Attributes:
        means: (N, 3).
        quats: (N, 4) wxyz of any length.
        scales: (N, 3) standard deviations along the axes.
        opacities: (N,) 0 to 1.
        sh: (N, K, 3) spherical harmonics, K = 1, 4, 9 or 16; the color is their sum plus 0.5, and at least 0.
    """

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    sh: Tensor


class Drawn(NamedTuple):
    """The sums over the Gaussians of each pixel, w being the weight (alpha times transmittance) of one of them.

    Attributes:
        color: (H, W, 3) sum of w color, plus the transmittance times the background.
        transmittance: (H, W) what is left behind the last Gaussian: 1 minus the sum of w.
        depth: (H, W) sum of w times the depth of the Gaussian's plane at the pixel; None where it was not asked for.
        normal: (H, W, 3) sum of w times the unit normal in the camera's frame, towards the camera; or None.
        median_depth: (H, W) of the plane of the Gaussian at which the transmittance falls below 0.5; 0 where it stays
            above; or None. It has no gradient.
    """

    color: Tensor
    transmittance: Tensor
    depth: Tensor | None
    normal: Tensor | None
    median_depth: Tensor | None


class Pulled(NamedTuple):
    """The derivatives of the loss by the V Gaussians that were drawn, and what density control asks of them.

    Attributes:
        ids: (V,) int64, rising: which Gaussians.
        means, quats, scales, opacities, sh: (V, 3), (V, 4), (V, 3), (V,), (V, K, 3) derivatives.
        screen: (V, 2) by the projected mean, per pixel.
        weight: (V,) sum over the pixels of w.
        error: (V,) sum over the pixels of w times the error given there; 0 where none was given.
    """

    ids: Tensor
    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    sh: Tensor
    screen: Tensor
    weight: Tensor
    error: Tensor


class Rasterizer(Protocol):
    """Draws one view and then gives the derivatives of what it drew; its buffers serve the next view again."""

    def forward(
        self,
        gaussians: GaussianTensors,
        view: View,
        background: Tensor,
        *,
        geometry: bool,
        gradient: bool = True,
    ) -> Drawn:
        """Draw Gaussians before a background (3,).

        Args:
            geometry: whether depth, normal and median depth are wanted.
            gradient: whether `backward` may follow.
        """
        ...

    def backward(
        self,
        color: Tensor,
        transmittance: Tensor | None,
        depth: Tensor | None,
        normal: Tensor | None,
        error: Tensor | None,
    ) -> Pulled:
        """From the derivatives of the loss by what `forward` gave last, each of the shape of that.

        Args:
            error: (H, W) the error of each pixel, for `Pulled.error`.
        """
        ...


class ImageLoss(NamedTuple):
    """(1 - w) l1 + w (1 - ssim), w being the weight given, and its derivative.

    Attributes:
        l1: mean absolute difference.
        ssim: mean structural similarity (Wang et al. 2004).
        gradient: (H, W, 3) of the loss by the image.
    """

    l1: float | Tensor
    ssim: float | Tensor
    gradient: Tensor


class Adam(Protocol):
    """One step of Adam, in place, on the rows `ids` (V,) of parameters (N, D) and their moments; other rows stay.

    `gradient` (V, D) is of those rows; `learning_rate` of all columns, or of each (D,); `step` counts from 1, of all
    rows alike.
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
    ) -> None: ...


class Kernels(Protocol):
    """What the module of each device has."""

    @property
    def Rasterizer(self) -> Callable[[], Rasterizer]: ...
    @property
    def image_loss(self) -> Callable[[Tensor, Tensor, float], ImageLoss]: ...
    @property
    def adam(self) -> Adam: ...
    @property
    def morton_order(self) -> Callable[[Tensor], Tensor] | None:
        """The order (N,) of means (N, 3) in which neighbours are together; None where the device is as fast in any."""
        ...
