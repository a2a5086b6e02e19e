"""Exposures: photographs of different brightness give the same model as evenly exposed ones."""

import numpy as np
import pytest
from optional import import_or_skip

torch = import_or_skip("torch")

from splat_training import grey, mean_psnr, numbers, truth  # noqa: E402

from reconstructors.splat.background import Background  # noqa: E402
from reconstructors.splat.density import Density  # noqa: E402
from reconstructors.splat.exposure import Exposure, least_squares_gain, median_gain, read_gains, write_gains  # noqa: E402
from reconstructors.splat.train import Schedule, Training, render  # noqa: E402

GAINS = [1.0, 0.7, 0.9, 0.6, 0.95, 0.8, 1.0, 0.75]


def exposed_photographs():
    """Return the true model and its photographs, darkened by `GAINS`; every second one has an alpha channel."""
    model, pictures = truth()
    for k, (gain, (photograph,)) in enumerate(zip(GAINS, pictures, strict=True)):
        white, black = (render(model, photograph.view, torch.full((3,), value)) for value in (1.0, 0.0))
        alpha = (255 * (1 - (white - black)[..., 0])).round().byte() if k % 2 else None
        color = (255 * gain * (white if alpha is None else black)).round().byte()
        pictures[k] = [photograph._replace(color=color, alpha=alpha)]
    return model, pictures


def new_training(pictures, model, steps, *, compensate=True):
    return Training(
        grey(model),
        pictures,
        Schedule(steps=steps, sh_degree=0, downscale_shares=(0, 0)),
        Density(),
        background=Background((0.9, 0.9, 0.9), is_learned=True, is_random=True),
        exposure=Exposure([pyramid[0].name for pyramid in pictures]) if compensate else None,
    )


@pytest.mark.long
def test_gains_are_found_and_colors_are_right():
    """Gains are relative to each other: their geometric mean is 1."""
    model, pictures = exposed_photographs()
    runs = [new_training(pictures, model, 400, compensate=compensate) for compensate in (True, False)]
    for run in runs:
        run.run(400)
    expected = np.array(GAINS) / np.exp(np.mean(np.log(GAINS)))
    np.testing.assert_allclose(list(runs[0].exposure.gains.values()), expected, rtol=0.03)
    views = [pyramid[0] for pyramid in pictures]
    scores = [
        mean_psnr(run.model, views[::2], run.background.color[0], fit_exposure=fit)
        for run, fit in ((runs[0], True), (runs[1], True), (runs[0], False))
    ]
    assert scores[0] > scores[1] + 3
    assert scores[0] > scores[2] + 3  # without a gain, the brightness does not fit


def test_a_resumed_run_has_the_same_gains(tmp_path):
    model, pictures = exposed_photographs()
    uninterrupted, first, second = (new_training(pictures, model, 40) for _ in range(3))
    uninterrupted.run(40)
    first.run(19)
    first.save(tmp_path / "checkpoint.pt", "key")
    assert second.load(tmp_path / "checkpoint.pt", "key")
    second.run(40)
    assert numbers(second.model) == numbers(uninterrupted.model)
    assert second.exposure.gains == uninterrupted.exposure.gains


def test_masked_and_dark_pixels_do_not_change_the_gain():
    rng = np.random.default_rng(0)
    rendered = torch.from_numpy(rng.uniform(0.2, 0.8, (20, 30, 3)))
    valid = torch.ones(20, 30, dtype=torch.bool)
    valid[:, 12:] = False
    rendered[:8] = 0.01  # a surface that the model lacks
    target = torch.where(valid[..., None] & (rendered > 0.01), 0.8 * rendered, 1.0)
    assert float(median_gain(target, rendered, valid)) == pytest.approx(0.8)
    assert float(median_gain(target, rendered, ~valid)) > 1.2
    assert float(median_gain(target, rendered, valid & False)) == 1
    assert float(median_gain(target, rendered / 3, valid)) == pytest.approx(2.4)
    assert float(median_gain(target, rendered / 6, valid)) == 4  # the largest
    lower = valid.clone()
    lower[:8] = False
    assert float(least_squares_gain(target, rendered, lower)) == pytest.approx(0.8)


def test_gains_are_written_and_read(tmp_path):
    write_gains(tmp_path / "gains.csv", {"a,b.jpg": 0.75, "c.jpg": 4 / 3})
    assert read_gains(tmp_path / "gains.csv") == {"a,b.jpg": 0.75, "c.jpg": 1.333333}
