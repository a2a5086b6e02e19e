"""The reference rasterizer against finite differences, scipy, torch's optimizer and the camera's own projection."""

import numpy as np
import pytest
from optional import import_or_skip
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation
from scipy.special import sph_harm_y
from splat_scenes import make_scene, means_at_border, odd_quaternions, scattered_cloud

from reconstructors.splat.interface import GaussianTensors
from reconstructors.splat.view import View

torch = import_or_skip("torch")
reference = pytest.importorskip("reconstructors.splat.reference")


def to_double(scene):
    return GaussianTensors(*(torch.from_numpy(array).double() for array in scene.arrays))


@pytest.mark.parametrize("kind", [scattered_cloud, means_at_border])
def test_gradients_equal_finite_differences(kind):
    """For a random sum of the images of 30 Gaussians, along random directions; no alpha is at a threshold here.

    Differences of sums of about 1e3 over 2e-6 are exact to 1e-7.
    """
    scene, rng = make_scene(kind), np.random.default_rng(1)
    view, background = View.of(scene.camera), torch.from_numpy(scene.background).double()
    weights = [
        torch.from_numpy(rng.normal(size=(view.height, view.width, *channels))) for channels in [(3,), (), (), (3,)]
    ]

    def loss(tensors):
        images = reference.render(GaussianTensors(*tensors[:5]), view, tensors[5])[:4]
        return sum((image * weight).sum() for image, weight in zip(images, weights, strict=True))

    inputs = [tensor.requires_grad_() for tensor in (*(tensor[-30:] for tensor in to_double(scene)), background)]
    gradients = torch.autograd.grad(loss(inputs), inputs)
    for index, gradient in enumerate(gradients):
        for _ in range(2):
            direction = torch.from_numpy(rng.normal(size=gradient.shape))
            direction /= direction.norm()
            with torch.no_grad():
                ends = [[*inputs] for _ in range(2)]
                ends[0][index], ends[1][index] = inputs[index] + 1e-6 * direction, inputs[index] - 1e-6 * direction
                slope = (loss(ends[0]) - loss(ends[1])).item() / 2e-6
            assert slope == pytest.approx((gradient * direction).sum().item(), abs=1e-6), index


def test_the_backward_pass_equals_autograd():
    """For a sum over all images; the screen gradient is that of moving one Gaussian's image over the pixels."""
    scene = make_scene(scattered_cloud)
    view, leaves = View.of(scene.camera), [tensor.requires_grad_() for tensor in to_double(scene)]
    background = torch.from_numpy(scene.background).double()
    rendering = reference.render(GaussianTensors(*leaves), view, background)
    rng = np.random.default_rng(1)
    weights = [torch.from_numpy(rng.normal(size=image.shape)) for image in rendering[:4]]
    torch.autograd.backward([(image * weight).sum() for image, weight in zip(rendering[:4], weights, strict=True)])
    rasterizer = reference.Rasterizer()
    rasterizer.forward(GaussianTensors(*leaves), view, background, geometry=True)
    gradients = rasterizer.backward(*weights)
    for leaf, rows in zip(leaves, gradients[1:6], strict=True):
        full = torch.zeros_like(leaf)
        full[gradients.ids] = rows
        # 100 roundings, times the covariances' largest condition number of 30 (see rounding_bound in test_maths.py).
        assert (full - leaf.grad).abs().max() < 1e-12 * leaf.grad.abs().max()
    splats = reference.project(GaussianTensors(*leaves), view)

    def loss(xy):
        images = reference.blend(splats._replace(xy=xy), view, background).output
        return sum((image * weight).sum() for image, weight in zip(images[:4], weights, strict=True)).item()

    with torch.no_grad():
        for row in (0, 11, 30):
            index = int((splats.ids == gradients.ids[row]).nonzero()[0, 0])
            for axis in range(2):
                step = torch.zeros_like(splats.xy)
                step[index, axis] = 1e-6
                slope = (loss(splats.xy + step) - loss(splats.xy - step)) / 2e-6
                assert slope == pytest.approx(gradients.screen[row, axis].item(), rel=1e-5, abs=1e-5)


def test_rotations_equal_scipys():
    quats = make_scene(odd_quaternions).quats[10:].astype(np.float64)
    ours = reference.rotations(torch.from_numpy(quats)).numpy()
    np.testing.assert_allclose(ours, Rotation.from_quat(quats, scalar_first=True).as_matrix(), atol=1e-12)


