"""Training on CUDA is that of the CPU, but for the order of sums: emulated, and on a GPU (python -m pytest -m gpu)."""

from dataclasses import fields, replace

import numpy as np
import pytest
from optional import import_or_skip
from splat_scenes import scattered
from wording import refused, said

from pcbench.errors import InputError, MissingExtra, ReconstructionError
from pcbench.geometry.cameras import look_at

torch = import_or_skip("torch")

from cuda_emulator import EmulatedCuda, Emulator  # noqa: E402
from torch.utils._python_dispatch import TorchDispatchMode  # noqa: E402

from reconstructors.splat import devices, train  # noqa: E402
from reconstructors.splat.density import Density  # noqa: E402
from reconstructors.splat.devices import choose_device  # noqa: E402
from reconstructors.splat.model import Gaussians  # noqa: E402
from reconstructors.splat.optimizer import raise_sh_degree  # noqa: E402
from reconstructors.splat.photographs import Photograph  # noqa: E402
from reconstructors.splat.resume import load_model, save_model  # noqa: E402
from reconstructors.splat.splat import GaussianSplatting  # noqa: E402
from reconstructors.splat.train import Schedule, Training, evaluate, render  # noqa: E402
from reconstructors.splat.view import View  # noqa: E402

GAUSSIANS, STEPS = 60, 200


def truth():
    """A model and six pictures of it from around; the second has a mask."""
    scene = scattered(np.random.default_rng(8), GAUSSIANS, width=32, height=24, degree=1, size=0.25)
    means, quats, scales, opacities, sh = (torch.from_numpy(array) for array in scene.arrays)
    model = Gaussians(means, quats, scales.log(), torch.logit(opacities.clamp(0.3, 0.95)), sh * 0.5)
    valid = torch.ones(24, 32, dtype=torch.bool)
    valid[5:12, 3:20] = False
    pictures = []
    for k, angle in enumerate(np.linspace(0, 2 * np.pi, 6, endpoint=False)):
        place = (4 * np.cos(angle), 4 * np.sin(angle), 1.5)
        view = View.of(replace(scene.camera, cam_from_world=look_at(place, (0, 0, 0))))
        color = (render(model, view) * 255).round().to(torch.uint8)
        pictures.append(Photograph(str(k), view, color, valid if k == 1 else None))
    return model, pictures


TRUTH = truth()


def new_training(device="cpu"):
    """Places that are a little off, all else unknown."""
    model, pictures = TRUTH
    pyramids = []
    for picture in pictures:
        valid = None if picture.valid is None else picture.valid.to(device)
        pyramids.append([picture._replace(color=picture.color.to(device), valid=valid)])
    noise = torch.from_numpy(np.random.default_rng(9).normal(size=(GAUSSIANS, 3)).astype(np.float32))
    start = Gaussians(
        model.means + 0.05 * noise,
        torch.tensor([1.0, 0, 0, 0]).repeat(GAUSSIANS, 1),
        torch.tensor([0.3, 0.2, 0.12]).log().repeat(GAUSSIANS, 1),  # round ones would turn at random
        torch.full((GAUSSIANS,), -1.0),
        torch.zeros(GAUSSIANS, 1, 3),
    ).to(torch.device(device))
    return Training(start, pyramids, Schedule(steps=STEPS, sh_degree=1, downscale_shares=(0, 0)), Density())


def parts(model):
    return {field.name: getattr(model, field.name).cpu().numpy() for field in fields(model)}


def psnr(training):
    return np.mean(evaluate(training.model, [pyramid[0] for pyramid in training.photographs]))


def assert_alike(ours, theirs, order, within=1e-4):
    """Two trainings, the first of which had its Gaussians brought into an order.

    Derivatives are sums in another order, and each step takes over what the last one has rounded: after 200 steps the
    root mean square of the differences is 4e-6 of how far the numbers have come, where it is up to 4e-2 if they are all
    one millionth off at the start.
    """
    assert ours.step == theirs.step
    assert psnr(ours) == pytest.approx(psnr(theirs), abs=within)
    start = parts(raise_sh_degree(new_training().model))
    for name, numbers in parts(theirs.model).items():
        moved = np.sqrt(np.mean((numbers - start[name]) ** 2))
        assert np.sqrt(np.mean((parts(ours.model)[name] - numbers[order]) ** 2)) < within * moved, name
    for mine, other in zip(ours.screen_gradients, theirs.screen_gradients, strict=True):
        np.testing.assert_allclose(mine.cpu(), other[order], atol=within * float(other.max()))
    np.testing.assert_allclose([*map(float, ours.psnr)], [*map(float, theirs.psnr)], atol=10 * within)


@pytest.mark.parametrize("steps", [40, pytest.param(STEPS, marks=pytest.mark.slow)])
def test_emulated_it_is_that_of_the_cpu(steps, monkeypatch):
    on_cpu, kernels = new_training(), EmulatedCuda()
    before = psnr(on_cpu)
    on_cpu.run(steps)
    assert psnr(on_cpu) > before + 4
    monkeypatch.setattr(train, "kernels_of", lambda _: kernels)
    training = new_training()
    order = kernels.morton_order(training.model.means).numpy()
    training.run(steps)
    assert_alike(training, on_cpu, order)


class Asked(TorchDispatchMode):
    """Lists what a GPU would have to be waited for: numbers that the host reads, and rows that are counted first."""

    def __init__(self):
        super().__init__()
        self.names = []

    def __torch_dispatch__(self, function, types, given=(), options=None):
        if function.overloadpacket in (torch.ops.aten._local_scalar_dense, torch.ops.aten.nonzero):
            self.names.append(str(function))
        return function(*given, **(options or {}))


