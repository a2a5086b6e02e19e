"""An image of Gaussians, differentiable in all that they are."""

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

_HARMONICS = (1, 4, 9, 16)  # of degrees 0 to 3
_LONGEST = 1e18  # a number of a quaternion: a float32 has no room for the squares of more


class Rendering(NamedTuple):
    """What a pinhole sees of Gaussians, of type float32.

    Attributes:
        color: (H, W, 3), 0 to 1 where the harmonics say so; nothing bounds it above.
        alpha: (H, W) 0 to 1, the part of the background that is hidden.
        depth: (H, W) along the viewing direction, in the world's unit: the mean over the Gaussians of the pixel, by the
            weight with which they are blended, of the depths of their planes there; 0 where alpha is 0. Of a surface
            seen aslant it is too small, mostly by less than it changes within a pixel: the nearer Gaussians hide the
            farther, and their planes are flattened by the 0.3 square pixels below.
        normal: (H, W, 3) in the camera's frame, towards the camera: the sum of the Gaussians' unit normals (their
            shortest axes) by weight, of length `alpha` or less.
        median_depth: (H, W) depth of the plane of the Gaussian that makes alpha exceed 0.5; 0 where it stays below. It
            has no derivative.
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
    """The image that a camera takes of N Gaussians: Kerbl et al. 2023, with depth as a plane after Zhang et al. 2024.

    Tensors are on one device, the CPU or a CUDA device, and of any floating type. Means are brought to the camera in
    float64 and drawn in float32, so that projected coordinates lose nothing if they are float64 themselves; all else is
    drawn in float32. Derivatives reach every tensor, `background` too, in its own type; the camera has none, and there
    are none of second order.

    A Gaussian is drawn if its mean is deeper than 0.01, its opacity exceeds 1/255, its quaternion has a length
    (above 1e-12), and it is under some 1e9 pixels in size. 0.3 square pixels are added to its projected covariance.
    What would show with less than 1/255 at a pixel is skipped there; alpha is at most 0.99; a ray ends before less
    than 1e-4 of the background would be left.

    Memory beside the tensors given, until the derivative has been taken: 44 bytes a pixel, most of them returned; 36
    bytes a Gaussian for its mean about the camera, and a copy in float32 of what is of another type; and what the
    device's rasterizer holds, on the CPU some 100 bytes a Gaussian and 32 for each Gaussian in each tile of 16 x 16
    pixels that it touches, which the derivative makes 100.

    Args:
        means: (N, 3) in the world.
        quats: (N, 4) wxyz of any length up to 1e18: from a Gaussian's axes to the world.
        scales: (N, 3) standard deviations along the axes, 0 or more.
        opacities: (N,) 0 to 1.
        sh: (N, K, 3) coefficients of K = 1, 4, 9 or 16 real spherical harmonics, in the order and with the signs of
            Kerbl et al.; color is their sum plus 0.5, and at least 0.
        camera: a pinhole; photographs with distortion are undistorted first.
        background: (3,) color behind the Gaussians.

    Raises:
        InputError: a shape, a type, a device or a number is none of these, or the camera has distortion.
        MissingExtra: torch, or what CUDA needs, is not installed.
    """
    torch = require("torch")
    from reconstructors.splat.autograd import Rasterize

    if not isinstance(camera, Camera):
        raise InputError(f"expected a pcbench Camera, got {type(camera).__name__}")
    view = View.of(camera)
    given = {"means": means, "quats": quats, "scales": scales, "opacities": opacities, "sh": sh}
    _check_shapes(given)
    device = means.device
    kernels = kernels_of(device)
    behind = _background(background).to(device, torch.float32)
    # About the camera: world coordinates may have more digits than a float32.
    near = means.to(torch.float64) - torch.as_tensor(view.position, device=device)
    drawn_from = {name: tensor.to(torch.float32) for name, tensor in (given | {"means": near}).items()}
    _check_numbers(drawn_from, behind)
    color, transmittance, depth, normal, median_depth = Rasterize.apply(
        kernels.Rasterizer(), replace(view, position=np.zeros(3)), behind, *drawn_from.values()
    )
    alpha = 1 - transmittance
    return Rendering(color, alpha, depth / torch.where(alpha > 0, alpha, 1), normal, median_depth)


def _background(given: Tensor | Sequence[float]) -> Tensor:
    """As a tensor (3,), or InputError."""
    import torch

    try:
        background = torch.as_tensor(given)
    except (TypeError, ValueError, RuntimeError) as error:
        raise InputError(f"expected a background of three numbers, got {given!r}") from error
    if background.shape != (3,):
        raise InputError(f"expected a background of shape (3,), got {tuple(background.shape)}")
    if background.is_complex():
        raise InputError(f"expected a background of three real numbers, got {background.dtype}")
    return background


def _check_shapes(given: dict[str, Tensor]) -> None:
    """Raise InputError where the Gaussians are not N tensors of the right shapes on one device."""
    import torch

    for name, tensor in given.items():
        if not isinstance(tensor, torch.Tensor):
            raise InputError(f"expected {name} as a torch tensor, got {type(tensor).__name__}")
        if not tensor.is_floating_point():
            raise InputError(f"expected {name} of a floating type, got {tensor.dtype}")
        if tensor.layout != torch.strided:
            raise InputError(f"expected {name} as a dense tensor, got {tensor.layout}: take its to_dense()")
    means, sh = given["means"], given["sh"]
    count = len(means) if means.ndim else 0
    wanted = {"means": (count, 3), "quats": (count, 4), "scales": (count, 3), "opacities": (count,)}
    for name, shape in wanted.items():
        if given[name].shape != shape:
            rows = "N" if name == "means" else str(count)
            expected = ", ".join([rows, *map(str, shape[1:])]) + ("," if len(shape) == 1 else "")
            raise InputError(f"expected {name} of shape ({expected}), got {tuple(given[name].shape)}")
    if sh.ndim != 3 or sh.shape != (count, sh.shape[1], 3) or sh.shape[1] not in _HARMONICS:
        raise InputError(f"expected sh of shape ({count}, K, 3) with K = 1, 4, 9 or 16, got {tuple(sh.shape)}")
    for name, tensor in given.items():
        if tensor.device != means.device:
            raise InputError(f"expected tensors on one device: means are on {means.device}, {name} on {tensor.device}")


def _check_numbers(drawn_from: dict[str, Tensor], background: Tensor) -> None:
    """Raise InputError where a number is not finite or cannot be: one pass over each, one wait for the device."""
    import torch

    tensors = {name: tensor.detach() for name, tensor in (drawn_from | {"background": background}).items()}
    tensors = {name: tensor for name, tensor in tensors.items() if tensor.numel()}
    ends = torch.stack([end for tensor in tensors.values() for end in torch.aminmax(tensor)]).tolist()
    lowest = dict(zip(tensors, ends[::2], strict=True))
    highest = dict(zip(tensors, ends[1::2], strict=True))
    for name, tensor in tensors.items():
        if not np.isfinite([lowest[name], highest[name]]).all():  # NaN is both the least and the greatest
            bad = (~tensor.isfinite()).reshape(len(tensor), -1).any(dim=1).nonzero()
            raise InputError(
                f"expected finite {name}, got NaN or Inf in {len(bad)} of {len(tensor)}, first {int(bad[0])}"
            )
    longest = max(-lowest.get("quats", 0), highest.get("quats", 0))
    if longest > _LONGEST:
        raise InputError(f"expected quats of numbers up to {_LONGEST:g}, got {longest:g}: normalize them")
    if lowest.get("scales", 0) < 0:
        raise InputError(f"expected scales of 0 or more, got {lowest['scales']:g}: take exp() of logarithms")
    if lowest.get("opacities", 0) < 0 or highest.get("opacities", 0) > 1:
        raise InputError(
            f"expected opacities from 0 to 1, got {lowest['opacities']:g} to {highest['opacities']:g}: take the sigmoid"
            " of logits"
        )