def test_harmonics_equal_scipys():
    """Real harmonics are sqrt(2) times the real or the imaginary part of the complex ones."""
    directions = np.random.default_rng(3).normal(size=(50, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    polar, azimuth = np.arccos(directions[:, 2]), np.arctan2(directions[:, 1], directions[:, 0])
    columns = []
    for degree in range(4):
        for order in range(-degree, degree + 1):
            value = sph_harm_y(degree, abs(order), polar, azimuth)
            columns.append(value.real if order == 0 else np.sqrt(2) * (value.imag, value.real)[order > 0])
    ours = reference.harmonics(torch.from_numpy(directions), 16).numpy()
    np.testing.assert_allclose(ours, np.column_stack(columns), atol=1e-12)
    for count in (1, 4, 9):
        np.testing.assert_array_equal(reference.harmonics(torch.from_numpy(directions), count).numpy(), ours[:, :count])


def test_a_small_gaussian_is_projected_like_its_points():
    """For offsets of a thousandth of each axis: the spread of the ends in the image, and of their depths."""
    scene = make_scene(scattered_cloud)
    view, gaussians = View.of(scene.camera), to_double(scene)
    splats = reference.project(gaussians, view)
    center, _ = scene.camera.project(gaussians.means.numpy()[splats.ids])
    np.testing.assert_allclose(splats.xy.numpy(), center, atol=1e-9)
    rotations = Rotation.from_quat(scene.quats[splats.ids].astype(np.float64), scalar_first=True).as_matrix()
    covariance, depth_covariance = np.zeros((len(center), 2, 2)), np.zeros((len(center), 2))
    for axis in range(3):
        offset = 1e-3 * rotations[:, :, axis] * scene.scales[splats.ids, axis, None].astype(np.float64)
        (forward, forward_depth), (backward, backward_depth) = (
            scene.camera.project(gaussians.means.numpy()[splats.ids] + sign * offset) for sign in (1, -1)
        )
        half_axis, depth = (forward - backward) / 2e-3, (forward_depth - backward_depth) / 2e-3
        covariance += half_axis[:, :, None] * half_axis[:, None]
        depth_covariance += half_axis * depth[:, None]
    left, right, top, bottom = view.limits
    x, y = ((center - [view.cx, view.cy]) / [view.fx, view.fy]).T
    is_inside = (x > left) & (x < right) & (y > top) & (y < bottom)
    assert is_inside.sum() > 30
    dilated = covariance + 0.3 * np.eye(2)
    np.testing.assert_allclose(
        torch.linalg.inv(splats.inverse).numpy()[is_inside], dilated[is_inside], rtol=1e-4, atol=1e-4
    )
    slope = np.linalg.solve(dilated, depth_covariance[:, :, None])[:, :, 0]
    np.testing.assert_allclose(splats.slope.numpy()[is_inside], slope[is_inside], rtol=1e-3, atol=1e-5)


def test_ssim_equals_that_of_scipys_filters():
    rng = np.random.default_rng(2)
    x, y = rng.random((2, 23, 31, 3))

    def smooth(image):
        return gaussian_filter(image, 1.5, radius=5, mode="constant", axes=(0, 1))

    xx, yy, xy = smooth(x * x) - smooth(x) ** 2, smooth(y * y) - smooth(y) ** 2, smooth(x * y) - smooth(x) * smooth(y)
    numerator = (2 * smooth(x) * smooth(y) + 1e-4) * (2 * xy + 9e-4)
    ssim = (numerator / ((smooth(x) ** 2 + smooth(y) ** 2 + 1e-4) * (xx + yy + 9e-4))).mean()
    loss = reference.image_loss(torch.from_numpy(x), torch.from_numpy(y), 0.2)
    assert loss.ssim.item() == pytest.approx(ssim, rel=1e-10)
    assert loss.l1.item() == pytest.approx(np.abs(x - y).mean(), rel=1e-12)
    # The gradient, by finite differences of one value.
    images = [torch.from_numpy(x.copy()) for _ in range(2)]
    images[0][0, 12, 1] += 1e-6
    images[1][0, 12, 1] -= 1e-6
    ends = [reference.image_loss(image, torch.from_numpy(y), 0.2) for image in images]
    values = [0.8 * end.l1.item() + 0.2 * (1 - end.ssim.item()) for end in ends]
    assert (values[0] - values[1]) / 2e-6 == pytest.approx(loss.gradient[0, 12, 1].item(), rel=1e-5)


def test_adam_equals_torchs_if_all_rows_are_updated():
    rng = np.random.default_rng(7)
    ours = torch.from_numpy(rng.normal(size=(6, 4)))
    theirs = ours.clone().requires_grad_()
    first, second = torch.zeros_like(ours), torch.zeros_like(ours)
    optimizer = torch.optim.Adam([theirs], lr=0.02, eps=1e-15)
    for step in range(1, 8):
        theirs.grad = torch.from_numpy(rng.normal(size=(6, 4)))
        optimizer.step()
        reference.adam(ours, first, second, theirs.grad, torch.arange(6), 0.02, step)
    assert torch.allclose(ours, theirs.detach(), rtol=1e-12, atol=1e-14)
