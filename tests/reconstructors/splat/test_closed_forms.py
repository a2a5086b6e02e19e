"""Renderings with known closed forms."""

import numpy as np
import pytest
from optional import import_or_skip
from splat_passes import ImageGradients, run_pass
from splat_scenes import SplatScene

from pcbench.geometry.cameras import Camera, Intrinsics
from pcbench.geometry.transform import Similarity

torch = import_or_skip("torch")

DILATION = 0.3  # square pixels
MIN_ALPHA = 1 / 255  # smaller alphas are not drawn


def frontal_scene(
    means, scales, opacities, colors, size=(32, 32), focal=100.0, quats=None, center=None, background=(0, 0, 0)
):
    """Gaussians before a camera at the origin that looks along +z, the image's centre on its axis by default."""
    means = np.atleast_2d(means)
    count, (width, height) = len(means), size
    cx, cy = (0.5 * width, 0.5 * height) if center is None else center
    quats = np.tile([1, 0, 0, 0], (count, 1)) if quats is None else quats
    sh = (np.broadcast_to(colors, (count, 3)) - 0.5)[:, None] * np.sqrt(4 * np.pi)  # over the first harmonic
    arrays = [means, quats, np.broadcast_to(scales, (count, 3)), np.broadcast_to(opacities, count), sh]
    camera = Camera("view.png", Intrinsics(width, height, focal, focal, cx, cy), Similarity.identity())
    return SplatScene(*(np.array(a, np.float32) for a in arrays), camera, np.array(background, np.float32))


def render_images(engine, scene):
    """Return the images (H, W, ...) by name, and alpha."""
    k = scene.camera.intrinsics
    images = {
        name: image.reshape(k.height, k.width, -1).squeeze() for name, image in run_pass(engine, scene).images.items()
    }
    return {**images, "alpha": 1 - images["transmittance"]}


def test_the_sum_of_a_gaussian_is_its_integral(any_engine):
    """The integral of a Gaussian of height a above the level 1/255 is 2 pi sqrt(det) (a - 1/255); alphas below 1/255
    are cut off."""
    sigma_x, sigma_y, opacity = 6.0, 4.0, 0.6
    scene = frontal_scene([0, 0, 2], [sigma_x * 0.02, sigma_y * 0.02, 0.01], opacity, [0.9, 0.5, 0.2], size=(61, 41))
    images = render_images(any_engine, scene)
    integral = 2 * np.pi * np.sqrt((sigma_x**2 + DILATION) * (sigma_y**2 + DILATION)) * (opacity - MIN_ALPHA)
    # The edge, 1/255 high, is cut at pixel boundaries.
    assert images["alpha"].sum() == pytest.approx(integral, rel=1e-3)
    np.testing.assert_allclose(images["color"].sum(axis=(0, 1)), integral * np.array([0.9, 0.5, 0.2]), rtol=1e-3)


def test_a_point_is_drawn_as_its_dilation(any_engine):
    """A Gaussian of size zero is exp(-d^2 / (2 0.3)) times its opacity, wherever its mean lies between pixels."""
    for x, y in [(0.0, 0.0), (0.5, 0.5), (0.21, -0.37)]:
        scene = frontal_scene([x * 0.02, y * 0.02, 2], 0, 0.8, [1, 1, 1], size=(8, 6))
        u, v = np.meshgrid(np.arange(8) + 0.5 - 4 - x, np.arange(6) + 0.5 - 3 - y)
        expected = 0.8 * np.exp(-(u**2 + v**2) / (2 * DILATION))
        np.testing.assert_allclose(
            render_images(any_engine, scene)["alpha"], expected * (expected >= MIN_ALPHA), atol=2e-6
        )


def test_pixel_centres_have_half_integer_coordinates(any_engine):
    """A Gaussian at a pixel centre is symmetric about that pixel; at a corner its four pixels are equal."""
    alpha = render_images(any_engine, frontal_scene([0, 0, 2], 0.02, 0.8, [1, 1, 1], size=(16, 16), center=(8.5, 8.5)))[
        "alpha"
    ]
    assert np.unravel_index(alpha.argmax(), alpha.shape) == (8, 8)
    block = alpha[2:15, 2:15]
    for flipped in (block[::-1], block[:, ::-1], block.T):
        np.testing.assert_allclose(flipped, block, atol=1e-6)
    corner_alpha = render_images(any_engine, frontal_scene([0, 0, 2], 0.02, 0.8, [1, 1, 1], size=(16, 16)))["alpha"]
    np.testing.assert_allclose(corner_alpha[7:9, 7:9], corner_alpha[7, 7], atol=1e-6)
    np.testing.assert_allclose(corner_alpha[::-1, ::-1].T, corner_alpha, atol=1e-6)


