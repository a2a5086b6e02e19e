"""Rotation of many vectors by quaternions."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from torch import Tensor


def rotate(quats: Tensor, vectors: Tensor) -> Tensor:
    """Return vectors (N, 3) rotated by quaternions (N, 4) wxyz of any norm above zero."""
    import torch

    unit = quats / quats.norm(dim=1, keepdim=True)
    w, axis = unit[:, :1], unit[:, 1:]
    across = 2 * torch.linalg.cross(axis, vectors)
    return vectors + w * across + torch.linalg.cross(axis, across)
