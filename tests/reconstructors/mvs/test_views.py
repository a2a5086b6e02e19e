"""Photographs as pinholes take them: against photographs of those pinholes."""

import numpy as np
import pytest
import textured_corner as corner
from exact_maps import corner_map
from PIL import Image

from pcbench.geometry.cameras import Camera, Intrinsics
from pcbench.geometry.transform import Similarity
from pcbench.io.colmap_model import write_colmap_model
from pcbench.scenes import read_scene
from reconstructors.mvs.views import luminance, pinhole, read_view, rectified, view_stage

LENS = Intrinsics(480, 360, 430.0, 430.0, 245.0, 178.0, (-0.15, 0.03, 0.001, -0.001))


def photographed_through(camera):
    """A photograph through a lens, sampled from one of a wider pinhole at twice the size."""
    wide = Camera("", Intrinsics(1400, 1100, 860.0, 860.0, 700.0, 550.0), camera.cam_from_world)
    image, k = corner.photograph(wide).astype(float), camera.intrinsics
    x, y = np.meshgrid(np.arange(k.width) + 0.5, np.arange(k.height) + 0.5)
    lines = k.directions(np.stack([x.ravel(), y.ravel()], axis=1))
    at, _ = Camera("", wide.intrinsics, Similarity.identity()).project(lines)
    return corner.bilinear(image, *(at.reshape(k.height, k.width, 2) - 0.5).transpose(2, 0, 1)).round().astype(np.uint8)


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """One image through a lens and one through a pinhole, in a folder of their own, the first with a mask."""
    folder = tmp_path_factory.mktemp("scene")
    (folder / "images/left").mkdir(parents=True)
    (folder / "masks/left").mkdir(parents=True)
    bent, straight = (
        Camera(f"left/{name}.png", k, camera.cam_from_world)
        for name, k, camera in zip("ab", (LENS, corner.standard_intrinsics()), corner.cameras(2, LENS), strict=True)
    )
    Image.fromarray(photographed_through(bent)).save(folder / "images" / bent.name)
    Image.fromarray(corner.photograph(straight)).save(folder / "images" / straight.name)
    mask = np.full((360, 480), 255, np.uint8)
    mask[:, :100] = 0
    Image.fromarray(mask).save(folder / "masks" / bent.name)
    write_colmap_model(folder / "sparse", [bent, straight])
    return read_scene(folder)


@pytest.mark.parametrize("scale", [1.0, 0.5])
def test_a_lens_is_straightened(scene, scale):
    camera = scene.cameras["left/a.png"]
    target = pinhole(camera, scale)
    assert target.intrinsics.is_pinhole
    assert target.intrinsics.fx == pytest.approx(scale * 430)
    image, valid = rectified(scene, camera, target.intrinsics)
    assert image.shape == (target.intrinsics.height, target.intrinsics.width, 3)
    # All of the photograph is in the pinhole's image: this lens draws its corners in.
    assert 1 < target.intrinsics.width / (scale * 480) < 1.25
    # The ideal image at half size is the mean of four pixels of the one at full size.
    whole = Camera(
        "",
        pinhole(camera, 1.0).intrinsics.resized(*(round(n / scale) for n in image.shape[1::-1])),
        camera.cam_from_world,
    )
    ideal = corner.photograph(whole).astype(float)
    n = round(1 / scale)
    ideal = ideal.reshape(image.shape[0], n, image.shape[1], n, 3).mean(axis=(1, 3))
    seen = corner_map(target).known & valid
    assert seen.mean() > 0.3
    assert np.median(np.abs(image[seen] - ideal[seen])) < 3
    # Half a pixel aside it would be worse: conventions are right.
    beside = np.roll(image, 1, axis=1)
    assert np.median(np.abs(beside[seen] - ideal[seen])) > 2 * np.median(np.abs(image[seen] - ideal[seen]))
    # The mask hides the left, the lens the corners.
    at, _ = camera.project(camera.position + rays_of(target) @ camera.cam_from_world.rotation)
    expected = ((at >= [100, 0]) & (at < [480, 360])).all(axis=-1).reshape(valid.shape)
    assert (valid == expected).mean() > 0.99


def rays_of(camera):
    k = camera.intrinsics
    x, y = np.meshgrid(np.arange(k.width) + 0.5, np.arange(k.height) + 0.5)
    return k.directions(np.stack([x.ravel(), y.ravel()], axis=1))


def test_a_pinhole_stays_as_it_is(scene, tmp_path):
    camera = scene.cameras["left/b.png"]
    target = pinhole(camera, 1.0)
    assert target.intrinsics == camera.intrinsics
    folder = view_stage(scene, camera, target, tmp_path)
    assert folder == tmp_path / "views/left/b.png"
    view = read_view(folder, target)
    assert view.valid is None
    assert view.camera is target
    np.testing.assert_array_equal(view.gray, luminance(scene.read_image(camera.name)))
    time = (folder / "image.png").stat().st_mtime_ns
    view_stage(scene, camera, target, tmp_path)
    assert (folder / "image.png").stat().st_mtime_ns == time
    assert read_view(view_stage(scene, camera, pinhole(camera, 0.5), tmp_path), pinhole(camera, 0.5)).gray.shape == (
        180,
        240,
    )


def test_masks_are_kept(scene, tmp_path):
    camera = scene.cameras["left/a.png"]
    target = pinhole(camera, 1.0)
    view = read_view(view_stage(scene, camera, target, tmp_path), target)
    np.testing.assert_array_equal(view.valid, rectified(scene, camera, target.intrinsics)[1])


def test_grey_is_luminance():
    rgb = np.array([[[255, 0, 0], [0, 255, 0], [0, 0, 255], [255, 255, 255]]], np.uint8)
    np.testing.assert_array_equal(luminance(rgb), [[76, 150, 29, 255]])
