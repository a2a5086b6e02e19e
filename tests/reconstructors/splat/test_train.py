"""Training: images approach the photographs, a resumed run equals an uninterrupted one, densification and pruning."""

from dataclasses import replace

import numpy as np
import pytest
from optional import import_or_skip
from splat_scenes import scattered_cloud
from wording import check_error

from pcbench.errors import ReconstructionError
from pcbench.geometry.cameras import look_at

torch = import_or_skip("torch")

from splat_training import grey, mean_psnr, numbers, truth  # noqa: E402

from reconstructors.splat.density import Classic, Density, halve, split  # noqa: E402
from reconstructors.splat.devices import kernels_of  # noqa: E402
from reconstructors.splat.interface import Gradients  # noqa: E402
from reconstructors.splat.model import Gaussians, LocalFrame  # noqa: E402
from reconstructors.splat.optimizer import LearningRates, Optimizer  # noqa: E402
from reconstructors.splat.resume import load_model, run_with_checkpoints, save_checkpoint, save_model  # noqa: E402
from reconstructors.splat.rotations import rotate  # noqa: E402
from reconstructors.splat.train import Schedule, Training  # noqa: E402


def new_training(density=Density(), steps=160, **schedule):  # noqa: B008
    model, pictures = truth()
    return Training(
        grey(model), pictures, Schedule(steps=steps, sh_degree=1, downscale_shares=(0, 0), **schedule), density
    )


def test_images_approach_the_photographs():
    training = new_training()
    pictures = [pyramid[0] for pyramid in training.photographs]
    before = mean_psnr(training.model, pictures)
    training.run(160)
    assert mean_psnr(training.model, pictures) > before + 8
    assert training.model.degree == 1


def test_a_resumed_run_equals_an_uninterrupted_one(tmp_path):
    density = Classic(
        refine_start=20,
        refine_interval=10,
        grow_gradient=1e-6,
        refine_stop_share=0.8,
        reset_interval=40,
        prune_opacity=0.0,
        prune_scale=10,
        max_gaussians=150,
    )
    uninterrupted = new_training(density, steps=90)
    uninterrupted.run(90)
    assert len(uninterrupted.model) > 60  # so random numbers were used
    first = new_training(density, steps=90)
    first.run(47)
    save_checkpoint(first, tmp_path / "checkpoint.pt", "key")
    second = new_training(density, steps=90)
    assert not second.load(tmp_path / "checkpoint.pt", "another key")
    assert second.step == 0
    assert numbers(run_with_checkpoints(second, tmp_path / "checkpoint.pt", "key")) == numbers(uninterrupted.model)
    assert not (tmp_path / "checkpoint.pt").exists()


def test_the_model_is_determined_by_the_seed():
    runs = [new_training(steps=20, seed=seed) for seed in (0, 0, 1)]
    for run in runs:
        run.run(20)
    first, second, other = (numbers(run.model) for run in runs)
    assert first == second != other


@pytest.mark.long
def test_training_converges_when_the_photographs_no_longer_improve(tmp_path):
    stopped_early, uninterrupted = new_training(steps=400, plateau=2.0), new_training(steps=400, plateau=-np.inf)
    stopped_early.run(400)
    assert stopped_early.converged and 120 <= stopped_early.step < 400 and stopped_early.step % 40 == 0
    mean_psnr = []
    for step in (stopped_early.step - 80, stopped_early.step - 40, stopped_early.step):
        uninterrupted.run(step)
        mean_psnr.append(np.mean(uninterrupted.psnr))
    assert mean_psnr[2] - min(mean_psnr[:2]) < 2.0
    assert numbers(uninterrupted.model) == numbers(stopped_early.model)
    assert not uninterrupted.converged
    stopped_early.save(tmp_path / "checkpoint.pt", "key")
    rerun = new_training(steps=400, plateau=2.0)
    assert numbers(run_with_checkpoints(rerun, tmp_path / "checkpoint.pt", "key")) == numbers(stopped_early.model)


