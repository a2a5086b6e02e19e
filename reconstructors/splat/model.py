"""A model of Gaussians during training: unbounded parameters in a local frame about the scene."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.cameras import Camera
from pcbench.geometry.neighbors import Index
from pcbench.geometry.transform import Similarity
from reconstructors.splat.devices import kernels_of
from reconstructors.splat.interface import GaussianTensors, RasterOutput
from reconstructors.splat.view import View

if TYPE_CHECKING:
    import torch
    from torch import Tensor

SH_DC = 0.28209479177387814  # the spherical harmonic of degree 0
_INITIAL_OPACITY = 0.1
_OPAQUE = 0.5  # minimum opacity of the Gaussians on the surface, unless all are below it
_SPACING_NEIGHBORS = 3  # neighbors whose mean distance is the initial size of a Gaussian


@dataclass(frozen=True)
class LocalFrame:
    """The frame of training: centred on the cameras, in units of their spread.

    Projected coordinates have more digits than the float32 of the model, and the learning rates are meant for scenes of
    about unit size.

    Args:
        origin: (3,) origin in the world, float64.
        unit: unit of the frame, in the world's unit.
    """

    origin: FloatArray
    unit: float

    @classmethod
    def of(cls, cameras: list[Camera]) -> LocalFrame:
        """Return a frame centred on the cameras.

        The origin is their mean position, the unit 1.1 times the largest distance from it (Kerbl et al. 2023).
        """
        positions = np.array([camera.position for camera in cameras])
        origin = positions.mean(axis=0)
        spread = float(np.linalg.norm(positions - origin, axis=1).max())
        return cls(origin, 1.1 * spread if spread > 0 else 1.0)

    def to_local(self, points: FloatArray) -> FloatArray:
        """Return world points (N, 3) in this frame."""
        local: FloatArray = (points - self.origin) / self.unit
        return local

    def to_world(self, points: FloatArray) -> FloatArray:
        """Return points (N, 3) of this frame in the world."""
        world: FloatArray = np.asarray(points, dtype=np.float64) * self.unit + self.origin
        return world

    def camera(self, camera: Camera) -> Camera:
        """Return the same camera in this frame."""
        motion = camera.cam_from_world
        translation = (motion.rotation @ self.origin + motion.translation) / self.unit
        return replace(camera, cam_from_world=Similarity(motion.rotation, translation))


@dataclass(frozen=True, eq=False)
class Gaussians:
    """N Gaussians, float32, in a `LocalFrame`.

    Args:
        means: (N, 3).
        quats: (N, 4) wxyz of any norm.
        log_scales: (N, 3) natural logarithms of the standard deviations along the axes.
        logits: (N,) logits of the opacities.
        sh: (N, K, 3) spherical harmonics coefficients, K = 1, 4, 9 or 16; color is their sum plus 0.5.
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
        """(N,) opacities, 0 to 1."""
        return self.logits.sigmoid()

    @property
    def tensors(self) -> GaussianTensors:
        """The Gaussians as a rasterizer reads them."""
        return GaussianTensors(self.means, self.quats, self.scales, self.opacities, self.sh)

    @property
    def degree(self) -> int:
        """Degree of the spherical harmonics."""
        return {1: 0, 4: 1, 9: 2, 16: 3}[self.sh.shape[1]]

    @classmethod
    def from_points(
        cls, points: FloatArray, colors: NDArray[np.float64], frame: LocalFrame, opacity: float = _INITIAL_OPACITY
    ) -> Gaussians:
        """Create a round Gaussian at each of at least two points.

        The size is the mean distance to the three nearest other points (Kerbl et al. 2023).

        Args:
            points: (N, 3) in the world.
            colors: (N, 3) 0 to 1.
            frame: the frame of the model.
            opacity: initial opacity of all Gaussians.
        """
        import torch

        local = frame.to_local(np.asarray(points, dtype=np.float64))
        count = len(local)
        neighbors = Index(local).query(local, min(_SPACING_NEIGHBORS + 1, count))
        spacing = np.maximum(neighbors.distances[:, 1:].mean(axis=1), 1e-7)
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

    def render_geometry(self, view: View) -> RasterOutput:
        """Render a view with depths and normals over black (see `reconstructors.splat.depths.SurfaceModel`)."""
        rasterizer = kernels_of(self.means.device).Rasterizer()
        return rasterizer.forward(self.tensors, view, self.means.new_zeros(3), geometry=True, gradient=False)

    def surface_points(self) -> FloatArray:
        """Return the means (M, 3) of the opaque Gaussians."""
        opacities = self.opacities.detach().cpu().numpy()
        opaque = opacities >= min(_OPAQUE, opacities.max(initial=0))
        means: FloatArray = self.means.detach().cpu().numpy()[opaque].astype(np.float64)
        return means

    def select(self, rows: Tensor) -> Gaussians:
        """Return the Gaussians selected by indices or a mask."""
        return Gaussians(*(getattr(self, field.name)[rows].contiguous() for field in fields(self)))

    def to(self, device: torch.device) -> Gaussians:
        """Return the same Gaussians on a device."""
        return Gaussians(*(getattr(self, field.name).to(device) for field in fields(self)))

    def concatenate(self, others: Gaussians) -> Gaussians:
        """Return these and then other Gaussians of the same degree."""
        import torch

        return Gaussians(
            *(torch.cat([getattr(self, field.name), getattr(others, field.name)]) for field in fields(self))
        )
