"""Undistorted photographs compared with photographs of the pinholes."""

import numpy as np
import pytest
import textured_corner as corner
from exact_maps import corner_map
from PIL import Image

from pcbench.geometry.cameras import Camera, Intrinsics
from pcbench.geometry.transform import Similarity
from pcbench.io.colmap_model import write_colmap_model
from pcbench.scenes import read_scene
from reconstructors.mvs.views import ViewCache, luminance, pinhole, read_view, undistort, view_stage

LENS = Intrinsics(480, 360, 430.0, 430.0, 245.0, 178.0, (-0.15, 0.03, 0.001, -0.001))
FISHEYE = Intrinsics(480, 360, 400.0, 400.0, 245.0, 178.0, (0.02, -0.01, 0.003, -0.001), fisheye=True)


def distorted_photograph(camera):
    """Return a photograph with lens distortion, sampled from a wider pinhole's photograph at twice the size."""
    wide_camera = Camera("", Intrinsics(1400, 1100, 860.0, 860.0, 700.0, 550.0), camera.cam_from_world)
    image, k = corner.photograph(wide_camera).astype(float), camera.intrinsics
    x, y = np.meshgrid(np.arange(k.width) + 0.5, np.arange(k.height) + 0.5)
    directions = k.directions(np.stack([x.ravel(), y.ravel()], axis=1))
    pixels, _ = Camera("", wide_camera.intrinsics, Similarity.identity()).project(directions)
    return (
        corner.bilinear(image, *(pixels.reshape(k.height, k.width, 2) - 0.5).transpose(2, 0, 1))
        .round()
        .astype(np.uint8)
    )


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return scene_through(LENS, tmp_path_factory.mktemp("scene"))


@pytest.fixture(scope="module")
def fisheye_scene(tmp_path_factory):
    return scene_through(FISHEYE, tmp_path_factory.mktemp("scene"))


def scene_through(lens, folder):
    """A scene with a distorted, masked image and a pinhole image, both in a subfolder."""
    (folder / "images/left").mkdir(parents=True)
    (folder / "masks/left").mkdir(parents=True)
    distorted, ideal = (
        Camera(f"left/{name}.png", k, camera.cam_from_world)
        for name, k, camera in zip("ab", (lens, corner.standard_intrinsics()), corner.cameras(2, LENS), strict=True)
    )
    Image.fromarray(distorted_photograph(distorted)).save(folder / "images" / distorted.name)
    Image.fromarray(corner.photograph(ideal)).save(folder / "images" / ideal.name)
    mask = np.full((360, 480), 255, np.uint8)
    mask[:, :100] = 0
    Image.fromarray(mask).save(folder / "masks" / distorted.name)
    write_colmap_model(folder / "sparse", [distorted, ideal])
    return read_scene(folder)


@pytest.mark.parametrize(
    ("lens", "scale"), [("scene", 1.0), ("scene", 0.5), ("fisheye_scene", 1.0)], ids=["brown", "brown-half", "fisheye"]
)
def test_lens_distortion_is_removed(request, lens, scale):
    scene = request.getfixturevalue(lens)
    camera = scene.cameras["left/a.png"]
    target = pinhole(camera, scale)
    assert target.intrinsics.is_pinhole
    assert target.intrinsics.fx == pytest.approx(scale * camera.intrinsics.fx)
    image, valid, _ = undistort(scene, camera, target.intrinsics)
    assert image.shape == (target.intrinsics.height, target.intrinsics.width, 3)
    # The pinhole's image contains the entire photograph: this lens has barrel distortion.
    assert 1 < target.intrinsics.width / (scale * 480) < 1.25
    # The ideal image at half size averages four pixels of the full size.
    full_size = Camera(
        "",
        pinhole(camera, 1.0).intrinsics.resized(*(round(step / scale) for step in image.shape[1::-1])),
        camera.cam_from_world,
    )
    ideal = corner.photograph(full_size).astype(float)
    step = round(1 / scale)
    ideal = ideal.reshape(image.shape[0], step, image.shape[1], step, 3).mean(axis=(1, 3))
    visible = corner_map(target).known & valid
    assert visible.mean() > 0.3
    assert np.median(np.abs(image[visible] - ideal[visible])) < 3
    # A shift by one pixel is worse: the pixel convention is right.
    shifted = np.roll(image, 1, axis=1)
    assert np.median(np.abs(shifted[visible] - ideal[visible])) > 2 * np.median(np.abs(image[visible] - ideal[visible]))
    # The mask hides the left part, and the lens does not cover the corners.
    pixels, _ = camera.project(camera.position + rays_of(target) @ camera.cam_from_world.rotation)
    expected = ((pixels >= [100, 0]) & (pixels < [480, 360])).all(axis=-1).reshape(valid.shape)
    assert (valid == expected).mean() > 0.99