def random_plane(rng, count=40):
    """Gaussians in the plane z = 3, at slightly different depths so that their order is unique."""
    means = np.column_stack([rng.uniform(-0.4, 0.4, (count, 2)), 3 + 1e-3 * np.arange(count)])
    scales = np.column_stack([0.1 * np.exp(rng.uniform(-1.5, 0.5, (count, 2))), np.full(count, 0.001)])
    angles = rng.uniform(0, 2 * np.pi, count)
    quats = np.column_stack([np.cos(angles / 2), np.zeros((count, 2)), np.sin(angles / 2)])
    return means, scales, rng.uniform(0.1, 1, count), rng.random((count, 3)), quats


def test_shifting_the_principal_point_by_whole_pixels_shifts_the_image(any_engine):
    means, scales, opacities, colors, quats = random_plane(np.random.default_rng(1))
    images, shifted_images = (
        render_images(any_engine, frontal_scene(means, scales, opacities, colors, (48, 40), 60.0, quats, center))
        for center in [(24, 20), (31, 17)]
    )
    for name in ("color", "alpha", "depth", "normal", "median_depth"):
        np.testing.assert_allclose(shifted_images[name][:-3, 7:], images[name][3:, :-7], atol=2e-5, err_msg=name)


def test_rotating_a_plane_rotates_the_image(any_engine):
    """By 90 degrees about the camera's axis: (x, y) becomes (-y, x), and the image's columns become its rows."""
    means, scales, opacities, colors, quats = random_plane(np.random.default_rng(2))
    images = render_images(any_engine, frontal_scene(means, scales, opacities, colors, (36, 36), 40.0, quats))
    cos_45 = np.sqrt(0.5)
    w, _, _, z = quats.T
    rotated_quats = np.column_stack([cos_45 * (w - z), 0 * w, 0 * w, cos_45 * (w + z)])
    rotated_means = np.column_stack([-means[:, 1], means[:, 0], means[:, 2]])
    rotated_images = render_images(
        any_engine, frontal_scene(rotated_means, scales, opacities, colors, (36, 36), 40.0, rotated_quats)
    )
    assert images["alpha"].max() > 0.9
    for name in ("color", "alpha", "depth", "median_depth"):
        np.testing.assert_allclose(rotated_images[name], np.rot90(images[name], -1), atol=2e-5, err_msg=name)
    x, y, z = np.moveaxis(np.rot90(images["normal"], -1), 2, 0)
    np.testing.assert_allclose(rotated_images["normal"], np.stack([-y, x, z], axis=2), atol=2e-5)


def test_gaussians_before_a_background_of_their_colour_render_that_colour(any_engine):
    """Weights and final transmittance sum to one for any number of Gaussians."""
    means, scales, opacities, _, quats = random_plane(np.random.default_rng(3))
    color = [0.9, 0.3, 0.1]
    scene = frontal_scene(means, scales, opacities, color, (36, 36), 40.0, quats, background=color)
    image = render_images(any_engine, scene)["color"]
    np.testing.assert_allclose(image, np.broadcast_to(color, image.shape), atol=3e-6)


def test_nearer_gaussians_occlude_farther_ones(any_engine):
    """In any input order; alpha is at most 0.99, and a ray ends before its transmittance falls below 1e-4."""
    colors, opacities = np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0.0]]), [0.5, 0.6, 1]
    scene = frontal_scene([[0, 0, 3], [0, 0, 1], [0, 0, 2]], 1e3, opacities, colors, (5, 4), background=[1, 1, 1])
    images = render_images(any_engine, scene)
    weights = np.array([0.4 * 0.01 * 0.5, 0.6, 0.4 * 0.99])
    expected = weights @ colors + (0.4 * 0.01 * 0.5)
    np.testing.assert_allclose(images["color"], np.broadcast_to(expected, (4, 5, 3)), atol=1e-5)
    np.testing.assert_allclose(images["depth"], weights @ [3, 1, 2], atol=1e-5)
    np.testing.assert_allclose(images["median_depth"], 1, atol=1e-6)
    opaque_scene = frontal_scene([[0, 0, 3], [0, 0, 1], [0, 0, 2]], 1e3, 1, colors, (5, 4), background=[1, 1, 1])
    # The second Gaussian would leave 1e-4 up to rounding, so the ray ends before it.
    expected = 0.99 * colors[1] + 0.01
    np.testing.assert_allclose(
        render_images(any_engine, opaque_scene)["color"], np.broadcast_to(expected, (4, 5, 3)), atol=1e-5
    )


