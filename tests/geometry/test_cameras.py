"""Cameras: conventions checked with hand-computed cases."""

import numpy as np
import pytest
from wording import check_error

from pcbench.errors import InputError
from pcbench.geometry.cameras import Camera, Intrinsics, look_at


def test_projection_follows_the_axis_conventions():
    camera = Camera("a.png", Intrinsics.from_fov(640, 480, 90.0), look_at([0, -10, 0], [0, 0, 0]))
    np.testing.assert_allclose(camera.position, [0, -10, 0], atol=1e-14)
    np.testing.assert_allclose(camera.direction, [0, 1, 0], atol=1e-14)
    pixels, depth = camera.project(np.array([[0, 0, 0], [10, 0, 0], [0, 0, 10.0], [0, -20, 0]]))
    np.testing.assert_allclose(pixels[0], [320, 240], atol=1e-11)
    np.testing.assert_allclose(pixels[1], [560, 240], atol=1e-11)  # east is right
    np.testing.assert_allclose(pixels[2], [320, 0], atol=1e-11)  # up is up
    np.testing.assert_allclose(depth, [10, 10, 10, -10], atol=1e-13)
    downward = Camera("b.png", camera.intrinsics, look_at([0, 0, 50], [0, 0, 0]))
    pixels, _ = downward.project(np.array([[0, 5.0, 0], [5.0, 0, 0]]))
    assert pixels[0, 1] < 240  # north is up
    assert pixels[1, 0] > 320


def test_distortion_follows_opencv():
    # The formula of OpenCV's documentation for one point.
    k = Intrinsics(100, 80, 100, 110, 50, 40, (0.1, -0.05, 0.01, 0.02))
    camera = Camera("a.png", k, look_at([0, 0, 0], [0, 0, 1], up=[0, -1, 0]))
    pixels, _ = camera.project(np.array([[0.3, -0.2, 1.0]]))
    r2 = 0.13
    radial = 1 + 0.1 * r2 - 0.05 * r2**2
    u = 0.3 * radial + 2 * 0.01 * 0.3 * -0.2 + 0.02 * (r2 + 2 * 0.09)
    v = -0.2 * radial + 0.01 * (r2 + 2 * 0.04) + 2 * 0.02 * 0.3 * -0.2
    np.testing.assert_allclose(pixels, [[100 * u + 50, 110 * v + 40]], atol=1e-12)


def test_scaling_preserves_rays():
    k = Intrinsics(1001, 667, 900, 905, 498, 331)
    half = k.scaled(0.5)
    assert (half.width, half.height) == (500, 334)
    assert (half.cx / half.width, half.fy / half.height) == pytest.approx((498 / 1001, 905 / 667))


@pytest.mark.parametrize(
    "make",
    [
        lambda: Intrinsics(0, 5, 1, 1, 0, 0),
        lambda: Intrinsics(5, 5, -1, 1, 0, 0),
        lambda: Intrinsics(5, 5, 1, 1, float("nan"), 0),
        lambda: look_at([1, 2, 3], [1, 2, 3]),
    ],
)
def test_invalid_cameras_are_refused(make):
    with check_error():
        make()


DISTORTIONS = [(0, 0, 0, 0), (0.08, 0, 0, 0), (-0.12, 0.02, 0.003, -0.002), (0.1, -0.05, 0.01, 0.02)]


@pytest.mark.parametrize("distortion", DISTORTIONS)
def test_directions_invert_projection(distortion):
    k = Intrinsics(320, 200, 210, 215, 155, 104, distortion)
    u, v = np.meshgrid(np.linspace(0, 320, 33), np.linspace(0, 200, 21))
    pixels = np.stack([u.ravel(), v.ravel()], axis=1)
    rays = k.directions(pixels)
    np.testing.assert_array_equal(rays[:, 2], 1)
    projected = Camera("a.png", k, look_at([0, 0, 0], [0, 0, 1], up=[0, -1, 0])).project(7 * rays)[0]
    np.testing.assert_allclose(projected, pixels, atol=1e-9)  # pixels of about 300, Newton to 1e-10 of a focal length
    widest = np.abs(rays[:, :2]).max(axis=0)
    np.testing.assert_allclose(k.widest, widest, rtol=0.01)  # the extreme of the border lies between grid points


def test_folding_distortion_is_refused():
    k = Intrinsics(320, 200, 110, 110, 160, 100, (-0.6, 0, 0, 0))
    with check_error():
        k.directions(np.array([[0.0, 0.0], [160, 100]]))


def test_points_beside_a_camera_project_nowhere_without_warnings():
    camera = Camera("a", Intrinsics.from_fov(640, 480, 45.0), look_at([0, 0, 0], [0, 1, 0]))
    beside = np.array([[1.0, 0, 0], [0, 0, 1], [1, 0, -2], [0, 0, 0]])
    with np.errstate(all="raise"):
        pixels, depths = camera.project(beside)
    assert not np.isfinite(pixels).all(axis=1).any()
    assert (depths <= 0).all()


def test_fisheye_that_folds_over_before_the_border_has_no_rays():
    """Its radius t (1 - 0.3 t^2) is largest at 60 degrees, at 0.70 focal lengths; the border begins at one."""
    folding = Intrinsics(2000, 2000, 1000, 1000, 1000, 1000, (-0.3, 0.0, 0.0, 0.0), fisheye=True)
    for pixels in ([[2000.0, 1000.0]], [[1100.0, 1000.0], [2000.0, 1000.0]]):
        with pytest.raises(InputError):
            folding.directions(np.array(pixels))


def test_border_of_a_lens_beyond_the_widest_angle_keeps_its_directions():
    border = Intrinsics(2000, 2000, 400, 400, 1000, 1000, (0.0, 0.0, 0.0, 0.0), fisheye=True).border
    assert border[32].tolist() == [0.0, -np.inf] and border[0].tolist() == [-np.inf, -np.inf]
