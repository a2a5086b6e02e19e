"""The compiled rays against a slow implementation in float64, and against finite differences."""

import numpy as np
import pytest
from optional import import_or_skip

torch = import_or_skip("torch")

from reconstructors.field.model import CHANNELS, STEP, RayBatch, VoxelField, aligned_rows  # noqa: E402
from reconstructors.field.native import _field  # noqa: E402

HARMONICS = (0.282094792, 0.488602512)


def random_field(rng, shape=(6, 9, 7), stored=0.7):
    """Return a field with missing vertices and negative densities."""
    vertices = np.flatnonzero(rng.random(np.prod(shape)) < stored).astype(np.int32)
    values = aligned_rows(len(vertices))
    values[:, 0] = rng.normal(0.3, 0.5, len(vertices))
    values[:, 1:13] = rng.normal(0, 0.5, (len(vertices), 12))
    background = np.zeros(CHANNELS, np.float32)
    background[1:13] = rng.normal(0, 0.5, 12)
    return VoxelField.sparse(np.array([1.0, -2.0, 0.5]), 0.25, shape, vertices, values, background)


def random_rays(rng, field, count):
    """Return rays from outside and from inside through the grid, some of which miss it."""
    size = field.voxel * (np.array(field.links.shape) - 1)
    origins = field.origin + size / 2 + rng.normal(0, 1, (count, 3)) * size
    targets = field.origin + rng.uniform(-0.1, 1.1, (count, 3)) * size
    directions = targets - origins
    return RayBatch(origins, directions / np.linalg.norm(directions, axis=1, keepdims=True))


def slow_rays(field, rays, offsets, values, background):
    """Return colors (R, 3) and transmittances (R,) by autograd; no early end, no empty blocks."""
    shape = torch.tensor(field.links.shape)
    links = torch.from_numpy(field.links.astype(np.int64))
    padded = torch.cat([values, torch.zeros(1, CHANNELS, dtype=values.dtype)])  # row -1: not stored
    origins = torch.from_numpy((rays.origins - field.origin) / field.voxel)
    directions = torch.from_numpy(rays.directions)
    x, y, z = directions.T
    one = torch.ones_like(x)
    basis = torch.stack([HARMONICS[0] * one, -HARMONICS[1] * y, HARMONICS[1] * z, -HARMONICS[1] * x], 1)
    sides = torch.stack([-origins / directions, (shape - 1 - origins) / directions])
    enter = sides.min(0).values.max(1).values.clamp(min=0)
    leave = sides.max(0).values.min(1).values
    count = int(((leave - enter).max() / STEP).ceil()) + 1
    t = enter[:, None] + (torch.arange(count) + torch.from_numpy(offsets)[:, None]) * STEP
    inside = t < leave[:, None]
    positions = origins[:, None] + t[..., None] * directions[:, None]
    cell = positions.floor().long().clamp(min=0).minimum(shape - 2)
    fraction = (positions - cell).clamp(0, 1)
    row = 0
    for corner in np.ndindex(2, 2, 2):
        at = cell + torch.tensor(corner)
        weight = torch.where(torch.tensor(corner, dtype=torch.bool), fraction, 1 - fraction).prod(-1)
        row = row + weight[..., None] * padded[links[at[..., 0], at[..., 1], at[..., 2]]]
    density = row[..., 0].clamp(min=0) * inside
    colors = 0.5 + torch.einsum("rk,rskc->rsc", basis, row[..., 1:13].reshape(*row.shape[:2], 4, 3))
    depth = (density * STEP).cumsum(1)
    behind = torch.exp(-depth)
    weights = torch.cat([torch.ones(len(depth), 1), behind[:, :-1]], 1) - behind
    sky = 0.5 + torch.einsum("rk,kc->rc", basis, background[1:13].reshape(4, 3))
    color = (weights[..., None] * colors).sum(1) + behind[:, -1:] * sky
    return color, behind[:, -1], (weights * t).sum(1) * field.voxel


def compiled_gradients(field, rays, offsets, targets):
    gradients, touched = aligned_rows(len(field)), np.zeros(len(field), np.uint8)
    weights, grad_background = np.zeros(len(field), np.float32), np.zeros(CHANNELS, np.float32)
    error = _field.gradients(
        field.values,
        field.links,
        field.occupied_blocks(),
        field.background,
        STEP,
        *field.local_rays(rays),
        offsets,
        targets,
        gradients,
        touched,
        weights,
        grad_background,
    )
    return error, gradients, grad_background, touched, weights


def test_gradients_are_those_of_autograd_in_float64():
    rng = np.random.default_rng(1)
    field = random_field(rng)
    rays, offsets = random_rays(rng, field, 60), rng.random(60, dtype=np.float32)
    targets = rng.random((60, 3), dtype=np.float32)
    values = torch.from_numpy(field.values.astype(np.float64)).requires_grad_()
    background = torch.from_numpy(field.background.astype(np.float64)).requires_grad_()
    color, _, _ = slow_rays(field, rays, offsets.astype(np.float64), values, background)
    expected = ((color - torch.from_numpy(targets)) ** 2).sum()
    expected.backward()
    error, gradients, grad_background, touched, weights = compiled_gradients(field, rays, offsets, targets)
    assert error == pytest.approx(expected.item(), rel=1e-5)
    scale = values.grad.abs().max()
    # A ray ends at a transmittance of 1e-4; the rest is rounding to float32.
    assert np.abs(gradients - values.grad.numpy()).max() < 5e-4 * scale
    assert np.abs(grad_background - background.grad.numpy()).max() < 5e-4 * background.grad.abs().max()
    assert not gradients[touched == 0].any() and touched.any() and not touched.all()
    assert ((weights > 0) <= (touched == 1)).all() and weights.max() <= 1