@pytest.mark.parametrize("tilt_deg", [0, 30, 60])
@pytest.mark.parametrize("axis", [1, 2])
def test_a_tilted_disc_has_its_planes_depth(any_engine, axis, tilt_deg):
    """The depth is that of the ray's intersection with its plane. The dilation of 0.3 square pixels flattens the slope
    by less than a hundredth, and perspective adds the square of the depth's deviation divided by the depth."""
    focal, depth, sigma, tilt = 2000.0, 10.0, 0.2, np.radians(tilt_deg)
    quat = np.zeros((1, 4))
    quat[0, [0, axis]] = np.cos(tilt / 2), np.sin(tilt / 2)
    scene = frontal_scene([0.02, -0.01, depth], [sigma, sigma, 0], 0.9, [1, 1, 1], (24, 18), focal, quat)
    images = render_images(any_engine, scene)
    normal = np.array([[0, -np.sin(tilt), np.cos(tilt)], [np.sin(tilt), 0, np.cos(tilt)]][axis - 1])
    u, v = np.meshgrid((np.arange(24) + 0.5 - 12) / focal, (np.arange(18) + 0.5 - 9) / focal)
    rays = np.stack([u, v, np.ones_like(u)], axis=2)
    plane_depth = np.dot([0.02, -0.01, depth], normal) / (rays @ normal)
    rendered_depth = images["depth"] / images["alpha"]
    max_offset = np.abs(plane_depth - depth).max()
    np.testing.assert_allclose(rendered_depth, plane_depth, atol=0.01 * max_offset + 1.1 * max_offset**2 / depth + 2e-6)
    np.testing.assert_allclose(images["median_depth"], rendered_depth, atol=1e-5)
    np.testing.assert_allclose(
        images["normal"] / images["alpha"][..., None], np.broadcast_to(-normal, (18, 24, 3)), atol=1e-5
    )


def test_a_tilted_plane_of_discs_has_its_depth(any_engine):
    """Up to its change within a pixel, and towards the camera: nearer discs hide farther ones."""
    focal, depth, tilt = 100.0, 10.0, np.radians(35)
    coordinates = 0.25 * np.arange(-9, 10)  # spacing of two and a half pixels, equal to the discs' size
    x, s = (grid.ravel() for grid in np.meshgrid(coordinates, coordinates))
    means = np.column_stack([x, s * np.cos(tilt), depth + s * np.sin(tilt)])
    quats = np.tile([np.cos(tilt / 2), np.sin(tilt / 2), 0, 0], (len(means), 1))
    scene = frontal_scene(means, [0.25, 0.25, 0], 0.9, [1, 1, 1], (16, 20), focal, quats)
    images = render_images(any_engine, scene)
    assert images["alpha"].min() > 0.99
    slopes = (np.arange(20) + 0.5 - 10) / focal
    plane_depth = (depth / (1 - slopes * np.tan(tilt)))[:, None]
    step = np.gradient(plane_depth[:, 0])[:, None]
    for rendered_depth in (images["depth"] / images["alpha"], images["median_depth"]):
        shortfall = (plane_depth - rendered_depth) / step
        assert (shortfall > -0.2).all() and (shortfall < 0.8).all() and 0.1 < shortfall.mean() < 0.5


def test_gaussians_behind_or_beside_the_camera_are_not_drawn(any_engine):
    scene = frontal_scene([[0, 0, -2], [0, 0, 0.005], [50, 0, 2], [0, -50, 2]], 0.1, 0.9, [1, 1, 1])
    images = render_images(any_engine, scene)
    assert not any(images[name].any() for name in ("color", "alpha", "depth", "normal", "median_depth"))


def test_negative_colours_are_clamped_to_zero(any_engine):
    """A clamped channel has no gradient, the others have one."""
    scene = frontal_scene([0, 0, 2], 0.1, 0.9, [-0.2, 0.4, 1.7])
    image = render_images(any_engine, scene)
    assert not image["color"][..., 0].any() and image["color"][..., 2].max() > 1
    ones = np.ones((32, 32, 3), np.float32)
    gradients = run_pass(any_engine, scene, ImageGradients(ones, None, None, None)).gradients
    assert gradients["sh"][0, 0, 0] == 0 and (gradients["sh"][0, 0, 1:] > 0).all()
