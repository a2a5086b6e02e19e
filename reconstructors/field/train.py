"""Training of a voxel radiance field on photographs, coarse to fine (Fridovich-Keil et al. 2022)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pcbench.errors import ReconstructionError
from pcbench.scratch import atomic_write
from reconstructors.field.model import CHANNELS, STEP, RayBatch, VoxelField, aligned_rows, view_rays
from reconstructors.field.native import _field
from reconstructors.splat.photographs import Photograph, Pyramid

BYTES_PER_VERTEX = 320  # values, moments and gradients, and new values while the grid is refined
BYTES_PER_PIXEL = 8  # of a photograph with its smaller sizes, and the colors that training reads
_SKIP_INTERVAL = 50  # steps between two searches for empty blocks
_PSNR_STEPS = 100  # steps over which PSNR is averaged
_DECAY, _TINY = np.float32(0.95), np.float32(1e-8)  # of RMSProp, as in native/rows.h


@dataclass(frozen=True)
class FieldSchedule:
    """Number of steps, and what changes during training.

    Attributes:
        steps: number of steps.
        rays: rays of a step, through random pixels of all photographs.
        shares: shares of the steps after which the voxels are halved. The photographs are halved as often before.
        min_weight: vertices whose largest blending weight is below this are removed before voxels are halved, except
            beside others.
        density_rate, color_rate: initial learning rates, which fall by `rate_decay` until the end.
        density_smoothing, color_smoothing: weights of the total variation.
        seed: seed of all random numbers.
        max_vertices: voxels are not halved if that could exceed this number of vertices.
    """

    steps: int = 3000
    rays: int = 4096
    shares: tuple[float, ...] = (0.2, 0.5)
    min_weight: float = 0.02
    density_rate: float = 2.0
    color_rate: float = 0.1
    rate_decay: float = 0.05
    density_smoothing: float = 1e-3
    color_smoothing: float = 1e-4
    seed: int = 0
    max_vertices: int = 10_000_000

    def level(self, step: int) -> int:
        """Return how often voxels are still halved after a step: the pyramid level of the photographs."""
        return sum(step < share * self.steps for share in self.shares)


class Pixels:
    """All valid pixels of photographs, from which rays are drawn.

    Args:
        photographs: photographs of which at least one has a valid pixel.
    """

    def __init__(self, photographs: Sequence[Photograph]) -> None:
        self._views = [photograph.view for photograph in photographs]
        self._colors = np.concatenate([photograph.color.numpy().reshape(-1, 3) for photograph in photographs])
        sizes = [view.width * view.height for view in self._views]
        self._starts = np.concatenate([[0], np.cumsum(sizes)])
        self._valid: NDArray[np.int64] | None = None
        if any(photograph.valid is not None for photograph in photographs):
            masks = [
                np.ones(size, np.bool_) if photograph.valid is None else photograph.valid.numpy().reshape(-1)
                for photograph, size in zip(photographs, sizes, strict=True)
            ]
            self._valid = np.flatnonzero(np.concatenate(masks))

    def draw(self, rng: np.random.Generator, count: int) -> tuple[RayBatch, NDArray[np.float32]]:
        """Return rays through random pixels, and their colors (R, 3) from 0 to 1."""
        pixels = rng.integers(0, self._starts[-1] if self._valid is None else len(self._valid), count)
        pixels = np.sort(pixels if self._valid is None else self._valid[pixels])  # neighbors read the same memory
        origins, directions = np.empty((count, 3)), np.empty((count, 3))
        bounds = np.searchsorted(pixels, self._starts)
        for view, start, begin, end in zip(self._views, self._starts, bounds, bounds[1:], strict=False):
            rows, columns = np.divmod(pixels[begin:end] - start, view.width)
            rays, _ = view_rays(view, rows, columns)
            origins[begin:end], directions[begin:end] = rays
        colors = np.divide(self._colors[pixels], 255, dtype=np.float32)
        return RayBatch(origins, directions), colors


class FieldTraining:
    """The state of a training. The same settings give the same result bit for bit with any number of threads.

    Attributes:
        model: the field.
        step: number of steps done.
        coarse: whether the voxels were not halved as often as planned, because the grid would not fit into memory.
    """

    converged = False  # training always takes all steps

    def __init__(self, field: VoxelField, photographs: Sequence[Pyramid], schedule: FieldSchedule) -> None:
        self.model = field
        self.schedule = schedule
        self.step = 0
        self.coarse = False
        self._photographs = photographs
        self._errors: list[float] = []
        self._moments = np.zeros_like(field.values)
        self._weights = np.zeros(len(field), np.float32)
        self._background_moments = np.zeros(CHANNELS, np.float32)
        self._prepare()

    def _prepare(self) -> None:
        """Allocate what a grid needs besides the saved state."""
        count = len(self.model)
        self._gradients, self._touched = aligned_rows(count), np.zeros(count, np.uint8)
        self._occupied = self.model.occupied_blocks()
        level = self.schedule.level(self.step)
        self._pixels = Pixels([_at_level(pyramid, level) for pyramid in self._photographs])

    @property
    def steps(self) -> int:
        """Number of steps of the schedule."""
        return self.schedule.steps

    def status(self) -> str:
        """Return PSNR and size of the field for a progress message."""
        recent = self._errors[-_PSNR_STEPS:]
        psnr = -10 * np.log10(max(float(np.mean(recent)), 1e-10)) if recent else float("nan")
        return f"PSNR {psnr:.1f} dB, {len(self.model):,} vertices"

    def run(self, until: int, on_step: Callable[[FieldTraining], None] | None = None) -> None:
        """Train up to a step, calling `on_step` after each step.

        Raises:
            ReconstructionError: the error of the photographs is not finite, or the field is empty.
        """
        while self.step < until:
            self._train_step()
            if on_step is not None:
                on_step(self)

    def _train_step(self) -> None:
        schedule = self.schedule
        if self.step and schedule.level(self.step) < schedule.level(self.step - 1):
            self._refine()
        elif self.step % _SKIP_INTERVAL == 0:
            self._occupied = self.model.occupied_blocks()
            if not self._occupied.any():
                raise ReconstructionError(
                    f"the field is empty at step {self.step}: the photographs agree on no surface; check the cameras"
                )
        field, rng = self.model, np.random.default_rng([schedule.seed, self.step])
        rays, targets = self._pixels.draw(rng, schedule.rays)
        offsets = rng.random(schedule.rays, dtype=np.float32)
        grad_background = np.zeros(CHANNELS, np.float32)
        total = _field.gradients(
            field.values,
            field.links,
            self._occupied,
            field.background,
            STEP,
            *field.local_rays(rays),
            offsets,
            targets,
            self._gradients,
            self._touched,
            self._weights,
            grad_background,
        )
        if not np.isfinite(total):
            raise ReconstructionError(
                f"training diverged at step {self.step}: the error is not finite; check the cameras"
            )
        decay = schedule.rate_decay ** (self.step / schedule.steps)
        rates = _channels(schedule.density_rate, schedule.color_rate) * np.float32(decay)
        smoothing = _channels(schedule.density_smoothing, schedule.color_smoothing)
        _field.update(
            field.values,
            self._moments,
            self._gradients,
            self._touched,
            field.vertices,
            field.links,
            rates,
            smoothing,
        )
        self._update_background(grad_background, rates)
        self.step += 1
        self._errors = [*self._errors[-_PSNR_STEPS:], total / (3 * schedule.rays)]

    def _update_background(self, gradient: NDArray[np.float32], rates: NDArray[np.float32]) -> None:
        """Apply the step of RMSProp that the compiled code applies to the vertices."""
        square, moments = gradient**2, self._background_moments
        moments[:] = np.where(moments > 0, _DECAY * moments + (1 - _DECAY) * square, square)
        self.model.background[:] -= rates * gradient / (np.sqrt(moments) + _TINY)

    def _refine(self) -> None:
        """Remove vertices that no photograph sees, and halve the voxels if they fit into memory."""
        field = self.model
        pruned = field.select(field.dilate((self._weights >= self.schedule.min_weight) & (field.values[:, 0] > 0)))
        if not len(pruned):
            raise ReconstructionError(
                f"the field is empty at step {self.step}: the photographs agree on no surface; check the cameras"
            )
        refined = pruned.refine() if 8 * len(pruned) <= self.schedule.max_vertices else None
        self.coarse = self.coarse or refined is None
        self.model = pruned if refined is None else refined
        self._moments = np.zeros_like(self.model.values)
        self._weights = np.zeros(len(self.model), np.float32)
        self._prepare()

    def save(self, path: Path, key: str) -> None:
        """Write a checkpoint, which `load` continues only with the same `key`."""
        with atomic_write(path) as file:
            np.savez(
                file,
                key=np.array(key),
                step=np.array(self.step),
                coarse=np.array(self.coarse),
                errors=np.array(self._errors),
                moments=self._moments,
                weights=self._weights,
                occupied=self._occupied,
                background_moments=self._background_moments,
                **_arrays(self.model),
            )

    def load(self, path: Path, key: str) -> bool:
        """Continue from a checkpoint; return False if it has another key."""
        with np.load(path, allow_pickle=False) as state:
            if str(state["key"]) != key:
                return False
            self.step, self.coarse = int(state["step"]), bool(state["coarse"])
            self.model = _field_of(state)
            self._errors = [float(error) for error in state["errors"]]
            self._moments, self._weights = state["moments"], state["weights"]
            self._background_moments = state["background_moments"]
            occupied = state["occupied"]
        self._prepare()
        self._occupied = occupied
        return True


def _at_level(pyramid: Pyramid, level: int) -> Photograph:
    """Return a photograph at the smallest size, down to a level, at which its mask leaves a pixel."""
    sizes = pyramid[: level + 1]
    return next((photograph for photograph in reversed(sizes) if photograph.has_valid_pixels), pyramid[0])


def save_field(path: Path, field: VoxelField) -> None:
    """Write a field."""
    with atomic_write(path) as file:
        np.savez(file, **_arrays(field))


def load_field(path: Path) -> VoxelField:
    """Return the field that `save_field` wrote."""
    with np.load(path, allow_pickle=False) as state:
        return _field_of(state)


def _arrays(field: VoxelField) -> dict[str, Any]:
    return {
        "origin": field.origin,
        "voxel": np.array(field.voxel),
        "shape": np.array(field.links.shape),
        "vertices": field.vertices,
        "values": field.values,
        "background": field.background,
    }


def _field_of(state: np.lib.npyio.NpzFile) -> VoxelField:
    values = aligned_rows(len(state["vertices"]))
    values[:] = state["values"]
    shape = tuple(int(n) for n in state["shape"])
    return VoxelField.sparse(
        state["origin"], float(state["voxel"]), shape, state["vertices"], values, state["background"]
    )


def _channels(density: float, color: float) -> NDArray[np.float32]:
    return np.array([density, *[color] * 12, 0, 0, 0], np.float32)