def test_contributions_are_blending_weights_summed_over_pixels():
    """The weights of all Gaussians sum to alpha at each pixel, whatever their colours."""
    training = new_training()
    training.model.sh[:] = -1  # black
    view_sums = [
        1
        - kernels_of(torch.device("cpu"))
        .Rasterizer()
        .forward(training.model.tensors, pyramid[0].view, torch.zeros(3), geometry=False)
        .transmittance
        for pyramid in training.photographs
    ]
    assert float(training.contributions().sum()) == pytest.approx(float(torch.stack(view_sums).sum()), rel=1e-5)


def test_low_alphas_are_skipped_until_the_last_steps():
    schedule, view = Schedule(steps=10, min_alpha=1 / 128, exact_share=0.8), truth()[1][0][0].view
    assert [schedule.rendered(view, step).min_alpha for step in (0, 7, 8, 9)] == [1 / 128, 1 / 128, 1 / 255, 1 / 255]


def test_masked_pixels_do_not_influence_training():
    """Black rectangles in the photographs have no effect if a mask covers them."""
    plain, masked = new_training(steps=60), new_training(steps=60)
    for pyramid in masked.photographs:
        photograph = pyramid[0]
        valid = torch.ones(photograph.color.shape[:2], dtype=torch.bool)
        valid[10:22, 15:33] = False
        pyramid[0] = photograph._replace(color=photograph.color * valid[..., None], valid=valid)
    plain_views = [pyramid[0] for pyramid in plain.photographs]
    plain.run(60)
    masked.run(60)
    unmasked = new_training(steps=60)
    for unmasked_pyramid, masked_pyramid in zip(unmasked.photographs, masked.photographs, strict=True):
        unmasked_pyramid[0] = masked_pyramid[0]._replace(valid=None)
    unmasked.run(60)
    psnr_with_mask, psnr_without_mask = (mean_psnr(run.model, plain_views) for run in (masked, unmasked))
    assert psnr_with_mask > psnr_without_mask + 2


def test_parameters_that_are_not_finite_are_an_error():
    training = new_training()
    training.model.sh[3] = float("nan")
    with check_error(ReconstructionError):
        training.run(5)


def test_parameters_that_are_not_finite_are_no_convergence():
    training = new_training(steps=100, plateau=np.inf)

    def set_nan(state):
        if state.step == 29:
            state.model.means[3] = np.nan  # the rasterizer skips it

    with check_error(ReconstructionError):
        training.run(100, set_nan)


def test_a_model_without_gaussians_is_an_error():
    training = new_training(Classic(refine_start=4, refine_interval=5, prune_opacity=1.0))
    with check_error(ReconstructionError):
        training.run(5)


def test_opacities_are_not_reset_when_densification_stops():
    """Nothing would prune the Gaussians that a reset leaves transparent (Kerbl et al. stop before that step)."""
    training = new_training(
        Classic(refine_start=5, refine_interval=5, reset_interval=10, prune_opacity=0.0, prune_scale=10), steps=40
    )
    transparent_at = []

    def record(state):
        if float(state.model.opacities.max()) <= 0.01 + 1e-6:  # rounding of the logit
            transparent_at.append(state.step)

    training.run(21, record)
    assert transparent_at == [10]


def test_adam_moves_all_gaussians_if_it_is_told_to():
    for update_all in (False, True):
        model, _ = truth()
        optimizer = Optimizer(model, kernels_of(model.means.device).adam)
        start = model.means.clone()
        rates = LearningRates(update_all=update_all)
        for count, drawn in enumerate(([0, 1], [1]), 1):
            ids = torch.tensor(drawn)
            ones = [torch.ones((len(drawn), *shape)) for shape in ((3,), (4,), (3,), (), model.sh.shape[1:], (2,))]
            optimizer.step(model, Gradients(ids, *ones), rates, 0.0, count)
            moved = (model.means - start).abs().amax(dim=1) > 0
            start = model.means.clone()
        assert moved.nonzero().flatten().tolist() == ([0, 1] if update_all else [1])


