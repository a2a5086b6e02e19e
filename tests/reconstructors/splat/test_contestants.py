"""The contestants of benchmarks/splat_raster.py compute equivalent training steps."""

import re
import subprocess
import sys

import numpy as np
import pytest
from optional import import_or_skip
from repository import ROOT

torch = import_or_skip("torch")

from splat_contestants import (  # noqa: E402
    Ours,
    PlainTorch,
    RasterizerByAutograd,
    contributors,
    make_picture,
    render_plainly,
)

from reconstructors.splat.density import Density  # noqa: E402
from reconstructors.splat.model import Gaussians  # noqa: E402
from reconstructors.splat.photographs import Photograph  # noqa: E402
from reconstructors.splat.train import Schedule, Training, evaluate  # noqa: E402


@pytest.mark.parametrize(
    ("count", "width", "height"), [pytest.param(600, 70, 43, marks=pytest.mark.long), (40, 16, 16)]
)
def test_a_step_in_plain_torch_has_the_same_image_and_gradients(count, width, height):
    picture = make_picture(count, width, height)
    ours, plain = Ours(picture), PlainTorch(picture)
    for contestant in (ours, plain):
        for part in ("forward", "loss", "backward", "adam"):
            getattr(contestant, part)()
    # Both are float32; a pixel may lie on the other side of the threshold 1/255, which changes it by that much.
    difference = (ours.image - plain.image).abs()
    assert difference.mean() < 1e-6 and difference.max() < 2 / 255
    for name, a, b in zip(ours.gradients()._fields, ours.gradients(), plain.gradients(), strict=True):
        assert (a - b).norm() < 2e-3 * b.norm(), name
        assert b.any(), name


def test_training_runs_with_another_rasterizer():
    """With plain torch, as with gsplat on a GPU: both models are equally good after the same steps."""
    picture = make_picture(150, 40, 30)
    photograph = Photograph("view", picture.view, (picture.target * 255).to(torch.uint8), None)
    scores = []
    for render in (None, render_plainly):
        model = Gaussians(*(part.clone() for part in picture.parameters._replace(sh=picture.parameters.sh[:, :1])))
        training = Training(model, [[photograph]], Schedule(steps=25, sh_degree=1, downscale_shares=(0, 0)), Density())
        before = evaluate(training.model, [photograph])[0].psnr
        if render is not None:
            training._rasterizer = RasterizerByAutograd(render)
        training.run(25)
        scores.append(evaluate(training.model, [photograph])[0].psnr)
    assert scores[0] > before + 0.2
    assert scores[1] == pytest.approx(scores[0], abs=0.02)


def test_repeated_steps_render_the_same_image():
    """All runs have to render the same image."""
    picture = make_picture(200, 40, 30)
    for contestant in (Ours(picture), PlainTorch(picture)):
        images = []
        for _ in range(2):
            for part in ("forward", "loss", "backward", "adam"):
                getattr(contestant, part)()
            images.append(contestant.image.clone())
        assert torch.equal(*images)


def test_contributors_are_counted_at_each_pixel():
    """Against each pixel by itself, in numpy, from the projection alone."""
    from reconstructors.splat.reference import project

    picture = make_picture(300, 48, 32, seed=4)
    splats = project(picture.parameters.gaussians(), picture.view)
    xy, inverse, opacities = (array.numpy().astype(float) for array in (splats.xy, splats.inverse, splats.opacities))
    counts = []
    for v in range(32):
        for u in range(48):
            offset = [u + 0.5, v + 0.5] - xy
            alpha = np.minimum(opacities * np.exp(-np.einsum("ni,nij,nj->n", offset, inverse, offset) / 2), 0.99)
            transmittance = np.cumprod(1 - alpha[alpha >= 1 / 255])
            counts.append((transmittance >= 1e-4).sum())
    assert contributors(picture) == pytest.approx(np.mean(counts), rel=1e-3)


@pytest.mark.long
def test_the_bench_prints_a_row_for_each_contestant():
    command = [sys.executable, ROOT / "benchmarks/splat_raster.py"]
    options = ["--sizes", "48x32", "--counts", "300", "--threads", "1", "--runs", "1"]
    output = subprocess.run([*command, *options], check=True, capture_output=True, text=True).stdout
    assert re.search(
        r"^48x32, 300 Gaussians: \d+ rendered, [\d,]+ tile instances, \d+ per pixel, alpha 0\.\d\d; ", output, re.M
    )
    rows = re.findall(r"^ +1 widest +(pcbench|pcbench, geometry|plain torch) +((?: +\d+\.\d){9}) +(\S+)$", output, re.M)
    assert [name for name, *_ in rows] == ["pcbench", "pcbench, geometry", "plain torch"]
    assert all(float(difference) < 1e-6 for *_, difference in rows)


BENCHES = {  # options for a short run, pattern of a row, and number of rows
    "splat_train": (["--counts=300,600", "--steps=30,60", "--seeds=2"], r"pcbench +\d+ +\d+(?: +\S+ ± \S+){6} *", 3),
    "splat_clouds": (["--steps=40", "--gaussians=800", "--cases=circles, seed 11"], r".* +\d+ +\S+(?: +\S+){7}", 11),
    "splat_variants": (
        ["--steps=40", "--gaussians=800", "--scenes=circles, seed 11"],
        r"(?:classic|growing|parsimonious|fixed) from (?:sfm|mvs)(?: +[\d,.]+){7}",
        4,
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("bench", BENCHES)
def test_the_benches_of_training_print_their_rows(renderer, tmp_path, bench):
    options, row, count = BENCHES[bench]
    command = [sys.executable, ROOT / "benchmarks" / f"{bench}.py", "--images=32", "--size=160x96"]
    process = subprocess.run([*command, "--folder", tmp_path, *options], check=True, capture_output=True, text=True)
    assert len(re.findall(f"^{row}$", process.stdout, re.M)) == count, process.stdout
