"""The differentiable rasterizer: images of Gaussians with gradients with respect to all of their parameters."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from pcbench.errors import InputError
from pcbench.extras import require
from pcbench.geometry.cameras import Camera
from reconstructors.splat.devices import kernels_of
from reconstructors.splat.view import View

if TYPE_CHECKING:
    from torch import Tensor

_SH_COUNTS = (1, 4, 9, 16)  # spherical harmonics of degrees 0 to 3
_MAX_QUATERNION_COMPONENT = 1e18  # the squares of larger ones overflow float32


class Rendering(NamedTuple):
    """The images of Gaussians in a pinhole camera, float32.

    Attributes:
        color: (H, W, 3); not clamped above, so it exceeds 1 if the spherical harmonics do.
        alpha: (H, W) 0 to 1, the share of the background that is hidden.
        depth: (H, W) depth along the viewing direction, in the world's unit: the mean of the depths of the Gaussians'
            planes at the pixel, weighted as in blending; 0 where alpha is 0. On an oblique surface it is too small,
            mostly by less than its change within a pixel: nearer Gaussians hide farther ones, and the dilation of 0.3
            square pixels flattens their planes.
        normal: (H, W, 3) in the camera's frame, towards the camera: the weighted sum of the Gaussians' unit normals
            (their shortest axes), of norm at most `alpha`.
        median_depth: (H, W) depth of the plane of the Gaussian at which alpha exceeds 0.5; 0 where it stays below. It
            has no gradient.
    """

    color: Tensor
    alpha: Tensor
    depth: Tensor
    normal: Tensor
    median_depth: Tensor


def rasterize(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    sh: Tensor,
    camera: Camera,
    *,
    background: Tensor | Sequence[float] = (0.0, 0.0, 0.0),
) -> Rendering:
    """Render N Gaussians as a camera sees them (Kerbl et al. 2023; plane depth after Zhang et al. 2024).

    Tensors are on one device, the CPU or a CUDA device, and of any floating type. Means are transformed to the camera
    in float64 and rendered in float32, so projected coordinates in float64 lose no precision; all other tensors are
    converted to float32. Each tensor, `background` included, gets its gradient in its own type; the camera gets none.
    Second derivatives are not available.

    A Gaussian is drawn if its mean is deeper than 0.01, its opacity exceeds 1/255, the norm of its quaternion exceeds
    1e-12, and it is smaller than about 1e9 pixels. The dilation adds 0.3 square pixels to its projected covariance.
    Alpha below 1/255 at a pixel is skipped, alpha is at most 0.99, and a ray ends before its transmittance falls below
    1e-4.

    Memory beside the given tensors, until the gradient has been computed: 44 bytes per pixel, most of them returned; 36
    bytes per Gaussian for its mean relative to the camera, and a float32 copy of each tensor of another type; and the
    buffers of the rasterizer. On the CPU these take about 100 bytes per Gaussian and 32 bytes for each Gaussian in each
    tile of 16 x 16 pixels that it touches, 92 bytes with gradients.

    Args:
        means: (N, 3) in the world.
        quats: (N, 4) wxyz of any norm, components up to 1e18: rotations from the Gaussians' axes to the world.
        scales: (N, 3) standard deviations along the axes, 0 or more.
        opacities: (N,) 0 to 1.
        sh: (N, K, 3) coefficients of K = 1, 4, 9 or 16 real spherical harmonics, in the order and with the signs of
            Kerbl et al.; color is their sum plus 0.5, clamped at 0.
        camera: a pinhole; undistort photographs with distortion first.
        background: (3,) color behind the Gaussians.

    Returns:
        The images and their gradients through torch autograd.

    Raises:
        InputError: a shape, type, device or value is not one of the above, or the camera has distortion.
        MissingExtra: torch, or a package that CUDA needs, is not installed.
    """
    torch = require("torch")
    from reconstructors.splat.autograd import Rasterize

    if not isinstance(camera, Camera):
        raise InputError(f"expected a pcbench Camera, got {type(camera).__name__}")
    view = View.of(camera)
    tensors = {"means": means, "quats": quats, "scales": scales, "opacities": opacities, "sh": sh}
    _check_shapes(tensors)
    device = means.device
    kernels = kernels_of(device)
    background = _as_background(background).to(device, torch.float32)
    # Relative to the camera: world coordinates may have more digits than float32.
    offsets = means.to(torch.float64) - torch.as_tensor(view.position, device=device)
    inputs = {name: tensor.to(torch.float32) for name, tensor in (tensors | {"means": offsets}).items()}
    _check_values(inputs, background)
    color, transmittance, depth, normal, median_depth = Rasterize.apply(
        kernels.Rasterizer(), replace(view, position=np.zeros(3)), background, *inputs.values()
    )
    alpha = 1 - transmittance
    return Rendering(color, alpha, depth / torch.where(alpha > 0, alpha, 1), normal, median_depth)


def _as_background(values: Tensor | Sequence[float]) -> Tensor:
    """Return the background as a tensor (3,), or raise InputError."""
    import torch

    try:
        background = torch.as_tensor(values)
    except (TypeError, ValueError, RuntimeError) as error:
        raise InputError(f"expected a background of three numbers, got {values!r}") from error
    if background.shape != (3,):
        raise InputError(f"expected a background of shape (3,), got {tuple(background.shape)}")
    if background.is_complex():
        raise InputError(f"expected a background of three real numbers, got {background.dtype}")
    return background


def _check_shapes(tensors: dict[str, Tensor]) -> None:
    """Raise InputError unless the tensors have the shapes of N Gaussians and are on one device."""
    import torch

    for name, tensor in tensors.items():
        if not isinstance(tensor, torch.Tensor):
            raise InputError(f"expected {name} as a torch tensor, got {type(tensor).__name__}")
        if not tensor.is_floating_point():
            raise InputError(f"expected {name} of a floating type, got {tensor.dtype}")
        if tensor.layout != torch.strided:
            raise InputError(f"expected {name} as a dense tensor, got {tensor.layout}: take its to_dense()")
    means, sh = tensors["means"], tensors["sh"]
    count = len(means) if means.ndim else 0
    wanted = {"means": (count, 3), "quats": (count, 4), "scales": (count, 3), "opacities": (count,)}
    for name, shape in wanted.items():
        if tensors[name].shape != shape:
            rows = "N" if name == "means" else str(count)
            expected = ", ".join([rows, *map(str, shape[1:])]) + ("," if len(shape) == 1 else "")
            raise InputError(f"expected {name} of shape ({expected}), got {tuple(tensors[name].shape)}")
    if sh.ndim != 3 or sh.shape != (count, sh.shape[1], 3) or sh.shape[1] not in _SH_COUNTS:
        raise InputError(f"expected sh of shape ({count}, K, 3) with K = 1, 4, 9 or 16, got {tuple(sh.shape)}")
    for name, tensor in tensors.items():
        if tensor.device != means.device:
            raise InputError(f"expected tensors on one device: means are on {means.device}, {name} on {tensor.device}")


def _check_values(inputs: dict[str, Tensor], background: Tensor) -> None:
    """Raise InputError if a value is not finite or out of range, with one synchronisation with the device."""
    import torch

    tensors = {name: tensor.detach() for name, tensor in (inputs | {"background": background}).items()}
    tensors = {name: tensor for name, tensor in tensors.items() if tensor.numel()}
    ends = torch.stack([end for tensor in tensors.values() for end in torch.aminmax(tensor)]).tolist()
    lowest = dict(zip(tensors, ends[::2], strict=True))
    highest = dict(zip(tensors, ends[1::2], strict=True))
    for name, tensor in tensors.items():
        if not np.isfinite([lowest[name], highest[name]]).all():  # aminmax propagates NaN
            bad = (~tensor.isfinite()).reshape(len(tensor), -1).any(dim=1).nonzero()
            raise InputError(
                f"expected finite {name}, got NaN or Inf in {len(bad)} of {len(tensor)}, first {int(bad[0])}"
            )
    largest = max(-lowest.get("quats", 0), highest.get("quats", 0))
    if largest > _MAX_QUATERNION_COMPONENT:
        raise InputError(
            f"expected quats with components up to {_MAX_QUATERNION_COMPONENT:g}, got {largest:g}: normalize them"
        )
    if lowest.get("scales", 0) < 0:
        raise InputError(f"expected scales of 0 or more, got {lowest['scales']:g}: take exp() of logarithms")
    if lowest.get("opacities", 0) < 0 or highest.get("opacities", 0) > 1:
        raise InputError(
            f"expected opacities from 0 to 1, got {lowest['opacities']:g} to {highest['opacities']:g}: take the sigmoid"
            " of logits"
        )