def test_splitting_keeps_the_distribution_and_shrinks():
    model, _ = truth()
    copies = Gaussians(*(part[:1].repeat(4000, *[1] * (part.ndim - 1)) for part in vars(model).values()))
    halves = split(copies, 1.6, np.random.default_rng(0))
    assert len(halves) == 8000
    torch.testing.assert_close(halves.scales, copies.scales.repeat(2, 1) / 1.6)
    # Their positions are sampled from the Gaussian: along its axes they deviate by its scales, up to sampling error.
    inverse_rotation = copies.quats[0] * torch.tensor([1.0, -1, -1, -1])
    local = rotate(inverse_rotation.repeat(8000, 1), halves.means - copies.means[0])
    np.testing.assert_allclose(local.std(dim=0), copies.scales[0], rtol=0.04)
    np.testing.assert_allclose(local.mean(dim=0) / copies.scales[0], 0, atol=0.05)


def test_two_halves_have_the_moments_and_the_opacity_of_the_whole():
    whole, _ = truth()
    whole.logits.clamp_(max=2.0)
    halves = halve(whole)
    first, second = (halves.select(slice(k * len(whole), (k + 1) * len(whole))) for k in (0, 1))
    np.testing.assert_allclose((first.means + second.means) / 2, whole.means, atol=1e-6)
    inverse_rotations = whole.quats * torch.tensor([1.0, -1, -1, -1])
    offsets = rotate(inverse_rotations, first.means - whole.means)  # along the axes
    torch.testing.assert_close(first.scales**2 + offsets**2, whole.scales**2)
    # Alpha at the centre of the whole, from which both halves are equally far.
    alphas = first.opacities * torch.exp(-((offsets / first.scales) ** 2).sum(dim=1) / 2)
    torch.testing.assert_close(1 - (1 - alphas) ** 2, whole.opacities, rtol=1e-5, atol=1e-5)


def test_classic_density_respects_the_maximum_and_prunes_low_opacities():
    training = new_training(
        Classic(
            refine_start=5,
            refine_interval=5,
            grow_gradient=0.0,
            refine_stop_share=1.0,
            reset_interval=0,
            max_gaussians=100,
        ),
        steps=40,
    )
    training.run(25)
    assert 60 < len(training.model) <= 100
    training.model.logits[::2] = -20.0
    count = len(training.model)
    training.run(30)
    assert float(training.model.opacities.min()) >= 5e-3
    assert len(training.model) <= 100
    assert count > 60


def test_a_local_frame_scales_projected_coordinates_to_unit_size():
    scene = scattered_cloud(np.random.default_rng(0))
    origin = np.array([500_000.0, 5_400_000.0, 200.0])
    cameras = []
    for angle in np.linspace(0, 2 * np.pi, 6, endpoint=False):
        position = origin + 300 * np.array([np.cos(angle), np.sin(angle), 1])
        cameras.append(replace(scene.camera, cam_from_world=look_at(position, origin)))
    frame = LocalFrame.of(cameras)
    points = origin + np.random.default_rng(1).uniform(-50, 50, size=(100, 3))
    assert frame.unit == pytest.approx(330)
    np.testing.assert_allclose(frame.to_world(frame.to_local(points)), points, atol=1e-7)  # the precision of float64
    pixels, depth = cameras[0].project(points)
    local_pixels, local_depth = frame.camera(cameras[0]).project(frame.to_local(points))
    np.testing.assert_allclose(local_pixels, pixels, atol=1e-6)
    np.testing.assert_allclose(local_depth * frame.unit, depth, atol=1e-6)


def test_a_saved_model_is_loaded_unchanged(tmp_path):
    model, _ = truth()
    save_model(tmp_path / "model.pt", model)
    assert numbers(load_model(tmp_path / "model.pt")) == numbers(model)
