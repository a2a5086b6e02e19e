"""PatchMatch against planes in closed form, and against correlations computed in float64."""

import json
import os
import subprocess
import sys

import numpy as np
import pytest
from repository import TESTS
from textured_planes import PlaneScene, plane_scene
from wording import check_error

from reconstructors.mvs.patchmatch import (
    MAX_SIDE_PX,
    MAX_SOURCES,
    _SearchState,
    match,
    noise_variance,
    refine,
    window_variances,
)


def errors_px(scene: PlaneScene, depth):
    """Return the errors of a depth map as displacements in the first source, in pixels."""
    return np.abs(1 / depth - 1 / scene.depths[0]) * scene.focal * scene.baseline


@pytest.fixture(scope="module")
def slanted():
    scene = plane_scene(normal=(0.35, -0.2, -1.0))
    return scene, match(scene.views[0], scene.views[1:], (5.0, 20.0))


def test_slanted_plane_is_recovered(slanted):
    scene, depth_map = slanted
    assert np.median(errors_px(scene, depth_map.depth)) < 0.05
    assert np.mean(errors_px(scene, depth_map.depth) < 0.5) > 0.97
    cosines = depth_map.normal @ (np.array([0.35, -0.2, -1.0]) / np.linalg.norm([0.35, -0.2, -1.0]))
    assert np.degrees(np.arccos(np.median(cosines))) < 5
    assert np.median(depth_map.confidence) > 0.9


def test_exact_source_maps_improve_the_depths(slanted):
    scene, depth_map = slanted
    refined_map = refine(scene.views[0], scene.views[1:], scene.depths[1:], depth_map, (5.0, 20.0))
    assert errors_px(scene, refined_map.depth).mean() < errors_px(scene, depth_map.depth).mean()
    assert np.percentile(errors_px(scene, refined_map.depth), 99) < 0.5


def test_contradicting_source_maps_lower_the_confidence(slanted):
    scene, depth_map = slanted
    wrong_depths = [np.float32(1.3) * depth for depth in scene.depths[1:]]
    agreeing_map = refine(scene.views[0], scene.views[1:], scene.depths[1:], depth_map, (5.0, 20.0), iterations=0)
    contradicted_map = refine(scene.views[0], scene.views[1:], wrong_depths, depth_map, (5.0, 20.0), iterations=0)
    confidence_loss = (agreeing_map.confidence - contradicted_map.confidence)[40:-40, 60:-60]
    assert np.median(confidence_loss) == pytest.approx(0.6, abs=0.02)  # the cost is clamped at three pixels of 0.2 each


def correlation(scene: PlaneScene, x, y, normal, source, half_patches):
    """Compute the weighted correlation of Schonberger et al. (2016) in float64 with the exact homography."""
    reference, other = scene.views[0], scene.views[source]
    k = reference.camera.intrinsics
    offsets = np.stack(np.meshgrid(*[np.arange(-4, 5, 2)] * 2, indexing="xy"), axis=-1).reshape(-1, 2)
    if half_patches:
        offsets = offsets[offsets.sum(axis=1) % 4 == 0]
    patch = np.array([x, y]) + offsets
    ray = np.array([(x + 0.5 - k.cx) / k.fx, (y + 0.5 - k.cy) / k.fy, 1])
    rays = np.column_stack([(patch + 0.5 - [k.cx, k.cy]) / [k.fx, k.fy], np.ones(len(patch))])
    points = rays * (scene.depths[0][y, x] * (normal @ ray) / (rays @ normal))[:, None]
    world = reference.camera.cam_from_world.inverse().apply(points)
    height, width = other.gray.shape
    pixels = np.clip(other.camera.project(world)[0] - 0.5, 0, [width - 1.001, height - 1.001])  # clamped to the border
    reference_gray = reference.gray[patch[:, 1], patch[:, 0]].astype(float)
    column, row = np.floor(pixels).astype(int).T
    fx, fy = (pixels - np.floor(pixels)).T
    gray = other.gray.astype(float)
    source_gray = (
        (gray[row, column] * (1 - fx) + gray[row, column + 1] * fx) * (1 - fy)
        + (gray[row + 1, column] * (1 - fx) + gray[row + 1, column + 1] * fx) * fy
    )  # fmt: skip
    difference = reference_gray - reference.gray[y, x]
    weights = np.exp(-(offsets**2).sum(axis=1) / (2 * 4.0**2) - difference**2 / (2 * 25.0**2))
    weights /= weights.sum()
    a, b = reference_gray - weights @ reference_gray, source_gray - weights @ source_gray
    return weights @ (a * b) / np.sqrt((weights @ a**2) * (weights @ b**2))


