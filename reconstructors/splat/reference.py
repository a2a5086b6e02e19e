"""The rasterizer written plainly from the papers, in float64 torch, with derivatives by autograd.

It shares no code with the kernels and uses no tile and no bound: every Gaussian is looked at from every pixel. It is
what they are tested against, on small images.

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

from reconstructors.splat.interface import Drawn, GaussianTensors, ImageLoss, Pulled
from reconstructors.splat.view import View

# As float32 rounds them: two Gaussians held at 0.99 leave 1e-4 of a ray, all but exactly, and on which side of the
# threshold that is must not depend on the type.
_LEAST_ALPHA, _MOST_ALPHA, _LEAST_TRANSMITTANCE = (float(np.float32(x)) for x in (1 / 255, 0.99, 1e-4))
_DILATION = 0.3  # square pixels
_LEAST_QUATERNION = 1e-24  # squared length
_MOST_DETERMINANT = 1e36  # of the covariance in pixels, to the fourth: float32 has no room for much more
_PAIRS_AT_ONCE = 1_000_000  # of a pixel and a Gaussian: 8 MB a number


class Projection(NamedTuple):
    """What is seen of the Gaussians that are drawn, nearest first.

    Attributes:
        ids: (M,) which Gaussians.
        xy: (M, 2) projected means, pixels.
        inverse: (M, 2, 2) of the dilated covariance in pixels.
        opacities: (M,).
        depth: (M,) of the means.
        slope: (M, 2) of the depth over pixels.
        normal: (M, 3) shortest axis in the camera's frame, towards the camera.
        color: (M, 3).
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
    """(N, 3, 3) of quaternions (N, 4) wxyz of any length above zero."""
    w, x, y, z = (quats / quats.norm(dim=1, keepdim=True)).unbind(1)
    rows = [
        [w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z],
    ]
    return torch.stack([torch.stack(row, dim=1) for row in rows], dim=1)


