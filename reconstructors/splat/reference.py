"""Reference rasterizer: a direct implementation of the papers in float64 torch, with gradients by autograd.

It shares no code with the kernels and uses neither tiles nor bounds: each Gaussian is evaluated at each pixel. The
kernels are tested against it, on small images.

Papers: Zwicker et al. 2001, EWA volume splatting (the projection); Kerbl et al. 2023, 3D Gaussian splatting (colour,
order and thresholds); Zhang et al. 2024, RaDe-GS (depth as a plane); Wang et al. 2004 (SSIM); Kingma and Ba 2015
(Adam).
"""

from __future__ import annotations

import math
from functools import cache
from typing import NamedTuple

import numpy as np
import torch
from numpy.polynomial import Legendre, Polynomial
from torch import Tensor

from reconstructors.splat.interface import GaussianTensors, Gradients, ImageLoss, RasterOutput
from reconstructors.splat.view import View

_MAX_ALPHA = float(np.float32(0.99))  # rounded like the cutoffs of a view
_DILATION = 0.3  # square pixels
_MIN_SQUARED_QUATERNION = 1e-24  # squared length
_MAX_DETERMINANT = 1e36  # of the covariance in pixels, in pixels^4: float32 overflows not far above
_PAIRS_AT_ONCE = 1_000_000  # pairs of a pixel and a Gaussian: 8 MB per value


class Projection(NamedTuple):
    """Projections of the M Gaussians that are drawn, nearest first.

    Attributes:
        ids: (M,) indices of the Gaussians.
        xy: (M, 2) projected means, in pixels.
        inverse: (M, 2, 2) inverse of the dilated covariance in pixels.
        opacities: (M,) opacities.
        depth: (M,) depths of the means.
        slope: (M, 2) change of the depth per pixel.
        normal: (M, 3) shortest axis in the camera's frame, towards the camera.
        color: (M, 3) colors in the direction of view.
    """

    ids: Tensor
    xy: Tensor
    inverse: Tensor
    opacities: Tensor
    depth: Tensor
    slope: Tensor
    normal: Tensor
    color: Tensor


def rotations(quats: Tensor) -> Tensor:
    """Return the rotation matrices (N, 3, 3) of quaternions (N, 4) wxyz of any norm above zero."""
    w, x, y, z = (quats / quats.norm(dim=1, keepdim=True)).unbind(1)
    rows = [
        [w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z],
    ]
    return torch.stack([torch.stack(row, dim=1) for row in rows], dim=1)


def harmonics(directions: Tensor, count: int) -> Tensor:
    """Return real spherical harmonics (N, count) of unit directions (N, 3), with the Condon-Shortley phase.

    The order is by degree l, then by order m from -l to l. Y is a constant times the m-th derivative of the Legendre
    polynomial of z times the imaginary (m < 0) or the real part of (x + iy)^|m|.
    """
    x, y, z = directions.unbind(1)
    values = []
    for degree in range(math.isqrt(count)):
        for order in range(-degree, degree + 1):
            m = abs(order)
            real, imaginary = torch.ones_like(x), torch.zeros_like(x)
            for _ in range(m):
                real, imaginary = x * real - y * imaginary, x * imaginary + y * real
            legendre = sum(c * z**power for power, c in enumerate(_legendre(degree, m)))
            norm = math.sqrt((2 * degree + 1) / (4 * math.pi) * math.factorial(degree - m) / math.factorial(degree + m))
            if m:
                norm *= math.sqrt(2) * (-1) ** m
            values.append(norm * legendre * (imaginary if order < 0 else real))
    return torch.stack(values, dim=1)


@cache
def _legendre(degree: int, order: int) -> list[float]:
    """Return the coefficients, by ascending power, of the derivative of this order of a Legendre polynomial."""
    coefficients: list[float] = Legendre.basis(degree).deriv(order).convert(kind=Polynomial).coef.tolist()
    return coefficients