def rays_of(camera):
    k = camera.intrinsics
    x, y = np.meshgrid(np.arange(k.width) + 0.5, np.arange(k.height) + 0.5)
    return k.directions(np.stack([x.ravel(), y.ravel()], axis=1))


def test_pinhole_stays_unchanged(scene, tmp_path):
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


def test_views_are_cached_until_the_cache_is_cleared(scene, tmp_path):
    camera = scene.cameras["left/b.png"]
    cache = ViewCache({camera.name: camera}, {camera.name: view_stage(scene, camera, camera, tmp_path)}, 3)
    view = cache.view(camera.name)
    assert cache.view(camera.name) is view
    cache.clear()
    assert cache.view(camera.name) is not view


def test_masks_are_undistorted_and_stored(scene, tmp_path):
    camera = scene.cameras["left/a.png"]
    target = pinhole(camera, 1.0)
    view = read_view(view_stage(scene, camera, target, tmp_path), target)
    np.testing.assert_array_equal(view.valid, undistort(scene, camera, target.intrinsics).valid)


@pytest.mark.parametrize("intrinsics", [corner.standard_intrinsics(), LENS], ids=["pinhole", "lens"])
def test_transparent_pixels_are_masked_and_their_alpha_is_stored(tmp_path, intrinsics):
    (tmp_path / "images").mkdir()
    camera = corner.cameras(1, intrinsics)[0]
    alpha = np.zeros((360, 480), np.uint8)
    alpha[:, 240:] = 255
    Image.fromarray(np.dstack([corner.photograph(camera), alpha])).save(tmp_path / "images" / camera.name)
    write_colmap_model(tmp_path / "sparse", [camera])
    scene, target = read_scene(tmp_path), pinhole(camera, 1.0)
    folder = view_stage(scene, camera, target, tmp_path / "work")
    pixels, _ = camera.project(camera.position + rays_of(target) @ camera.cam_from_world.rotation)
    is_opaque = (pixels[..., 0] >= 240).reshape(target.intrinsics.height, target.intrinsics.width)
    assert ((np.asarray(Image.open(folder / "alpha.png")) > 127) == is_opaque).mean() > 0.995
    inside = ((pixels >= 0) & (pixels < [480, 360])).all(axis=-1).reshape(is_opaque.shape)
    assert (read_view(folder, target).valid == (is_opaque & inside)).mean() > 0.995
    assert (folder / "mask.png").is_file() == (intrinsics is LENS)  # the alpha does not change the mask


def test_luminance():
    rgb = np.array([[[255, 0, 0], [0, 255, 0], [0, 0, 255], [255, 255, 255]]], np.uint8)
    np.testing.assert_array_equal(luminance(rgb), [[76, 150, 29, 255]])


def test_a_fisheye_of_more_than_half_of_all_directions_is_cropped(tmp_path):
    """Its image reaches rays beyond 90 degrees from the axis, which no pinhole has."""
    k = Intrinsics(200, 200, 60.0, 60.0, 100.0, 100.0, (0.0, 0.0, 0.0, 0.0), fisheye=True)
    camera = Camera("a.png", k, Similarity.identity())
    target = pinhole(camera, 1.0).intrinsics
    assert (target.width, target.height, target.cx, target.cy) == (250, 250, 125, 125)
    (tmp_path / "images").mkdir()
    u, v = np.meshgrid(np.arange(200) + 0.5, np.arange(200) + 0.5)
    angle_deg = np.degrees(np.hypot(u - 100, v - 100) / 60)
    Image.fromarray(np.repeat(angle_deg[..., None], 3, axis=2).round().astype(np.uint8)).save(tmp_path / "images/a.png")
    write_colmap_model(tmp_path / "sparse", [camera])
    scene = read_scene(tmp_path)
    image, valid, _ = undistort(scene, scene.cameras["a.png"], target)
    rays = rays_of(Camera("", target, Similarity.identity()))
    expected = np.degrees(np.arctan(np.hypot(rays[:, 0], rays[:, 1]))).reshape(250, 250)
    assert valid is None
    np.testing.assert_allclose(image[..., 0], expected, atol=1.2)  # rounded before and after cubic interpolation