def harmonics(directions: Tensor, count: int) -> Tensor:
    """(N, count) real spherical harmonics of unit directions (N, 3), with the Condon-Shortley phase: by degree l, then
    by order m from -l to l.

    Y is a constant times the m-th derivative of the Legendre polynomial of z times the imaginary (m < 0) or the real
    part of (x + iy)^|m|.
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
    """The coefficients, by rising power, of the derivative of this order of a Legendre polynomial."""
    coefficients: list[float] = Legendre.basis(degree).deriv(order).convert(kind=Polynomial).coef.tolist()
    return coefficients


def project(gaussians: GaussianTensors, view: View) -> Projection:
    """The Gaussians in the image, but for those behind `near`, fainter than 1/255 or without a rotation."""
    means, quats, scales, opacities, sh = gaussians
    rotation, position = means.new_tensor(view.rotation), means.new_tensor(view.position)
    offsets = means - position
    depths = offsets @ rotation[2]
    may = (depths > view.near) & (opacities > _LEAST_ALPHA) & ((quats**2).sum(dim=1) > _LEAST_QUATERNION)
    ids = may.nonzero()[:, 0]
    ids = ids[torch.argsort(depths[ids], stable=True)]
    offsets, quats, scales, opacities, sh = offsets[ids], quats[ids], scales[ids], opacities[ids], sh[ids]

    center = offsets @ rotation.T
    x, y, z = center.unbind(1)
    left, right, top, bottom = view.limits
    axes = rotation @ rotations(quats)
    covariance = axes @ torch.diag_embed(scales**2) @ axes.mT
    zero = torch.zeros_like(z)
    across = torch.stack([view.fx / z, zero, -view.fx * (x / z).clamp(left, right) / z], dim=1)
    down = torch.stack([zero, view.fy / z, -view.fy * (y / z).clamp(top, bottom) / z], dim=1)
    jacobian = torch.stack([across, down], dim=1)
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
    fits = torch.linalg.det(in_pixels) < _MOST_DETERMINANT
    return Projection(*(part[fits] for part in projection))


class Blended(NamedTuple):
    """`Drawn` before it is an image, with the same sums over one number a Gaussian, and who is seen at all."""

    drawn: Drawn
    covered: Tensor
    seen: Tensor


def blend(splats: Projection, numbers: Tensor, view: View, background: Tensor) -> Blended:
    """Front to back, by the thresholds of Kerbl et al.: what is fainter than 1/255 is skipped, alpha is at most 0.99,
    and a ray ends before the Gaussian that would leave less than 1e-4.

    Args:
        numbers: (M,) of each splat, blended as colours are.
    """
    u, v = torch.arange(view.width) + 0.5, torch.arange(view.height) + 0.5
    pixels = torch.stack([u.repeat(view.height), v.repeat_interleave(view.width)], dim=1).to(splats.xy)
    features = torch.cat([splats.color, splats.normal, numbers[:, None]], dim=1)
    parts, seen = [], torch.zeros(len(splats.ids), dtype=torch.bool, device=splats.xy.device)
    for chunk in pixels.split(max(1, _PAIRS_AT_ONCE // max(1, len(splats.ids)))):
        none = chunk.new_zeros(len(chunk), 1)
        offset = chunk[:, None] - splats.xy
        square = torch.einsum("pni,nij,pnj->pn", offset, splats.inverse, offset)
        alpha = splats.opacities * torch.exp(-square / 2)
        shown = alpha >= _LEAST_ALPHA
        alpha = torch.where(shown, alpha.clamp(max=_MOST_ALPHA), 0)
        with torch.no_grad():
            left = torch.cumprod(1 - alpha, dim=1)
            halved = torch.cat([(left < 0.5) & shown, none == 0], dim=1)
            median = halved.to(torch.uint8).argmax(dim=1)  # the first of those, or the last column
        alpha = torch.where(left >= _LEAST_TRANSMITTANCE, alpha, 0)
        through = torch.cumprod(torch.cat([1 - none, 1 - alpha], dim=1), dim=1)
        weight = alpha * through[:, :-1]
        plane = splats.depth + (offset * splats.slope).sum(dim=2)
        sums = weight @ features
        seen |= shown.any(dim=0)
        parts.append(
            (
                sums[:, :3] + through[:, -1:] * background,
                through[:, -1],
                (weight * plane).sum(dim=1),
                sums[:, 3:6],
                torch.cat([plane.detach(), none], dim=1).gather(1, median[:, None])[:, 0],
                sums[:, 6],
            )
        )
    color, transmittance, depth, normal, median_depth, covered = (torch.cat(part) for part in zip(*parts, strict=True))
    size = (view.height, view.width)
    drawn = Drawn(
        color.reshape(*size, 3),
        transmittance.reshape(size),
        depth.reshape(size),
        normal.reshape(*size, 3),
        median_depth.reshape(size),
    )
    return Blended(drawn, covered.reshape(size), seen)


def draw(gaussians: GaussianTensors, view: View, background: Tensor) -> Drawn:
    """The image, differentiable by autograd in the type of the tensors."""
    splats = project(gaussians, view)
    return blend(splats, torch.zeros_like(splats.depth), view, background).drawn


class ReferenceRasterizer:
    """The interface of the other devices, in float64 whatever type is given. It keeps the graph of what it drew."""

    def forward(
        self,
        gaussians: GaussianTensors,
        view: View,
        background: Tensor,
        *,
        geometry: bool,
        gradient: bool = True,
    ) -> Drawn:
        with torch.enable_grad():
            self._leaves = GaussianTensors(*(tensor.detach().double().requires_grad_() for tensor in gaussians))
            self._splats = project(self._leaves, view)
            self._ones = torch.ones_like(self._splats.depth).requires_grad_()
            self._blended = blend(self._splats, self._ones, view, background.double())
        color, transmittance, *rest = (image.detach() for image in self._blended.drawn if image is not None)
        return Drawn(color, transmittance, *(rest if geometry else (None, None, None)))

    def backward(
        self,
        color: Tensor,
        transmittance: Tensor | None,
        depth: Tensor | None,
        normal: Tensor | None,
        error: Tensor | None,
    ) -> Pulled:
        splats, drawn = self._splats, self._blended.drawn
        order = torch.argsort(splats.ids[self._blended.seen])
        ids = splats.ids[self._blended.seen][order]
        pairs = [
            (drawn.color, color),
            (drawn.transmittance, transmittance),
            (drawn.depth, depth),
            (drawn.normal, normal),
        ]
        wanted = [(image, gradient.double()) for image, gradient in pairs if gradient is not None]
        outputs, gradients = zip(*wanted, strict=True)
        *by_given, by_xy = torch.autograd.grad(
            outputs, (*self._leaves, splats.xy), gradients, retain_graph=True, allow_unused=True, materialize_grads=True
        )
        covered = self._blended.covered
        weights = [torch.ones_like(covered), torch.zeros_like(covered) if error is None else error.double()]
        sums = [torch.autograd.grad(covered, self._ones, weight, retain_graph=True)[0] for weight in weights]
        per_splat = [part[self._blended.seen][order] for part in (by_xy, *sums)]
        return Pulled(ids, *(gradient[ids] for gradient in by_given), *per_splat)


Rasterizer = ReferenceRasterizer  # the name in `reconstructors.splat.interface.Kernels`


def image_loss(image: Tensor, target: Tensor, ssim_weight: float) -> ImageLoss:
    """(1 - w) mean |x - y| + w (1 - SSIM) of images (H, W, 3), in float64.

    The means and covariances of SSIM are taken under a Gaussian window of 11 x 11 pixels and standard deviation 1.5 for
    each channel, with zeros beyond the border; C1 = 0.01^2, C2 = 0.03^2.
    """
    ramp = torch.arange(11, dtype=torch.float64, device=image.device) - 5
    bell = torch.exp(-(ramp**2) / (2 * 1.5**2))
    window = torch.outer(bell, bell) / bell.sum() ** 2

    def smooth(channels: Tensor) -> Tensor:
        return torch.nn.functional.conv2d(channels[:, None], window[None, None], padding=5)[:, 0]

    with torch.enable_grad():
        shown = image.detach().double().requires_grad_()
        x, y = shown.permute(2, 0, 1), target.double().permute(2, 0, 1)
        mean_x, mean_y = smooth(x), smooth(y)
        xx, yy, xy = smooth(x * x) - mean_x**2, smooth(y * y) - mean_y**2, smooth(x * y) - mean_x * mean_y
        likeness = (2 * mean_x * mean_y + 0.01**2) * (2 * xy + 0.03**2)
        ssim = (likeness / ((mean_x**2 + mean_y**2 + 0.01**2) * (xx + yy + 0.03**2))).mean()
        l1 = (x - y).abs().mean()
        loss = (1 - ssim_weight) * l1 + ssim_weight * (1 - ssim)
        (gradient,) = torch.autograd.grad(loss, shown)
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
    """One step of Adam, in place, on the rows `ids` of parameters (N, D) and their moments; other rows stay.

    Args:
        gradient: (V, D) of those rows.
        step: from 1, of all rows alike.
    """
    first[ids] = betas[0] * first[ids] + (1 - betas[0]) * gradient
    second[ids] = betas[1] * second[ids] + (1 - betas[1]) * gradient**2
    mean, square = first[ids] / (1 - betas[0] ** step), second[ids] / (1 - betas[1] ** step)
    parameters[ids] -= learning_rate * mean / (square.sqrt() + eps)
