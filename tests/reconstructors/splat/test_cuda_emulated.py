"""The emulated CUDA kernels give the same bits in every order of threads and blocks, and the same as the CPU's kernels.

Their correctness is tested with that of the other devices (test_twins.py, where the emulator is one of them).
"""

from dataclasses import replace

import numpy as np
import pytest
from optional import import_or_skip
from splat_passes import Engine, random_image_gradients, run_pass
from splat_scenes import SCENES, crowd, huge_gaussians, make_scene, opaque_gaussians, scattered_cloud

torch = import_or_skip("torch")

from cuda_emulator import ORDERS, EmulatedCuda, Emulator, nan_filled_memory  # noqa: E402

from reconstructors.splat import cpu  # noqa: E402
from reconstructors.splat.cuda import kernels  # noqa: E402


def training_step(engine, scene):
    """Return all results of an engine by name: with all images, with depth alone and without, the loss, and Adam."""
    image_gradients = random_image_gradients(scene)
    full = run_pass(engine, scene, image_gradients)
    plain = run_pass(engine, scene, image_gradients._replace(depth=None, normal=None), geometry=False)
    some = run_pass(engine, scene, image_gradients._replace(normal=None), normals=False)
    k = scene.camera.intrinsics
    image = torch.from_numpy(plain.images["color"].reshape(k.height, k.width, 3)).float()
    loss = engine.kernels.image_loss(image, image.flip(1).contiguous(), 0.2)
    ids = torch.arange(0, len(scene.means), 2)
    parameters, first, second = (torch.from_numpy(scene.means.copy()) for _ in range(3))
    engine.kernels.adam(parameters, first, second.abs_(), parameters[ids] + 1, ids, 0.01, 3)
    return {
        **{f"full {name}": array for name, array in full.arrays().items()},
        **{f"some {name}": array for name, array in some.arrays().items()},
        **{f"plain {name}": array for name, array in plain.arrays().items()},
        "drawn": full.drawn,
        **{name: torch.as_tensor(value).numpy() for name, value in loss._asdict().items()},
        "parameters": parameters.numpy(),
        "first": first.numpy(),
        "second": second.numpy(),
    }


def emulated_engine(order, seed, emulator=Emulator):
    return Engine(EmulatedCuda(order, seed, emulator), "cpu")


def assert_same_bits(ours, theirs, context):
    for name, array in theirs.items():
        np.testing.assert_array_equal(ours[name], array, err_msg=f"{context} {name}")


# Several batches of splats per tile, rays that end, splats across the image, and an image of several tiles.
ORDER_SCENES = [
    pytest.param(make_scene(huge_gaussians), id="huge", marks=pytest.mark.long),
    pytest.param(make_scene(opaque_gaussians), id="opaque", marks=pytest.mark.long),
    pytest.param(make_scene(crowd), id="crowd", marks=pytest.mark.slow),
    pytest.param(
        scattered_cloud(np.random.default_rng(5), count=600, width=64, height=64, degree=2),
        id="large",
        marks=pytest.mark.slow,
    ),
]


@pytest.mark.parametrize("scene", ORDER_SCENES)
def test_every_order_gives_the_same_bits(scene):
    """Memory is filled with NaN, so reading shared or device memory before it is written would give NaN."""
    with nan_filled_memory():
        results = [training_step(emulated_engine(*order), scene) for order in ORDERS]
    for order, result in zip(ORDERS[1:], results[1:], strict=True):
        assert_same_bits(result, results[0], order)
    assert all(np.isfinite(array).all() for array in results[0].values())


def test_all_kernels_are_run():
    engine = emulated_engine("forward", 0)
    training_step(engine, make_scene(huge_gaussians))
    engine.kernels.morton_order(torch.zeros(3, 3))
    assert set(engine.kernels.emulator.launched) == {kernel.name for kernel in kernels.all_kernels()}


class Mutant(Emulator):
    """Runs one kernel without one of its barriers."""

    kernel, barrier = "", 0

    def launch(self, kernel, blocks, *arguments):
        if kernel.name == self.kernel:
            parts = kernel.source.split("__syncthreads();")
            head = "__syncthreads();".join(parts[: self.barrier + 1])
            source = head + "__syncthreads();".join(parts[self.barrier + 1 :])
            kernel = Source(kernel.name, kernel.threads, source)
        super().launch(kernel, blocks, *arguments)


class Source(tuple):
    """A kernel with the given source."""

    def __new__(cls, name, threads, source):
        return super().__new__(cls, (name, threads, source))

    name = property(lambda self: self[0])
    threads = property(lambda self: self[1])
    source = property(lambda self: self[2])


