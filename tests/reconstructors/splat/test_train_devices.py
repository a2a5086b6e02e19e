"""Training on CUDA equals that on the CPU up to the order of sums; emulated, and on a GPU (python -m pytest -m gpu)."""

from dataclasses import fields, replace

import numpy as np
import pytest
from optional import import_or_skip
from splat_scenes import scattered_cloud
from wording import check_error, check_text

from pcbench.errors import InputError, MissingExtra, ReconstructionError
from pcbench.geometry.cameras import look_at

torch = import_or_skip("torch")

from cuda_emulator import EmulatedCuda, Emulator  # noqa: E402
from splat_training import mean_psnr  # noqa: E402
from torch.utils._python_dispatch import TorchDispatchMode  # noqa: E402

from reconstructors.splat import devices, train  # noqa: E402
from reconstructors.splat.background import Background  # noqa: E402
from reconstructors.splat.density import Classic  # noqa: E402
from reconstructors.splat.devices import choose_device  # noqa: E402
from reconstructors.splat.exposure import Exposure  # noqa: E402
from reconstructors.splat.model import Gaussians  # noqa: E402
from reconstructors.splat.optimizer import raise_sh_degree  # noqa: E402
from reconstructors.splat.photographs import Photograph  # noqa: E402
from reconstructors.splat.resume import load_model, save_model  # noqa: E402
from reconstructors.splat.splat import GaussianSplatting  # noqa: E402
from reconstructors.splat.train import Schedule, Training, render  # noqa: E402
from reconstructors.splat.view import View  # noqa: E402

GAUSSIANS, STEPS = 60, 200


def truth():
    """Return a model and six images of it from around; the second has a mask, the third an alpha channel."""
    scene = scattered_cloud(np.random.default_rng(8), GAUSSIANS, width=32, height=24, degree=1, size=0.25)
    means, quats, scales, opacities, sh = (torch.from_numpy(array) for array in scene.arrays)
    model = Gaussians(means, quats, scales.log(), torch.logit(opacities.clamp(0.3, 0.95)), sh * 0.5)
    valid = torch.ones(24, 32, dtype=torch.bool)
    valid[5:12, 3:20] = False
    pictures = []
    for k, angle in enumerate(np.linspace(0, 2 * np.pi, 6, endpoint=False)):
        position = (4 * np.cos(angle), 4 * np.sin(angle), 1.5)
        view = View.of(replace(scene.camera, cam_from_world=look_at(position, (0, 0, 0))))
        color = (render(model, view) * 255).round().to(torch.uint8)
        alpha = torch.where(color.max(dim=2).values > 0, 255, 0).to(torch.uint8)
        pictures.append(Photograph(str(k), view, color, valid if k == 1 else None, alpha if k == 2 else None))
    return model, pictures


TRUTH = truth()


def new_training(device="cpu"):
    """Return a training that starts with slightly wrong positions and unknown other parameters."""
    model, pictures = TRUTH
    pyramids = []
    for picture in pictures:
        color, valid, alpha = (None if part is None else part.to(device) for part in picture[2:])
        pyramids.append([picture._replace(color=color, valid=valid, alpha=alpha)])
    noise = torch.from_numpy(np.random.default_rng(9).normal(size=(GAUSSIANS, 3)).astype(np.float32))
    start = Gaussians(
        model.means + 0.05 * noise,
        torch.tensor([1.0, 0, 0, 0]).repeat(GAUSSIANS, 1),
        torch.tensor([0.3, 0.2, 0.12]).log().repeat(GAUSSIANS, 1),  # the axes of a sphere would be arbitrary
        torch.full((GAUSSIANS,), -1.0),
        torch.zeros(GAUSSIANS, 1, 3),
    ).to(torch.device(device))
    schedule = Schedule(steps=STEPS, sh_degree=1, downscale_shares=(0, 0))
    background = Background((0.4, 0.4, 0.4), device, is_learned=True, is_random=True)
    return Training(start, pyramids, schedule, Classic(refine_start=STEPS + 1), background=background)


def parts(model):
    return {field.name: getattr(model, field.name).cpu().numpy() for field in fields(model)}


def psnr(training):
    return mean_psnr(training.model, [pyramid[0] for pyramid in training.photographs])


