"""A small training of a radiance field: a box of random colors before a sky, seen from a circle."""

from functools import cache

import numpy as np
import torch

from pcbench.geometry.cameras import Camera, Intrinsics, look_at
from reconstructors.field.model import CHANNELS, STEP, VoxelField, aligned_rows
from reconstructors.field.native import _field
from reconstructors.field.train import FieldSchedule, FieldTraining
from reconstructors.splat.photographs import Photograph
from reconstructors.splat.view import View

CORNER = np.full(3, 1.0)


def new_view(number: int = 0) -> View:
    """Return one of 12 views from a circle."""
    angle = number * np.pi / 6
    position = (4 * np.cos(angle), 4 * np.sin(angle), 2.5)
    return View.of(Camera(f"{number}", Intrinsics.from_fov(40, 30, 40), look_at(position, (0, 0, 0))))


@cache
def _true_field() -> VoxelField:
    rng = np.random.default_rng(3)
    field = VoxelField.dense(-CORNER, CORNER, 8)
    inside = np.abs(field.positions()).max(axis=1) < 0.8
    field.values[:, 0] = np.where(inside, 4.0, -4.0)
    field.values[:, 1:4] = rng.uniform(-1.5, 1.5, (len(field), 3))
    field.background[1:4] = 1.0
    return field


@cache
def _photographs() -> list[Photograph]:
    views = [new_view(number) for number in range(12)]
    images = [_true_field().render_geometry(view).color.clamp(0, 1) for view in views]
    return [
        Photograph(f"{number}", view, (255 * image).round().to(torch.uint8), None)
        for number, (view, image) in enumerate(zip(views, images, strict=True))
    ]


def new_training(steps: int = 40, rays: int = 512, seed: int = 0) -> FieldTraining:
    """Return a training from 6 to 24 voxels across."""
    return FieldTraining(
        VoxelField.dense(-1.2 * CORNER, 1.2 * CORNER, 6),
        [[photograph] for photograph in _photographs()],
        FieldSchedule(steps=steps, rays=rays, shares=(0.3, 0.6), seed=seed),
    )


def arrays_of(field: VoxelField) -> tuple[bytes, ...]:
    """Return all numbers of a field as bytes."""
    return tuple(np.ascontiguousarray(part).tobytes() for part in (field.values, field.vertices, field.background))


def gradients_of(training: FieldTraining):
    """Return a function that computes the gradients of the first step as bytes."""
    field, rng = training.model, np.random.default_rng(0)
    count = training.schedule.rays
    rays, targets = training._pixels.draw(rng, count)
    local, offsets, occupied = field.local_rays(rays), rng.random(count, dtype=np.float32), field.occupied_blocks()
    gradients, touched = aligned_rows(len(field)), np.zeros(len(field), np.uint8)
    weights, background = np.zeros(len(field), np.float32), np.zeros(CHANNELS, np.float32)

    def compute() -> bytes:
        gradients[:] = 0
        background[:] = 0
        arrays = field.values, field.links, occupied, field.background
        results = gradients, touched, weights, background
        _field.gradients(*arrays, STEP, *local, offsets, targets, *results)
        return gradients.tobytes()

    return compute