@pytest.mark.parametrize(
    "kernel, barrier",
    [("blend", 0), *(("image_loss", n) for n in range(3)), *(("image_loss_backward", n) for n in range(2))],
)
def test_a_missing_barrier_is_detected(kernel, barrier):
    mutant = type("Mutant", (Mutant,), {"kernel": kernel, "barrier": barrier})
    image = torch.rand(20, 24, 3, generator=torch.Generator().manual_seed(2))
    results = []
    for order in ORDERS:
        with nan_filled_memory():
            engine = emulated_engine(*order, mutant)
            if kernel == "blend":
                results.append(run_pass(engine, make_scene(scattered_cloud)).images["color"])
            else:
                l1, ssim, gradient = engine.kernels.image_loss(image, image.flip(0).contiguous(), 0.2)
                results.append(np.r_[float(l1), float(ssim), gradient.numpy().ravel()])
    assert not all(np.array_equal(result, results[0]) for result in results[1:])


@pytest.mark.parametrize("kind", SCENES)
def test_images_equal_the_cpus_bit_for_bit(kind):
    """Both use the same header of mathematics with the same rounding; gradients are summed in another order."""
    scene = make_scene(kind)
    image_gradients = random_image_gradients(scene)
    ours, theirs = (
        run_pass(emulated_engine("forward", 0), scene, image_gradients),
        run_pass(Engine(cpu, "cpu"), scene, image_gradients),
    )
    assert_same_bits(ours.images, theirs.images, kind.__name__)
    for name, array in theirs.gradients.items():
        size = np.abs(array).max(initial=0)
        np.testing.assert_allclose(ours.gradients[name], array, rtol=1e-3, atol=1e-5 * size, err_msg=name)


@pytest.mark.parametrize("rates", [0.01, torch.linspace(0.001, 0.1, 7)], ids=["one", "each"])
def test_adam_steps_equal_the_cpus_bit_for_bit(rates):
    rng = np.random.default_rng(6)
    ids, gradient = torch.arange(0, 40, 3), torch.from_numpy(rng.normal(size=(14, 7)).astype(np.float32))
    results = []
    for device_kernels in (emulated_engine("forward", 0).kernels, cpu):
        results.append([torch.ones(40, 7), torch.zeros(40, 7), torch.zeros(40, 7)])
        for step in (1, 2, 3):
            device_kernels.adam(*results[-1], gradient / step, ids, rates, step)
    assert all(torch.equal(*pair) for pair in zip(*results, strict=True))


def test_without_gradient_nothing_is_stored_for_the_backward_pass():
    scene = make_scene(scattered_cloud)
    engine = emulated_engine("forward", 0)
    rasterizer = engine.kernels.Rasterizer()
    rasterizer.forward = lambda *arguments, forward=rasterizer.forward, **options: forward(
        *arguments, **options, gradient=False
    )
    assert_same_bits(run_pass(engine, scene, None, rasterizer).images, run_pass(engine, scene).images, "")
    with pytest.raises(AssertionError, match="forward pass"):
        rasterizer.backward(torch.zeros(22, 37, 3), None, None, None)


def test_the_morton_order_sorts_interleaved_bits():
    rng = np.random.default_rng(7)
    points = rng.normal(size=(200, 3)).astype(np.float32)
    points[50:60] = points[40:50]
    minimum, size = points.min(axis=0), (points.max(axis=0) - points.min(axis=0)).max()
    cells = np.minimum((points - minimum) * (np.float32(2**21) / size), np.float32(2**21 - 1)).astype(np.int64)
    bits = (cells[:, :, None] >> np.arange(21)) & 1
    codes = (bits << (3 * np.arange(21) + np.arange(3)[:, None])).sum(axis=(1, 2))
    order = emulated_engine("forward", 0).kernels.morton_order(torch.from_numpy(points)).numpy()
    np.testing.assert_array_equal(order, np.argsort(codes, kind="stable"))


def test_the_morton_order_of_equal_points_and_of_none():
    device_kernels = emulated_engine("forward", 0).kernels
    assert device_kernels.morton_order(torch.ones(5, 3)).tolist() == [0, 1, 2, 3, 4]
    assert device_kernels.morton_order(torch.zeros(0, 3)).tolist() == []
    line = [[3.0, 0, 0], [1, 0, 0], [2, 0, 0]]
    assert device_kernels.morton_order(torch.tensor(line)).tolist() == [1, 2, 0]


def test_constants_are_part_of_the_source():
    kernel = kernels.blend(kernels.DEPTH, False)
    assert "constexpr int kGeometry = 1;" in kernel.source and "#include" not in kernel.source
    assert replace(kernel, constants=(("kGeometry", 0),)).source != kernel.source