@pytest.mark.parametrize("half_patches", [False, True])
def test_costs_match_the_correlation_in_float64(half_patches):
    normal = np.array([0.35, -0.2, -1.0]) / np.linalg.norm([0.35, -0.2, -1.0])
    scene = plane_scene(normal=(0.35, -0.2, -1.0))
    height, width = scene.depths[0].shape
    planes = np.empty((height, width, 4), np.float32)
    planes[..., 0], planes[..., 1:] = 1.01 * scene.depths[0], normal
    state = _SearchState.initial(planes.copy(), len(scene.views) - 1)
    state.improve(scene.views[0], scene.views[1:], None, (5.0, 20.0), 0, 0, 0, half_patches=half_patches)
    offset_scene = scene._replace(depths=[1.01 * scene.depths[0]])
    rng = np.random.default_rng(1)
    for source in range(1, len(scene.views)):
        rows, columns = np.indices((height, width)).reshape(2, -1)
        k, camera = scene.views[0].camera.intrinsics, scene.views[source].camera
        points = k.directions(np.stack([columns + 0.5, rows + 0.5], axis=1)) * offset_scene.depths[0].reshape(-1, 1)
        projections = camera.project(scene.views[0].camera.cam_from_world.inverse().apply(points))[0] - 0.5
        margin = np.minimum(projections, np.array([width - 1, height - 1]) - projections).min(axis=1)
        inside_reference = (
            np.minimum(np.minimum(columns, width - 1 - columns), np.minimum(rows, height - 1 - rows)) >= 4
        )
        # Patches completely inside the source, and patches that extend beyond its border.
        for selection in (inside_reference & (margin > 8), inside_reference & (margin > 0) & (margin < 3)):
            for pixel in rng.choice(np.flatnonzero(selection), 10, replace=False):
                expected = 1 - correlation(offset_scene, columns[pixel], rows[pixel], normal, source, half_patches)
                assert state.view_costs[rows[pixel], columns[pixel], source - 1] == pytest.approx(expected, abs=3e-3)


def test_untextured_plane_has_no_confidence():
    scene = plane_scene(contrast=0)
    assert np.mean(match(scene.views[0], scene.views[1:], (5.0, 20.0)).confidence > 0) < 0.01


@pytest.mark.parametrize("sigma", [pytest.param(0.5, marks=pytest.mark.long), 6])
def test_noise_variance_ignores_texture(sigma):
    flat = plane_scene(contrast=0, noise=sigma).views[0].gray
    assert noise_variance(flat) == pytest.approx(sigma**2 + 1 / 12, rel=0.35)
    smooth = plane_scene(noise=sigma, width=480, height=320).views[0].gray  # twice as many pixels per wave
    assert noise_variance(smooth) < 4 * (sigma**2 + 1 / 12)


def test_masked_pixels_have_no_depth(slanted):
    scene, _ = slanted
    valid = np.ones(scene.depths[0].shape, bool)
    valid[:, :60] = False
    depth_map = match(scene.views[0]._replace(valid=valid), scene.views[1:], (5.0, 20.0))
    assert not depth_map.depth[:, :60].any() and not depth_map.confidence[:, :60].any()
    assert depth_map.depth[:, 64:].all()
    masked_sources = [view._replace(valid=np.zeros_like(valid)) for view in scene.views[1:]]
    assert not match(scene.views[0], masked_sources, (5.0, 20.0)).confidence.any()


def test_unusable_input_is_refused(slanted):
    scene, _ = slanted
    with check_error():
        match(scene.views[0], [], (5.0, 20.0))
    with check_error():
        match(scene.views[0], [scene.views[1]] * (MAX_SOURCES + 1), (5.0, 20.0))
    with check_error():
        match(scene.views[0], scene.views[1:], (0.0, 20.0))
    wide_view = scene.views[1]._replace(gray=np.zeros((1, MAX_SIDE_PX + 1), np.uint8))
    with check_error():
        match(scene.views[0], [wide_view], (5.0, 20.0))


DIGEST_SCRIPT = """
import hashlib, json, sys
sys.path[:0] = {path!r}
from textured_planes import plane_scene
from reconstructors.mvs.native import _patchmatch
from reconstructors.mvs.patchmatch import match, refine

scene = plane_scene(normal=(0.35, -0.2, -1.0), width=151)
depth_map = match(scene.views[0], scene.views[1:], (5.0, 20.0), iterations=2)
depth_map = refine(scene.views[0], scene.views[1:], scene.depths[1:], depth_map, (5.0, 20.0), iterations=1)
digest = hashlib.sha256()
for array in (depth_map.depth, depth_map.normal, depth_map.confidence):
    digest.update(array.tobytes())
print(json.dumps([_patchmatch.isa(), digest.hexdigest()]))
"""


def run_digest_script(**environment):
    return subprocess.run(
        [sys.executable, "-c", DIGEST_SCRIPT.format(path=[str(TESTS)])],
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
    )


@pytest.fixture(scope="module")
def baseline_digest():
    process = run_digest_script(PCBENCH_ISA="baseline", OMP_NUM_THREADS="1")
    isa, digest = json.loads(process.stdout)
    assert isa == "baseline"
    return digest


@pytest.mark.parametrize("isa, threads", [("baseline", "3"), ("avx2", "1"), ("avx512", "2")])
def test_same_bits_with_any_instruction_set_and_thread_count(baseline_digest, isa, threads):
    process = run_digest_script(PCBENCH_ISA=isa, OMP_NUM_THREADS=threads)
    if "PCBENCH_ISA: expected an instruction set that this machine supports" in process.stderr:
        pytest.skip(f"this machine has no {isa}: there is nothing to compare with the baseline")
    assert json.loads(process.stdout) == [isa, baseline_digest], process.stderr


def test_window_variances_are_those_of_each_window():
    gray = np.random.default_rng(0).integers(0, 256, (12, 15)).astype(np.uint8)
    variances = window_variances(gray, 5)
    expected = np.lib.stride_tricks.sliding_window_view(gray, (5, 5)).var(axis=(2, 3))
    np.testing.assert_allclose(variances[2:-2, 2:-2], expected, rtol=1e-9)
    np.testing.assert_allclose(window_variances(np.full((6, 7), 200, np.uint8), 3), 0, atol=1e-9)