def project(gaussians: GaussianTensors, view: View) -> Projection:
    """Project the Gaussians deeper than `near`, with an opacity above the minimum alpha and a rotation."""
    means, quats, scales, opacities, sh = gaussians
    min_alpha, _, _ = view.cutoffs
    rotation, position = means.new_tensor(view.rotation), means.new_tensor(view.position)
    offsets = means - position
    depths = offsets @ rotation[2]
    valid = (depths > view.near) & (opacities > min_alpha) & ((quats**2).sum(dim=1) > _MIN_SQUARED_QUATERNION)
    ids = valid.nonzero()[:, 0]
    ids = ids[torch.argsort(depths[ids], stable=True)]
    offsets, quats, scales, opacities, sh = offsets[ids], quats[ids], scales[ids], opacities[ids], sh[ids]

    center = offsets @ rotation.T
    x, y, z = center.unbind(1)
    left, right, top, bottom = view.limits
    axes = rotation @ rotations(quats)
    covariance = axes @ torch.diag_embed(scales**2) @ axes.mT  # Kerbl et al. 2023, eq. 6
    zero = torch.zeros_like(z)
    across = torch.stack([view.fx / z, zero, -view.fx * (x / z).clamp(left, right) / z], dim=1)
    down = torch.stack([zero, view.fy / z, -view.fy * (y / z).clamp(top, bottom) / z], dim=1)
    jacobian = torch.stack([across, down], dim=1)
    # Kerbl et al. 2023, eq. 5: the covariance is that in the axes of the camera.
    in_pixels = jacobian @ covariance @ jacobian.mT + _DILATION * torch.eye(2, dtype=z.dtype, device=z.device)
    inverse = torch.linalg.inv(in_pixels)
    slope = inverse @ (jacobian @ covariance[:, :, 2:])

    first = (scales[:, 0] < scales[:, 1]) & (scales[:, 0] < scales[:, 2])
    shortest = torch.where(first, 0, torch.where(scales[:, 1] < scales[:, 2], 1, 2))
    normal = axes[torch.arange(len(ids), device=z.device), :, shortest]
    away = (normal * center).sum(dim=1, keepdim=True) > 0
    normal = torch.where(away, -normal, normal)

    directions = offsets / offsets.norm(dim=1, keepdim=True)
    color = (harmonics(directions, sh.shape[1])[:, :, None] * sh).sum(dim=1) + 0.5
    projection = Projection(
        ids,
        torch.stack([view.fx * x / z + view.cx, view.fy * y / z + view.cy], dim=1),
        inverse,
        opacities,
        z,
        slope[:, :, 0],
        normal,
        color.clamp(min=0),
    )
    fits = torch.linalg.det(in_pixels) < _MAX_DETERMINANT
    return Projection(*(part[fits] for part in projection))


class Blended(NamedTuple):
    """The images, and a mask of the Gaussians with any visible pixel."""

    output: RasterOutput
    visible: Tensor


