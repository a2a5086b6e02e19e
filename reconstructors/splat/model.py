"""A model of Gaussians as it is trained: numbers without bounds, in a frame of its own about the scene."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.cameras import Camera
from pcbench.geometry.neighbors import Index
from pcbench.geometry.transform import Similarity
from reconstructors.splat.interface import GaussianTensors

if TYPE_CHECKING:
    import torch
    from torch import Tensor

SH_DC = 0.28209479177387814  # the spherical harmonic of degree 0
_FIRST_OPACITY = 0.1
_SPACING_NEIGHBORS = 3  # whose mean distance is a Gaussian's first size


@dataclass(frozen=True)
class LocalFrame:
    """Where training counts: about the cameras, in units of their spread. Projected coordinates have more digits than
    the float32 of the model, and learning rates are meant for scenes of about unit size.

    Args:
        origin: (3,) in the world, float64.
        unit: of the frame, in the world's.
    """

    origin: FloatArray
    unit: float

    @classmethod
    def of(cls, cameras: list[Camera]) -> LocalFrame:
        """About the cameras' mean position; the unit is 1.1 times the largest distance from it (Kerbl et al. 2023)."""
        positions = np.array([camera.position for camera in cameras])
        origin = positions.mean(axis=0)
        spread = float(np.linalg.norm(positions - origin, axis=1).max())
        return cls(origin, 1.1 * spread if spread > 0 else 1.0)

    def to_local(self, points: FloatArray) -> FloatArray:
        """World points (N, 3) in this frame."""
        local: FloatArray = (points - self.origin) / self.unit
        return local

    def to_world(self, points: FloatArray) -> FloatArray:
        """Points (N, 3) of this frame in the world."""
        world: FloatArray = np.asarray(points, dtype=np.float64) * self.unit + self.origin
        return world

    def camera(self, camera: Camera) -> Camera:
        """The same camera in this frame."""
        motion = camera.cam_from_world
        translation = (motion.rotation @ self.origin + motion.translation) / self.unit
        return replace(camera, cam_from_world=Similarity(motion.rotation, translation))


@dataclass(frozen=True, eq=False)
class Gaussians:
    """N Gaussians, float32, in a `LocalFrame`.

    Args:
        means: (N, 3).
        quats: (N, 4) wxyz of any length.
        log_scales: (N, 3) natural logarithms of the standard deviations along the axes.
        logits: (N,) of the opacities.
        sh: (N, K, 3) spherical harmonics, K = 1, 4, 9 or 16; color is their sum plus 0.5.
    """

    means: Tensor
    quats: Tensor
    log_scales: Tensor
    logits: Tensor
    sh: Tensor

    def __len__(self) -> int:
        return len(self.means)

    @property
    def scales(self) -> Tensor:
        """(N, 3) standard deviations along the axes."""
        return self.log_scales.exp()

    @property
    def opacities(self) -> Tensor:
        """(N,) 0 to 1."""
        return self.logits.sigmoid()

    @property
    def drawn_from(self) -> GaussianTensors:
        """What a rasterizer draws."""
        return GaussianTensors(self.means, self.quats, self.scales, self.opacities, self.sh)

    @property
    def degree(self) -> int:
        """Of the spherical harmonics."""
        return {1: 0, 4: 1, 9: 2, 16: 3}[self.sh.shape[1]]

    @classmethod
    def at_points(
        cls, points: FloatArray, colors: NDArray[np.float64], frame: LocalFrame, opacity: float = _FIRST_OPACITY
    ) -> Gaussians:
        """A round Gaussian at each point (N, 3) of the world, N > 1, of its color (N, 3) 0 to 1 and as large as the
        mean distance to the three nearest others (Kerbl et al. 2023)."""
        import torch

        local = frame.to_local(np.asarray(points, dtype=np.float64))
        count = len(local)
        found = Index(local).query(local, min(_SPACING_NEIGHBORS + 1, count))
        spacing = np.maximum(found.distances[:, 1:].mean(axis=1), 1e-7)
        quats = np.zeros((count, 4))
        quats[:, 0] = 1
        parts = (
            local,
            quats,
            np.log(spacing)[:, None].repeat(3, axis=1),
            np.full(count, np.log(opacity / (1 - opacity))),
            ((colors - 0.5) / SH_DC)[:, None, :],
        )
        return cls(*(torch.from_numpy(np.ascontiguousarray(part, dtype=np.float32)) for part in parts))

    def select(self, rows: Tensor) -> Gaussians:
        """Those of some rows, by number or by truth."""
        return Gaussians(*(getattr(self, field.name)[rows].contiguous() for field in fields(self)))

    def to(self, device: torch.device) -> Gaussians:
        """The same on a device."""
        return Gaussians(*(getattr(self, field.name).to(device) for field in fields(self)))

    def joined(self, others: Gaussians) -> Gaussians:
        """These and then others of the same degree."""
        import torch

        return Gaussians(
            *(torch.cat([getattr(self, field.name), getattr(others, field.name)]) for field in fields(self))
        )
