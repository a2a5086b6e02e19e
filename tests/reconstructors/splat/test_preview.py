"""Previews of a training: they show it and do not change it."""

import numpy as np
import pytest
from optional import import_or_skip

torch = import_or_skip("torch")

from splat_training import grey, numbers, truth  # noqa: E402

from pcbench import read_cloud  # noqa: E402
from pcbench.measure.images import psnr  # noqa: E402
from pcbench.scenes.decode import decode_image  # noqa: E402
from pcbench.scenes.previews import PHOTOGRAPH, POINTS, RENDERING, read_preview  # noqa: E402
from reconstructors.splat import resume  # noqa: E402
from reconstructors.splat.density import Density  # noqa: E402
from reconstructors.splat.model import LocalFrame  # noqa: E402
from reconstructors.splat.preview import PreviewWriter  # noqa: E402
from reconstructors.splat.resume import run_with_checkpoints  # noqa: E402
from reconstructors.splat.train import Schedule, Training, evaluate  # noqa: E402

FRAME = LocalFrame(np.array([100.0, 200.0, 0.0]), 2.0)


def new_training(steps=20):
    model, pictures = truth()
    return Training(grey(model), pictures[1:], Schedule(steps=steps, downscale_shares=(0, 0)), Density()), pictures


def writer_of(folder, pictures, key="key", held_out=True):
    shown = [pyramid[0] for pyramid in pictures]
    return PreviewWriter(folder, key, FRAME, shown[1:], shown[:1] if held_out else [])


def test_previews_do_not_change_the_training(tmp_path, monkeypatch):
    monkeypatch.setattr(resume, "_FIRST_PREVIEW_S", -1.0)
    monkeypatch.setattr(resume, "_PREVIEW_INTERVAL_S", -1.0)
    monkeypatch.setattr(resume, "_MAX_PREVIEW_SHARE", 1e9)
    training, pictures = new_training()
    model = run_with_checkpoints(training, tmp_path / "a.pt", "key", writer_of(tmp_path / "preview", pictures))
    assert numbers(model) == numbers(run_with_checkpoints(new_training()[0], tmp_path / "b.pt", "key"))
    preview = read_preview(tmp_path / "preview")
    assert [row.done for row in preview.history] == [*range(1, 21), 20]  # after each step, and at the end
    assert (preview.steps, preview.view, preview.is_held_out) == (20, "0", True)
    last = preview.history[-1]
    assert last.held_out_psnr == pytest.approx(evaluate(model, [pictures[0][0]])[0].psnr)
    assert (last.psnr, last.gaussians) == (training.mean_psnr, 60)
    assert 0 < last.loss < preview.history[6].loss  # each of seven photographs was used
    rendering, photograph = (decode_image(tmp_path / "preview" / name, (48, 32)) for name in (RENDERING, PHOTOGRAPH))
    np.testing.assert_array_equal(photograph, pictures[0][0].color.numpy())
    assert psnr(rendering, photograph) == pytest.approx(last.held_out_psnr, abs=0.05)  # rounded to 8 bits
    world = FRAME.to_world(model.means.numpy()[model.opacities.numpy() >= 0.1])
    np.testing.assert_allclose(read_cloud(tmp_path / "preview" / POINTS).points, world, rtol=1e-6)


def test_a_resumed_training_continues_its_history(tmp_path):
    training, pictures = new_training()
    training.run(10)
    writer_of(tmp_path, pictures)(training, 10)
    training.run(15)
    writer_of(tmp_path, pictures)(training, 5)
    assert [row.done for row in read_preview(tmp_path).history] == [10, 15]
    writer_of(tmp_path, pictures, key="other", held_out=False)(training, 3)
    preview = read_preview(tmp_path)
    assert [(row.done, row.held_out_psnr) for row in preview.history] == [(15, None)]
    assert (preview.view, preview.is_held_out) == ("1", False)