def test_gradients_are_finite_differences():
    rng = np.random.default_rng(2)
    field = random_field(rng, stored=1.0)
    field.values[:, 0] = rng.uniform(0.05, 0.4, len(field))  # differentiable: no density is clamped
    rays, offsets = random_rays(rng, field, 50), rng.random(50, dtype=np.float32)
    targets = rng.random((50, 3), dtype=np.float32)
    _, gradients, _, _, _ = compiled_gradients(field, rays, offsets, targets)
    for row, channel in zip(rng.integers(0, len(field), 20), [0, 1, 5, 9, 12] * 4, strict=True):
        errors = []
        for change in (0.02, -0.02):
            values = field.values.copy()
            values[row, channel] += change
            changed = VoxelField(field.origin, field.voxel, field.links, field.vertices, values, field.background)
            errors.append(compiled_gradients(changed, rays, offsets, targets)[0])
        # The error is summed in double, but the colors are float32.
        assert (errors[0] - errors[1]) / 0.04 == pytest.approx(gradients[row, channel], abs=2e-3)


def test_renderings_are_those_of_the_slow_implementation():
    rng = np.random.default_rng(3)
    field = random_field(rng)
    rays = random_rays(rng, field, 400)
    values, background = (torch.from_numpy(a.astype(np.float64)) for a in (field.values, field.background))
    color, transmittance, depth = slow_rays(field, rays, np.full(400, 0.5), values, background)
    rendering = field.render_rays(rays)
    assert np.abs(rendering.color - color.numpy()).max() < 1e-3  # a ray ends at a transmittance of 1e-4
    assert np.abs(rendering.transmittance - transmittance.numpy()).max() < 2e-4
    assert np.abs(rendering.depth - depth.numpy()).max() < 1e-3


def test_median_depth_and_normal_of_a_slab():
    """Density 4 per voxel for z < 6: half of the light is absorbed ln(2) / 4 voxels below its top at z = 6.5."""
    field = VoxelField.dense(np.zeros(3), np.array([8.0, 8.0, 12.0]), 12)
    z = field.positions()[:, 2]
    field.values[:, 0] = np.where(z <= 6, 4.0, -4.0)  # 0 halfway between the vertices at 6 and 7
    rays = RayBatch(np.array([[4.2, 4.3, 20.0]]), np.array([[0.0, 0.0, -1.0]]))
    rendering = field.render_rays(rays)
    # The density grows by 8 per voxel below z = 6.5: 4 s^2 = ln(2).
    expected = 13.5 + np.sqrt(np.log(2) / 4)
    assert rendering.median_depth[0] == pytest.approx(expected, abs=0.1)  # samples are half a voxel apart
    normal = rendering.normal[0]
    assert normal / np.linalg.norm(normal) == pytest.approx([0, 0, 1])
    away = RayBatch(rays.origins, -rays.directions)
    assert field.render_rays(away).transmittance[0] == 1 and field.render_rays(away).median_depth[0] == 0


def test_refining_interpolates():
    rng = np.random.default_rng(4)
    field = random_field(rng, stored=1.0)
    slopes = rng.normal(size=(3, CHANNELS)).astype(np.float32)
    field.values[:] = field.positions() @ slopes
    refined = field.refine()
    assert refined.links.shape == (11, 17, 13) and len(refined) == refined.links.size
    expected = refined.positions() @ slopes
    expected[:, 0] /= 2  # per voxel
    assert np.allclose(refined.values, expected, atol=1e-5)


def test_vertices_that_are_not_stored_count_as_empty_when_refined():
    field = random_field(np.random.default_rng(4))
    dense = aligned_rows(field.links.size)
    dense[field.vertices] = field.values
    links = np.arange(field.links.size, dtype=np.int32)
    full = VoxelField(field.origin, field.voxel, links.reshape(field.links.shape), links, dense, field.background)
    refined, refined_full = field.refine(), full.refine()
    assert len(refined) < len(refined_full)
    assert (refined.values == refined_full.values[refined.vertices]).all()
    others = np.setdiff1d(refined_full.vertices, refined.vertices)
    assert not refined_full.values[others].any()


def test_smoothing_is_the_gradient_of_the_total_variation():
    rng = np.random.default_rng(5)
    field = random_field(rng, shape=(4, 5, 3), stored=0.8)
    dense = torch.zeros(4 * 5 * 3, CHANNELS, dtype=torch.float64)
    values = torch.from_numpy(field.values.astype(np.float64)).requires_grad_()
    dense = dense.index_put((torch.from_numpy(field.vertices.astype(np.int64)),), values).reshape(4, 5, 3, CHANNELS)
    stored = torch.from_numpy(field.links >= 0)
    variation = 0
    for axis in range(3):
        count = field.links.shape[axis] - 1
        one, two = dense.narrow(axis, 0, count), dense.narrow(axis, 1, count)
        both = stored.narrow(axis, 0, count) & stored.narrow(axis, 1, count)
        variation = variation + (((one - two) ** 2 + 1e-4).sqrt() * both[..., None]).sum()
    variation.backward()
    # With a learning rate of 0 only the moments change: the squares of the first gradient.
    moments = aligned_rows(len(field))
    before = field.values.copy()
    gradients, touched = aligned_rows(len(field)), np.ones(len(field), np.uint8)
    zeros, ones = np.zeros(CHANNELS, np.float32), np.full(CHANNELS, 0.5, np.float32)
    _field.update(field.values, moments, gradients, touched, field.vertices, field.links, zeros, ones)
    assert np.allclose(moments, (0.5 * values.grad.numpy()) ** 2, atol=1e-5)
    assert (field.values == before).all() and not gradients.any() and not touched.any()