def assert_similar(ours, theirs, order, tolerance=1e-4):
    """Compare two trainings, the first of which had its Gaussians reordered.

    Gradients are sums in another order, and each step inherits the rounding of the one before: after 200 steps the root
    mean square of the differences is 4e-6 of the distance that the parameters have moved. It is up to 4e-2 if all are
    changed by one millionth at the start.
    """
    assert ours.step == theirs.step
    assert psnr(ours) == pytest.approx(psnr(theirs), abs=tolerance)
    start = parts(raise_sh_degree(new_training().model))
    for name, values in parts(theirs.model).items():
        distance = np.sqrt(np.mean((values - start[name]) ** 2))
        assert np.sqrt(np.mean((parts(ours.model)[name] - values[order]) ** 2)) < tolerance * distance, name
    for own_rows, other_rows in zip(ours.screen_gradients, theirs.screen_gradients, strict=True):
        np.testing.assert_allclose(own_rows.cpu(), other_rows[order], atol=tolerance * float(other_rows.max()))
    np.testing.assert_allclose([*map(float, ours.psnr)], [*map(float, theirs.psnr)], atol=10 * tolerance)


@pytest.mark.parametrize(
    "steps", [pytest.param(65, marks=pytest.mark.long), pytest.param(STEPS, marks=pytest.mark.slow)]
)
def test_emulated_training_equals_that_of_the_cpu(steps, monkeypatch):
    cpu_training, kernels = new_training(), EmulatedCuda()
    before = psnr(cpu_training)
    cpu_training.run(steps)
    assert psnr(cpu_training) > before + 4
    monkeypatch.setattr(train, "kernels_of", lambda _: kernels)
    training = new_training()
    order = kernels.morton_order(training.model.means).numpy()
    training.run(steps)
    assert_similar(training, cpu_training, order)


class SynchronisationRecorder(TorchDispatchMode):
    """Records operations that synchronise with a GPU: values read by the host, and rows that are counted first."""

    def __init__(self):
        super().__init__()
        self.names = []

    def __torch_dispatch__(self, function, types, arguments=(), options=None):
        if function.overloadpacket in (torch.ops.aten._local_scalar_dense, torch.ops.aten.nonzero):
            self.names.append(str(function))
        return function(*arguments, **(options or {}))


def test_a_step_synchronises_only_to_read_the_number_of_instances(monkeypatch):
    """That number is read by `tolist`, which the recorder does not see."""
    monkeypatch.setattr(train, "kernels_of", lambda _: EmulatedCuda())
    training, counts = new_training(), []
    with SynchronisationRecorder() as recorder:
        training.run(3, lambda _: counts.append(len(recorder.names)))
    # After the last step all parameters are checked to be finite.
    assert counts[:2] == [0, 0] and counts[2] > 0


class MetaEmulator(Emulator):
    """Launches nothing, but checks the arguments."""

    def launch(self, kernel, blocks, *arguments):
        assert all(argument.is_meta for argument in arguments if isinstance(argument, torch.Tensor)), kernel.name
        self.launched.append(kernel.name)


@pytest.mark.long
def test_all_tensors_of_a_step_are_on_the_device(monkeypatch):
    """Tensors on the device `meta` have no values, and most operations refuse to mix them with those of the CPU."""
    kernels = EmulatedCuda(emulator=MetaEmulator)
    monkeypatch.setattr(train, "kernels_of", lambda _: kernels)
    monkeypatch.setattr(torch.Tensor, "tolist", lambda tensor: [40, 100])  # number of drawn Gaussians and of instances
    for method in ("_check_model", "_check_convergence"):  # which read values
        monkeypatch.setattr(Training, method, lambda training: None)
    training = new_training("meta")
    training.exposure = Exposure([pyramid[0].name for pyramid in training.photographs], "meta")
    training.run(66)
    assert training.model.degree == 1 and training.psnr[0].is_meta
    # For each of five kinds of parameters, and for the background of the five of six photographs that are opaque.
    assert kernels.emulator.launched.count("adam") == 5 * 66 + 55


