"""On a GPU: each operation against the CPU, and bit for bit against the emulation of the same kernels.

test_twins.py also runs there, against the reference rasterizer. Command for both: python -m pytest -m gpu
"""

import numpy as np
import pytest
from optional import import_or_skip
from splat_passes import Engine, random_image_gradients, run_pass
from splat_scenes import SCENES, huge_gaussians, make_scene, scattered_cloud

from reconstructors.splat.interface import GaussianTensors
from reconstructors.splat.rasterize import rasterize
from reconstructors.splat.view import View

torch = import_or_skip("torch")

pytestmark = pytest.mark.gpu


@pytest.fixture(scope="module")
def gpu():
    if not torch.cuda.is_available():
        pytest.skip("torch finds no CUDA device")
    from reconstructors.splat import cuda

    return Engine(cuda, "cuda")


@pytest.fixture(scope="module")
def emulator():
    from cuda_emulator import EmulatedCuda

    return Engine(EmulatedCuda(), "cpu")


@pytest.fixture(scope="module")
def cpu():
    from reconstructors.splat import cpu

    return Engine(cpu, "cpu")


def large_scene(count=100_000, width=480, height=270):
    """A scene of the size of a training step: about 20 Gaussians at each pixel."""
    return scattered_cloud(np.random.default_rng(11), count, width, height, size=0.012)


@pytest.mark.parametrize("kind", SCENES)
def test_a_pass_equals_the_emulators_bit_for_bit(gpu, emulator, kind):
    """Each operation is rounded by IEEE 754, nothing is contracted, and the order of each sum is fixed."""
    scene = make_scene(kind)
    image_gradients = random_image_gradients(scene)
    for geometry in (True, False):
        pass_gradients = image_gradients if geometry else image_gradients._replace(depth=None, normal=None)
        ours, theirs = (run_pass(engine, scene, pass_gradients, geometry=geometry) for engine in (gpu, emulator))
        for name, array in theirs.arrays().items():
            np.testing.assert_array_equal(ours.arrays()[name], array, err_msg=name)


def test_a_large_pass_equals_the_cpus(gpu, cpu):
    """Images are equal bit for bit; gradients are summed in another order."""
    scene = large_scene()
    image_gradients = random_image_gradients(scene)
    ours, theirs = run_pass(gpu, scene, image_gradients), run_pass(cpu, scene, image_gradients)
    for name, image in theirs.images.items():
        np.testing.assert_array_equal(ours.images[name], image, err_msg=name)
    for name, array in theirs.gradients.items():
        np.testing.assert_allclose(
            ours.gradients[name], array, rtol=1e-3, atol=1e-4 * np.abs(array).max(), err_msg=name
        )


def test_repeated_passes_give_the_same_bits(gpu):
    scene = large_scene()
    image_gradients, rasterizer = random_image_gradients(scene), gpu.kernels.Rasterizer()
    first = run_pass(gpu, scene, image_gradients, rasterizer).arrays()
    for _ in range(5):
        for name, array in run_pass(gpu, scene, image_gradients, rasterizer).arrays().items():
            np.testing.assert_array_equal(array, first[name], err_msg=name)


@pytest.mark.parametrize("height, width", [(1, 1), (37, 50), (270, 480)])
def test_the_loss_equals_that_of_the_cpu_and_of_the_emulator(gpu, cpu, emulator, height, width):
    rng = np.random.default_rng(4)
    image, target = (rng.random((height, width, 3), dtype=np.float32) for _ in range(2))
    ours, theirs, emulator_loss = (
        engine.kernels.image_loss(engine.tensor(image), engine.tensor(target), 0.2) for engine in (gpu, cpu, emulator)
    )
    assert float(ours.l1) == pytest.approx(float(theirs.l1), rel=1e-6)
    assert float(ours.ssim) == pytest.approx(float(theirs.ssim), abs=1e-5)
    size = float(theirs.gradient.abs().max())
    torch.testing.assert_close(ours.gradient.cpu(), theirs.gradient, rtol=0, atol=1e-4 * size)
    assert torch.equal(ours.gradient.cpu(), emulator_loss.gradient)


@pytest.mark.parametrize("rates", [0.01, torch.linspace(0.001, 0.1, 48)], ids=["one", "each"])
def test_adam_equals_the_cpus(gpu, cpu, rates):
    """Bit for bit. Rates on the host are copied to the device."""
    rng = np.random.default_rng(6)
    ids, gradient = np.flatnonzero(rng.random(5000) < 0.5), rng.normal(size=(5000, 48)).astype(np.float32)
    results = []
    for engine in (gpu, cpu):
        tensors = [engine.tensor(np.full((5000, 48), value, np.float32)) for value in (1, 0, 0)]
        for step in (1, 2, 3):
            engine.kernels.adam(*tensors, engine.tensor(gradient[ids] / step), engine.tensor(ids), rates, step)
        results.append([tensor.cpu() for tensor in tensors])
    for ours, theirs in zip(*results, strict=True):
        assert torch.equal(ours, theirs)


def test_the_morton_order_equals_the_emulators(gpu, emulator):
    points = np.random.default_rng(7).normal(size=(10_000, 3)).astype(np.float32)
    orders = [engine.kernels.morton_order(engine.tensor(points)).cpu() for engine in (gpu, emulator)]
    assert torch.equal(*orders)


def test_kernels_run_on_the_current_stream(gpu):
    """On another stream the kernels would read the scales before they are set."""
    scene = make_scene(huge_gaussians)
    view = View.of(scene.camera)
    gaussians, background = GaussianTensors(*map(gpu.tensor, scene.arrays)), gpu.tensor(scene.background)
    expected = gpu.kernels.Rasterizer().forward(gaussians, view, background, geometry=True)
    torch.cuda.synchronize()
    with torch.cuda.stream(torch.cuda.Stream()):
        late_scales = torch.zeros_like(gaussians.scales)
        torch.cuda._sleep(200_000_000)  # about a tenth of a second
        late_scales.copy_(gaussians.scales)
        images = gpu.kernels.Rasterizer().forward(
            gaussians._replace(scales=late_scales), view, background, geometry=True
        )
    torch.cuda.synchronize()
    for ours, theirs in zip(images, expected, strict=True):
        assert torch.equal(ours, theirs)


def test_gradients_reach_the_leaves_through_autograd(gpu):
    """Torch runs the backward pass on a separate thread."""
    scene = make_scene(scattered_cloud)
    results = []
    for device in ("cuda", "cpu"):
        tensors = [torch.from_numpy(array).to(device).requires_grad_() for array in scene.arrays]
        rendering = rasterize(*tensors, scene.camera)
        (rendering.color.square().sum() + rendering.depth.sum()).backward()
        results.append([tensor.grad.cpu() for tensor in tensors])
    for ours, theirs in zip(*results, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-3, atol=1e-5 * float(theirs.abs().max()))
