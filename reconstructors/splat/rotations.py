"""Rotations by quaternions, of many at once."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from torch import Tensor


def rotated(quats: Tensor, vectors: Tensor) -> Tensor:
    """Vectors (N, 3) turned by quaternions (N, 4) wxyz of any length above zero."""
    import torch

    unit = quats / quats.norm(dim=1, keepdim=True)
    w, axis = unit[:, :1], unit[:, 1:]
    across = 2 * torch.linalg.cross(axis, vectors)
    return vectors + w * across + torch.linalg.cross(axis, across)