def test_reordering_includes_everything_that_belongs_to_the_gaussians():
    """A training in another order continues in the same way."""
    original, reordered = new_training(), new_training()
    order = torch.from_numpy(np.random.default_rng(3).permutation(GAUSSIANS))
    for training in (original, reordered):
        training.run(10)
    reordered.reorder(order)
    for training in (original, reordered):
        training.run(20)
    assert_similar(reordered, original, order.numpy())


def test_models_are_loaded_to_the_requested_device(tmp_path, monkeypatch):
    model = new_training().model
    save_model(tmp_path / "model.pt", model)
    assert load_model(tmp_path / "model.pt", torch.device("meta")).means.device.type == "meta"
    assert model.to(torch.device("meta")).sh.device.type == "meta"
    new_training().save(tmp_path / "checkpoint.pt", "key")
    monkeypatch.setattr(train, "kernels_of", lambda _: EmulatedCuda())
    training = new_training("meta")
    assert training.load(tmp_path / "checkpoint.pt", "key")
    assert training.model.sh.is_meta and training.optimizer.first.sh.is_meta and training.screen_gradients.views.is_meta


def test_the_device_is_chosen_by_availability(monkeypatch):
    """Without a GPU, with one on which no kernel runs, and with one."""
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    for setting in ("auto", "cpu"):
        assert choose_device(setting) == (torch.device("cpu"), None)
    with check_error():
        choose_device("cuda")

    def raise_on_run(error):
        def run(device):
            raise error

        return run

    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "current_device", lambda: 1)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda device: f"GPU {device.index}")
    missing_extra, driver_error = (
        MissingExtra("NVRTC", "cuda", "it is not installed"),
        RuntimeError("the driver is old\nat line 5"),
    )
    for error, error_type in [(missing_extra, MissingExtra), (driver_error, InputError)]:
        monkeypatch.setattr(devices, "_run_smallest_kernel", raise_on_run(error))
        with check_error(error_type):
            choose_device("cuda")
        device, note = choose_device("auto")
        assert device.type == "cpu"
        assert str(error).splitlines()[0] in check_text(note)
    monkeypatch.setattr(devices, "_run_smallest_kernel", lambda device: None)
    for setting in ("auto", "cuda"):
        assert choose_device(setting) == (
            torch.device("cuda:1"),
            "trained on GPU 1; set device=cpu to train on the CPU",
        )
    assert choose_device("cpu") == (torch.device("cpu"), None)


def test_without_a_gpu_no_work_is_started_on_one(monkeypatch, tmp_path):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with check_error():
        GaussianSplatting(device="cuda").reconstruct([None] * 3, tmp_path)
    assert not [*tmp_path.iterdir()]


def test_running_out_of_gpu_memory_is_an_error_with_advice(monkeypatch, tmp_path):
    def raise_out_of_memory(*_):
        raise torch.cuda.OutOfMemoryError("CUDA out of memory. Tried to allocate 20.00 MiB.")

    monkeypatch.setattr(GaussianSplatting, "_reconstruct", raise_out_of_memory)
    with check_error(ReconstructionError):
        GaussianSplatting().reconstruct([None] * 3, tmp_path)


@pytest.mark.gpu
def test_training_on_a_gpu_equals_that_on_the_cpu(tmp_path):
    """Each resumes a checkpoint of the other."""
    if not torch.cuda.is_available():
        pytest.skip("torch finds no CUDA device")
    from reconstructors.splat import cuda

    assert choose_device("auto").device.type == "cuda"
    cpu_training, training = new_training(), new_training("cuda")
    order = cuda.morton_order(training.model.means).cpu().numpy()
    cpu_training.run(STEPS)
    training.run(STEPS // 2)
    training.save(tmp_path / "half.pt", "key")
    resumed_on_gpu, resumed_on_cpu = new_training("cuda"), new_training()
    for resumed in (resumed_on_gpu, resumed_on_cpu):
        assert resumed.load(tmp_path / "half.pt", "key")
        assert resumed.model.means.device == resumed.photographs[0][0].color.device
        resumed.run(STEPS)
        # exp() and other functions are rounded differently on a GPU.
        assert_similar(resumed, cpu_training, order, tolerance=0.02)
    training.run(STEPS)
    for name, values in parts(training.model).items():  # a resumed run equals an uninterrupted one, bit for bit
        np.testing.assert_array_equal(parts(resumed_on_gpu.model)[name], values)
