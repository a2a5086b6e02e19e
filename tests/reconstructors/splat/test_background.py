"""Backgrounds: learned colors, and photographs with transparent pixels."""

import numpy as np
from optional import import_or_skip

torch = import_or_skip("torch")

from splat_training import grey, mean_psnr, numbers, truth  # noqa: E402

from reconstructors.splat.background import Background  # noqa: E402
from reconstructors.splat.density import Density  # noqa: E402
from reconstructors.splat.photographs import Photograph  # noqa: E402
from reconstructors.splat.train import Schedule, Training, evaluate, render  # noqa: E402

SKY = (0.9, 0.95, 0.6)


def photographs_over(color, *, alpha=False):
    """Return the true model and its photographs over a color, opaque or with an alpha channel."""
    model, pyramids = truth()
    background, pictures = torch.tensor(color), []
    for (photograph,) in pyramids:
        opaque = photograph._replace(color=(255 * render(model, photograph.view, background)).round().byte())
        if alpha:  # the same over white minus that over black is the transmittance
            black, white = (render(model, photograph.view, torch.full((3,), value)) for value in (0.0, 1.0))
            opaque = photograph._replace(alpha=(255 * (1 - (white - black)[..., 0])).round().byte())
        pictures.append([opaque])
    return model, pictures


def new_training(pictures, model, choice, steps=240):
    return Training(
        grey(model),
        pictures,
        Schedule(steps=steps, sh_degree=0, downscale_shares=(0, 0)),
        Density(),
        background=Background.choose(choice, [pyramid[0] for pyramid in pictures]),
    )


def train(pictures, model, choice):
    training = new_training(pictures, model, choice)
    training.run(240)
    return training


def test_the_color_behind_opaque_photographs_is_learned():
    model, pictures = photographs_over(SKY)
    new, known = [pictures[3][0]], pictures[:3] + pictures[4:]
    learned, black = (train(known, model, choice) for choice in ("learned", "black"))
    np.testing.assert_allclose(learned.background.color[0], SKY, atol=0.02)
    assert not black.background.color.any()
    scores = [evaluate(run.model, new, run.background.color[0])[0].psnr for run in (learned, black)]
    assert scores[0] > scores[1] + 3


def test_the_color_is_learned_if_one_dominates_the_borders():
    """A quarter of the border has the color of the sky, up to noise; masked pixels do not count."""
    rng = np.random.default_rng(0)
    view = truth()[1][0][0].view

    def photograph(sky_rows, valid=None):
        color = rng.integers(0, 256, (32, 48, 3), dtype=np.uint8)
        color[:sky_rows] = 200 + rng.integers(-4, 5, (sky_rows, 48, 3))
        return Photograph("", view, torch.from_numpy(color), valid)

    below = torch.ones(32, 48, dtype=torch.bool)
    below[:10] = False
    shown, hidden = [photograph(10), photograph(10), photograph(0)], [photograph(10, below), photograph(0)]
    assert Background.choose("auto", shown).is_learned
    np.testing.assert_allclose(Background.choose("auto", shown).color[0], 200 / 255, atol=0.01)
    for photographs in (hidden, [photograph(0)], [photograph(10, torch.zeros(32, 48, dtype=torch.bool))]):
        background = Background.choose("auto", photographs)
        assert not background.is_learned and not background.color.any()
    assert Background.choose("learned", hidden).is_learned


def test_the_model_is_transparent_where_the_photographs_are():
    """The renderings are right over any color, not only over the one of the training."""
    model, pictures = photographs_over((0.0, 0.0, 0.0), alpha=True)
    views = [pyramid[0] for pyramid in pictures]
    random, white = (train(pictures, model, choice) for choice in ("auto", "white"))
    assert random.background.color.tolist() == white.background.color.tolist() == [[1, 1, 1]]

    def score(run, color):
        return mean_psnr(run.model, views, torch.tensor(color))

    assert score(random, (0.0, 0.0, 0.0)) > score(white, (0.0, 0.0, 0.0)) + 1


def test_a_resumed_run_has_the_same_background(tmp_path):
    """Half of the photographs are opaque, over a color that is learned; behind the others, colors are random."""
    model, opaque = photographs_over(SKY)
    _, transparent = photographs_over((0.0, 0.0, 0.0), alpha=True)
    uninterrupted, first, second = (new_training(opaque[:4] + transparent[4:], model, "learned", 60) for _ in range(3))
    uninterrupted.run(60)
    first.run(31)
    first.save(tmp_path / "checkpoint.pt", "key")
    assert second.load(tmp_path / "checkpoint.pt", "key")
    second.run(60)
    assert numbers(second.model) == numbers(uninterrupted.model)
    assert torch.equal(second.background.color, uninterrupted.background.color)
    assert 0.5 < float(second.background.color[0, 0]) < 1