def blend(projection: Projection, view: View, background: Tensor) -> Blended:
    """Blend front to back (Kerbl et al. 2023).

    Alpha below the view's minimum is skipped, alpha is at most 0.99, and a ray ends before the Gaussian that would
    leave less than the view's minimum of transmittance.

    Args:
        projection: the Gaussians, nearest first.
        view: the pinhole.
        background: (3,) color behind the Gaussians.
    """
    min_alpha, _, min_transmittance = view.cutoffs
    u, v = torch.arange(view.width) + 0.5, torch.arange(view.height) + 0.5
    pixels = torch.stack([u.repeat(view.height), v.repeat_interleave(view.width)], dim=1).to(projection.xy)
    features = torch.cat([projection.color, projection.normal], dim=1)
    parts, visible = [], torch.zeros(len(projection.ids), dtype=torch.bool, device=projection.xy.device)
    for chunk in pixels.split(max(1, _PAIRS_AT_ONCE // max(1, len(projection.ids)))):
        zeros = chunk.new_zeros(len(chunk), 1)
        offset = chunk[:, None] - projection.xy
        square = torch.einsum("pni,nij,pnj->pn", offset, projection.inverse, offset)
        alpha = projection.opacities * torch.exp(-square / 2)  # Kerbl et al. 2023, eq. 4
        contributes = alpha >= min_alpha
        alpha = torch.where(contributes, alpha.clamp(max=_MAX_ALPHA), 0)
        with torch.no_grad():
            transmittances = torch.cumprod(1 - alpha, dim=1)
            before_end = transmittances >= min_transmittance
            below_half = torch.cat([(transmittances < 0.5) & contributes & before_end, zeros == 0], dim=1)
            median = below_half.to(torch.uint8).argmax(dim=1)  # the first true column, or the last column
        alpha = torch.where(before_end, alpha, 0)
        transmittance_before = torch.cumprod(torch.cat([1 - zeros, 1 - alpha], dim=1), dim=1)
        weight = alpha * transmittance_before[:, :-1]
        plane = projection.depth + (offset * projection.slope).sum(dim=2)
        sums = weight @ features  # Kerbl et al. 2023, eq. 3
        visible |= contributes.any(dim=0)
        parts.append(
            (
                sums[:, :3] + transmittance_before[:, -1:] * background,
                transmittance_before[:, -1],
                (weight * plane).sum(dim=1),
                sums[:, 3:6],
                torch.cat([plane.detach(), zeros], dim=1).gather(1, median[:, None])[:, 0],
            )
        )
    color, transmittance, depth, normal, median_depth = (torch.cat(part) for part in zip(*parts, strict=True))
    size = (view.height, view.width)
    output = RasterOutput(
        color.reshape(*size, 3),
        transmittance.reshape(size),
        depth.reshape(size),
        normal.reshape(*size, 3),
        median_depth.reshape(size),
    )
    return Blended(output, visible)


def render(gaussians: GaussianTensors, view: View, background: Tensor) -> RasterOutput:
    """Return the images, differentiable by autograd in the type of the tensors."""
    return blend(project(gaussians, view), view, background).output


class ReferenceRasterizer:
    """The interface of the other devices, in float64 for any input type; it keeps the graph of the last rendering."""

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
        """Render the Gaussians."""
        with torch.enable_grad():
            self._leaves = GaussianTensors(*(tensor.detach().double().requires_grad_() for tensor in gaussians))
            self._projection = project(self._leaves, view)
            self._blended = blend(self._projection, view, background.double())
        color, transmittance, depth, *rest = (image.detach() for image in self._blended.output if image is not None)
        if not geometry:
            return RasterOutput(color, transmittance, None, None, None)
        return RasterOutput(color, transmittance, depth, *(rest if normals else (None, None)))

    def backward(
        self,
        color: Tensor,
        transmittance: Tensor | None,
        depth: Tensor | None,
        normal: Tensor | None,
    ) -> Gradients:
        """Return the gradients of the last rendering by autograd."""
        projection, output = self._projection, self._blended.output
        order = torch.argsort(projection.ids[self._blended.visible])
        ids = projection.ids[self._blended.visible][order]
        pairs = [
            (output.color, color),
            (output.transmittance, transmittance),
            (output.depth, depth),
            (output.normal, normal),
        ]
        used = [(image, gradient.double()) for image, gradient in pairs if gradient is not None]
        outputs, gradients = zip(*used, strict=True)
        *grad_gaussians, grad_xy = torch.autograd.grad(
            outputs,
            (*self._leaves, projection.xy),
            gradients,
            retain_graph=True,
            allow_unused=True,
            materialize_grads=True,
        )
        grad_screen = grad_xy[self._blended.visible][order]
        return Gradients(ids, *[*(gradient[ids] for gradient in grad_gaussians), grad_screen])


Rasterizer = ReferenceRasterizer  # the name in `reconstructors.splat.interface.Kernels`


def image_loss(image: Tensor, target: Tensor, ssim_weight: float) -> ImageLoss:
    """Compute (1 - w) mean |x - y| + w (1 - SSIM) of images (H, W, 3) and its gradient, in float64.

    The means and covariances of SSIM are computed with a Gaussian window of 11 x 11 pixels and standard deviation 1.5
    for each channel, with zeros beyond the border; C1 = 0.01^2, C2 = 0.03^2.
    """
    ramp = torch.arange(11, dtype=torch.float64, device=image.device) - 5
    bell = torch.exp(-(ramp**2) / (2 * 1.5**2))
    window = torch.outer(bell, bell) / bell.sum() ** 2

    def smooth(channels: Tensor) -> Tensor:
        return torch.nn.functional.conv2d(channels[:, None], window[None, None], padding=5)[:, 0]

    with torch.enable_grad():
        leaf = image.detach().double().requires_grad_()
        x, y = leaf.permute(2, 0, 1), target.double().permute(2, 0, 1)
        mean_x, mean_y = smooth(x), smooth(y)
        xx, yy, xy = smooth(x * x) - mean_x**2, smooth(y * y) - mean_y**2, smooth(x * y) - mean_x * mean_y
        numerator = (2 * mean_x * mean_y + 0.01**2) * (2 * xy + 0.03**2)
        # Wang et al. 2004, eq. 13
        ssim = (numerator / ((mean_x**2 + mean_y**2 + 0.01**2) * (xx + yy + 0.03**2))).mean()
        l1 = (x - y).abs().mean()
        loss = (1 - ssim_weight) * l1 + ssim_weight * (1 - ssim)  # Kerbl et al. 2023, eq. 7
        (gradient,) = torch.autograd.grad(loss, leaf)
    return ImageLoss(l1.detach(), ssim.detach(), gradient)


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
        ids: (V,) indices of the rows.
        learning_rate: one for all columns, or one per column (D,).
        step: number of steps from 1, for all rows together.
        betas: decay rates of the two moments.
        eps: added to the denominator.
    """
    first[ids] = betas[0] * first[ids] + (1 - betas[0]) * gradient
    second[ids] = betas[1] * second[ids] + (1 - betas[1]) * gradient**2
    mean, square = first[ids] / (1 - betas[0] ** step), second[ids] / (1 - betas[1] ** step)
    parameters[ids] -= learning_rate * mean / (square.sqrt() + eps)
