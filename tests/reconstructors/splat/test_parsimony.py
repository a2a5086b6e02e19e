"""The number of Gaussians: the smallest model within the noise of the best is selected and trained further."""

from types import SimpleNamespace

import numpy as np
import pytest
from optional import import_or_skip
from scipy import stats

torch = import_or_skip("torch")

from splat_planes import plane_scene  # noqa: E402
from splat_training import grey, numbers, truth  # noqa: E402
from wording import check_error, check_text  # noqa: E402

from reconstructors.splat.curve import CRITERIA, Budget, Curve, Loss, select_budget  # noqa: E402
from reconstructors.splat.model import Gaussians  # noqa: E402
from reconstructors.splat.parsimony import Parsimonious, score_surface, score_views  # noqa: E402
from reconstructors.splat.resume import run_with_checkpoints, save_checkpoint  # noqa: E402
from reconstructors.splat.train import Schedule, Training  # noqa: E402


def make_budget(gaussians, *psnr, ssim=0.8, degree=2):
    return Budget(gaussians, degree, (psnr, (ssim,) * len(psnr)), 1.0)


def test_a_loss_has_the_interval_of_a_paired_t_test():
    psnr, smaller_psnr = (20.0, 35.0, 28.0), (19.9, 34.7, 27.5)
    loss = Loss.of(make_budget(100, *smaller_psnr), make_budget(200, *psnr))
    losses = np.subtract(psnr, smaller_psnr)
    assert loss == pytest.approx((0.3, *stats.t.interval(0.95, 2, losses.mean(), stats.sem(losses))))


def test_the_smallest_within_the_noise_of_the_best_is_selected():
    best = make_budget(800, 30.0, 20.0, 25.0)
    equivalent = make_budget(200, 30.1, 19.8, 24.9)  # 0.067 less, with an interval of 0.38 to both sides
    worse = make_budget(100, 29.9, 19.9, 24.9)  # 0.1 less in each block
    blurred = make_budget(100, 30.1, 19.8, 24.9, ssim=0.79)  # 0.01 less SSIM in each block
    views = CRITERIA["views"]
    assert select_budget([best, equivalent, worse, blurred], views) == 1
    assert select_budget([best, worse], views) == 0
    # Each is beaten by another one: the best PSNR decides.
    assert select_budget([best, best._replace(gaussians=400, scores=(worse.scores[0], (0.81,) * 3))], views) == 0
    # The same number with spherical harmonics of a lower degree is smaller.
    assert select_budget([best, equivalent, worse, equivalent._replace(degree=0)], views) == 3
    check_text(Curve((best,)).sentence)
    check_text(Curve((best, worse)).sentence)
    sentence = check_text(Curve((best, equivalent, worse)).sentence)
    assert sentence.startswith("200 Gaussians with spherical harmonics of degree 2: PSNR 24.93 dB and SSIM 0.8000")
    assert "800 gain 0.07 dB (-0.31 to 0.45)" in sentence


def test_a_loss_within_the_tolerance_is_accepted():
    best, worse = (Budget(count, 2, (scores,), 1.0) for count, scores in ((800, (90.0, 80.0)), (100, (88.5, 78.5))))
    (metric,) = CRITERIA["surface"]  # the loss of 1.5 is the same in both blocks
    assert select_budget([best, worse], (metric._replace(tolerance=1.4),)) == 0
    assert select_budget([best, worse], (metric._replace(tolerance=1.6),)) == 1
    curve = Curve((best, worse), CRITERIA["surface"])
    assert curve.selected is worse
    assert "correct depths 83.50 %" in check_text(curve.sentence)


@pytest.mark.parametrize("name", CRITERIA)
def test_a_curve_is_read_back_unchanged(tmp_path, name):
    metrics = len(CRITERIA[name])
    budgets = (
        Budget(800, 2, ((30.0, 20.0),) * metrics, 1.0),
        Budget(400, 1, ((29.123456789, 19.0),) * metrics, 1.0),
    )
    curve = Curve(budgets, CRITERIA[name])
    curve.write(tmp_path / "curve.csv")
    assert Curve.read(tmp_path / "curve.csv") == curve


def test_a_depth_is_correct_up_to_two_pixel_footprints():
    model, ((photograph,), (other,), *_) = truth()
    rendered = model.render_geometry(photograph.view).median_depth
    known = rendered.where(rendered > 0, 1.0)  # one pixel footprint is the depth over the focal length
    known[:, ::2] = 0  # depths that are unknown do not count
    count = (known > 0).sum()
    training, covered = SimpleNamespace(model=model), (rendered > 0) & (known > 0)
    for error_px, share in ((0.0, 1.0), (1.9, 1.0), (-1.9, 1.0), (2.1, 0.0), (-2.1, 0.0)):
        target = known / (1 + error_px / photograph.view.fx)
        score = score_surface({photograph.name: [target]})(training, [photograph])
        assert score == pytest.approx((100 * share * float(covered.sum() / count),))
    # Every known depth of a block counts the same, not every photograph.
    depths = {photograph.name: [known], other.name: [torch.zeros_like(known)]}
    assert score_surface(depths)(training, [photograph, other]) == score_surface(depths)(training, [photograph])