def test_a_step_waits_for_the_count_of_what_is_drawn_and_for_nothing_else(monkeypatch):
    """That one is read by `tolist`, of which this list knows nothing."""
    monkeypatch.setattr(train, "kernels_of", lambda _: EmulatedCuda())
    training, counts = new_training(), []
    with Asked() as asked:
        training.run(3, lambda _: counts.append(len(asked.names)))
    # After the last one it is asked whether all numbers are finite.
    assert counts[:2] == [0, 0] and counts[2] > 0


class OnMeta(Emulator):
    """Runs nothing, but looks at what it is given."""

    def launch(self, kernel, blocks, *arguments):
        assert all(argument.is_meta for argument in arguments if isinstance(argument, torch.Tensor)), kernel.name
        self.launched.append(kernel.name)


def test_all_of_a_step_is_on_the_device(monkeypatch):
    """Tensors on the device `meta` have no numbers, and most of what is done with them refuses those of the CPU."""
    kernels = EmulatedCuda(emulator=OnMeta)
    monkeypatch.setattr(train, "kernels_of", lambda _: kernels)
    monkeypatch.setattr(torch.Tensor, "tolist", lambda tensor: [40, 100])  # Gaussians that are drawn, instances
    for look in ("_check_model", "_check_convergence"):  # now and then, to read numbers
        monkeypatch.setattr(Training, look, lambda training: None)
    training = new_training("meta")
    training.run(STEPS // 5)
    assert training.model.degree == 1 and training.psnr[0].is_meta
    assert kernels.emulator.launched.count("adam") == STEPS  # of five kinds of numbers each


def test_an_order_is_brought_to_all_that_belongs_to_the_gaussians():
    """A training in another order goes on as it would have."""
    plain, turned = new_training(), new_training()
    order = torch.from_numpy(np.random.default_rng(3).permutation(GAUSSIANS))
    for training in (plain, turned):
        training.run(10)
    turned.reorder(order)
    for training in (plain, turned):
        training.run(20)
    assert_alike(turned, plain, order.numpy())


def test_numbers_are_loaded_to_the_device_that_is_wanted(tmp_path, monkeypatch):
    model = new_training().model
    save_model(tmp_path / "model.pt", model)
    assert load_model(tmp_path / "model.pt", torch.device("meta")).means.device.type == "meta"
    assert model.to(torch.device("meta")).sh.device.type == "meta"
    new_training().save(tmp_path / "checkpoint.pt", "key")
    monkeypatch.setattr(train, "kernels_of", lambda _: EmulatedCuda())
    training = new_training("meta")
    assert training.load(tmp_path / "checkpoint.pt", "key")
    assert training.model.sh.is_meta and training.optimizer.first.sh.is_meta and training.screen_gradients.views.is_meta


def test_where_to_compute(monkeypatch):
    """Without a GPU, with one on which no kernel runs, and with one."""
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    for wanted in ("auto", "cpu"):
        assert choose_device(wanted) == (torch.device("cpu"), None)
    with refused():
        choose_device("cuda")

    def fails(error):
        def run(device):
            raise error

        return run

    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "current_device", lambda: 1)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda device: f"GPU {device.index}")
    missing, broken = MissingExtra("NVRTC", "cuda", "it is not there"), RuntimeError("the driver is old\nat line 5")
    for error, raised in [(missing, MissingExtra), (broken, InputError)]:
        monkeypatch.setattr(devices, "_run_smallest_kernel", fails(error))
        with refused(raised):
            choose_device("cuda")
        device, note = choose_device("auto")
        assert device.type == "cpu"
        assert str(error).splitlines()[0] in said(note)
    monkeypatch.setattr(devices, "_run_smallest_kernel", lambda device: None)
    for wanted in ("auto", "cuda"):
        assert choose_device(wanted) == (torch.device("cuda:1"), "trained on GPU 1; set device=cpu to train on the CPU")
    assert choose_device("cpu") == (torch.device("cpu"), None)


def test_without_a_gpu_nothing_is_begun_on_one(monkeypatch, tmp_path):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with refused():
        GaussianSplatting(device="cuda").reconstruct([None] * 3, tmp_path)
    assert not [*tmp_path.iterdir()]


def test_memory_that_a_gpu_has_not_ends_with_a_sentence(monkeypatch, tmp_path):
    def full(*_):
        raise torch.cuda.OutOfMemoryError("CUDA out of memory. Tried to allocate 20.00 MiB.")

    monkeypatch.setattr(GaussianSplatting, "_reconstruct", full)
    with refused(ReconstructionError):
        GaussianSplatting().reconstruct([None] * 3, tmp_path)


@pytest.mark.gpu
def test_on_a_gpu_it_is_that_of_the_cpu(tmp_path):
    """And what either leaves the other takes up."""
    if not torch.cuda.is_available():
        pytest.skip("torch finds no CUDA device")
    from reconstructors.splat import cuda

    assert choose_device("auto").device.type == "cuda"
    on_cpu, training = new_training(), new_training("cuda")
    order = cuda.morton_order(training.model.means).cpu().numpy()
    on_cpu.run(STEPS)
    training.run(STEPS // 2)
    training.save(tmp_path / "half.pt", "key")
    there, here = new_training("cuda"), new_training()
    for other in (there, here):
        assert other.load(tmp_path / "half.pt", "key")
        assert other.model.means.device == other.photographs[0][0].color.device
        other.run(STEPS)
        assert_alike(other, on_cpu, order, within=0.02)  # exp() and others are a GPU's own, and rounded otherwise
    training.run(STEPS)
    for name, numbers in parts(training.model).items():  # a run that goes on is an unbroken one, bit for bit
        np.testing.assert_array_equal(parts(there.model)[name], numbers)