@pytest.mark.long
def test_the_surface_of_a_plane_needs_fewer_gaussians_than_its_views():
    scene = plane_scene(patches=30)
    held_out = (1, 4, 7, 10)

    def select(criterion, score):
        density = Parsimonious([[scene.photographs[k]] for k in held_out], 2000, 2000, CRITERIA[criterion], score)
        shown = [pyramid for k, pyramid in enumerate(scene.photographs) if k not in held_out]
        schedule = Schedule(steps=200, sh_degree=1)
        training = Training(scene.initial_model(2000), shown, schedule, density, scene.supervision)
        training.run(200)
        return training.model

    by_views = select("views", score_views)
    by_surface = select("surface", score_surface(scene.supervision.depths))
    assert len(by_surface) <= 500 < len(by_views)
    assert scene.fscore(by_surface) == pytest.approx(scene.fscore(by_views), abs=0.02)


def duplicate_gaussians(model, count):
    """Return each Gaussian `count` times with noise in the position: more than are needed."""
    parts = [part.repeat_interleave(count, dim=0) for part in vars(model).values()]
    parts[0] = parts[0] + torch.from_numpy(np.random.default_rng(1).normal(0, 0.05, parts[0].shape).astype(np.float32))
    return Gaussians(*parts)


def new_training(steps=120, start=480, most=480):
    """Return a training that starts with some of 480 Gaussians at the places of 60 true ones."""
    model, pictures = truth()
    density = Parsimonious([pictures[k : k + 1] for k in (0, 2, 4, 6)], start, most)
    training_pictures = [pictures[k] for k in (1, 3, 5, 7)]
    return Training(
        duplicate_gaussians(grey(model), 8).select(slice(None, None, 480 // start)),
        training_pictures,
        Schedule(steps=steps, sh_degree=1, downscale_shares=(0, 0)),
        density,
    )


@pytest.fixture(scope="module")
def selection():
    """A finished training, and the step, the number of Gaussians and their degree at each step of the selection."""
    training, records = new_training(), []

    def on_step(state):
        if state.density.curve is None:
            records.append((state.step, len(state.model), state.model.degree))

    training.run(120, on_step)
    return training, records


def test_the_selected_model_is_trained_on_all_photographs(selection):
    training, _ = selection
    curve = training.density.curve
    assert [b.gaussians for b in curve.budgets[:3]] == [480, 240, 120]
    assert len({b.gaussians for b in curve.budgets}) < len(curve.budgets), "colours of a lower degree were tried"
    assert (len(training.model), training.model.degree) == (curve.selected.gaussians, curve.selected.degree)
    assert training.step == 120
    assert len(training.photographs) == 8


def test_each_budget_has_the_same_number_of_steps(selection):
    training, records = selection
    curve = training.density.curve
    # After half of the steps each model has the same ten further steps; the last one is evaluated within `control`.
    for budget in curve.budgets:
        steps = [
            step for step, gaussians, degree in records if (gaussians, degree) == (budget.gaussians, budget.degree)
        ]
        assert set(range(61, 70)) <= set(steps) <= set(range(121))
        assert max(steps) < 70


def test_a_resumed_selection_equals_an_uninterrupted_one(selection, tmp_path):
    uninterrupted, _ = selection
    for steps_run in (62, 118):  # steps before the interruption; the selection goes back in steps
        first, second = new_training(), new_training()
        remaining_steps = steps_run

        def on_step(state, path=tmp_path / "checkpoint.pt"):
            nonlocal remaining_steps
            remaining_steps -= 1
            if remaining_steps == 0:
                save_checkpoint(state, path, "key")
                raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            first.run(120, on_step)
        assert numbers(run_with_checkpoints(second, tmp_path / "checkpoint.pt", "key")) == numbers(uninterrupted.model)
        budgets = [b._replace(step_ms=0) for b in second.density.curve.budgets]
        assert budgets == [b._replace(step_ms=0) for b in uninterrupted.density.curve.budgets]


def test_the_number_doubles_until_that_gains_nothing():
    """By a score that grows up to 35 Gaussians."""
    training = new_training(start=10)
    density = Parsimonious(
        training.density._held_out_blocks,
        start_gaussians=10,
        max_gaussians=160,
        score=lambda state, block: (min(len(state.model), 35) + float(block[0].name), 0.8),
    )
    training.density = density
    training.run(120)
    sizes = [(budget.gaussians, budget.degree) for budget in density.curve.budgets]
    assert sizes[:2] == [(10, 1), (20, 1)]
    (grown, more), degrees = zip(*sizes[2:4], strict=True)
    assert 35 <= grown <= 40 < more <= 80 and degrees == (1, 1)  # transparent ones are pruned
    assert sizes[4] == (grown, 0) and len(sizes) == 5
    assert density.curve.selected == density.curve.budgets[4]
    assert 35 <= len(training.model) <= 40


def test_a_run_of_one_step_ends_with_a_selection():
    training = new_training(steps=1)
    training.run(1)
    assert (training.step, len(training.model)) == (1, training.density.curve.selected.gaussians)


def test_one_held_out_block_is_refused():
    _, pictures = truth()
    with check_error(ValueError):
        Parsimonious([pictures[:2]], 100, 100)
