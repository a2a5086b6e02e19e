"""PSNR and SSIM equal scikit-image's over the valid pixels; LPIPS and FLIP equal those of their packages."""

import importlib.util

import numpy as np
import pytest
from optional import break_library, import_or_skip
from wording import check_error, check_text

from pcbench.measure import perceptual
from pcbench.measure.images import absolute_error, psnr, ssim
from pcbench.measure.perceptual import Perceptual


def make_photograph(seed, height=48, width=67):
    """Return an image with blobs, an edge and grain, uint8."""
    rng = np.random.default_rng(seed)
    v, u = np.mgrid[:height, :width] / 10
    waves = [np.sin(rng.uniform(0.2, 2) * u + rng.uniform(0.2, 2) * v + rng.uniform(0, 6)) for _ in range(3)]
    image = 120 + 60 * np.stack(waves, axis=2) + 5 * rng.standard_normal((height, width, 3))
    image[:, width // 2 :] += 40 * rng.uniform(-1, 1, 3)
    return np.clip(image, 0, 255).astype(np.uint8)


def degrade(image, seed, noise=12.0):
    rng = np.random.default_rng(seed + 1000)
    blurred = (image.astype(float) + np.roll(image, 1, axis=1) + np.roll(image, 1, axis=0)) / 3
    return np.clip(blurred + noise * rng.standard_normal(image.shape), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("seed", range(6))
def test_psnr_and_ssim_equal_scikit_image(seed):
    skimage = import_or_skip("skimage.metrics")
    truth = make_photograph(seed, 30 + 9 * seed, 83 - 7 * seed)
    for image, noise in ((degrade(truth, seed, noise), noise) for noise in (0, 3, 40)):
        for a, b, largest in ((image, truth, 255), (image / 255, truth / 255, 1.0)):
            expected = skimage.structural_similarity(
                a, b, data_range=largest, channel_axis=2, gaussian_weights=True, sigma=1.5, use_sample_covariance=False
            )
            assert ssim(a, b) == pytest.approx(expected, abs=1e-12), noise
            assert psnr(a, b) == pytest.approx(skimage.peak_signal_noise_ratio(b, a, data_range=largest), abs=1e-10)


def test_psnr_of_known_differences():
    black = np.zeros((4, 5, 3), dtype=np.uint8)
    assert psnr(black, black) == np.inf
    assert psnr(black, black + np.uint8(255)) == 0
    assert psnr(np.full((4, 5, 3), 0.25), np.full((4, 5, 3), 0.35)) == pytest.approx(20)
    image = black.copy()
    image[0, 0, 0] = 255
    assert psnr(image, black) == pytest.approx(10 * np.log10(60))


def test_ssim_of_known_images():
    truth = make_photograph(3)
    assert ssim(truth, truth) == 1
    dark, light = np.full((20, 20, 3), 0.25), np.full((20, 20, 3), 0.5)  # no structure: brightness alone is compared
    assert ssim(dark, light) == pytest.approx((2 * 0.25 * 0.5 + 1e-4) / (0.25**2 + 0.5**2 + 1e-4))
    assert ssim(truth, 255 - truth) < 0


def test_only_valid_pixels_are_measured():
    truth = make_photograph(5)
    mask = np.ones(truth.shape[:2], dtype=bool)
    mask[10:20, 20:30] = False
    image = degrade(truth, 5)
    randomized = image.copy()
    randomized[~mask] = np.random.default_rng(0).integers(0, 256, randomized[~mask].shape)
    assert psnr(randomized, truth, mask) == psnr(image, truth, mask) != psnr(image, truth)
    assert ssim(randomized, truth, mask) == ssim(image, truth, mask) != ssim(image, truth)
    # A mask of a rectangle gives the scores of that part of the image.
    border = np.zeros_like(mask)
    border[3:-4, 6:-2] = True
    window = np.s_[3:-4, 6:-2]
    assert ssim(image, truth, border) == pytest.approx(ssim(image[window], truth[window]), abs=1e-12)
    assert psnr(image, truth, border) == pytest.approx(psnr(image[window], truth[window]), abs=1e-12)
    assert ssim(image, truth, np.ones_like(mask)) == ssim(image, truth)


def test_no_valid_pixels_give_no_score():
    truth = make_photograph(1)
    no_pixels = np.zeros(truth.shape[:2], dtype=bool)
    assert np.isnan(psnr(truth, truth, no_pixels))
    assert np.isnan(ssim(truth, truth, no_pixels))
    assert np.isnan(ssim(truth[:10], truth[:10]))  # no window fits
    assert ssim(truth[:11], truth[:11]) == 1


def test_error_maps_are_in_grey_levels():
    truth = np.full((2, 3, 3), 100, dtype=np.uint8)
    image = truth.copy()
    image[1, 2] = 103, 88, 100
    np.testing.assert_allclose(absolute_error(image, truth), [[0, 0, 0], [0, 0, 5]], atol=1e-12)


@pytest.mark.parametrize("metric", [psnr, ssim])
def test_invalid_inputs_are_refused(metric):
    image = make_photograph(0)
    with check_error():
        metric(image, image[:-1])
    with check_error():
        metric(image[..., 0], image[..., 0])
    with check_error():
        metric(image.astype(int), image.astype(int))
    with check_error():
        metric(image, image, np.ones((48, 67), dtype=np.uint8))


def test_flip_equals_flip_evaluator():
    flip = import_or_skip("flip_evaluator")
    truth = make_photograph(2)
    image = degrade(truth, 2)
    metrics = Perceptual.find_available()
    a, b = (pixels.astype(np.float32) / 255 for pixels in (image, truth))
    assert metrics.scores(image, truth).flip == pytest.approx(flip.evaluate(b, a, "LDR")[1], abs=1e-6)
    assert metrics.scores(truth, truth).flip == 0
    mask = np.zeros(truth.shape[:2], dtype=bool)
    mask[:, :30] = True
    half_black = image.copy()
    half_black[:, 30:] = 0
    assert metrics.scores(half_black, truth, mask).flip == metrics.scores(image, truth, mask).flip > 0


def test_missing_packages_are_reported(monkeypatch, tmp_path):
    monkeypatch.setattr(perceptual, "find_spec", lambda name: None)
    break_library(monkeypatch, tmp_path, "flip_evaluator", None)
    metrics = Perceptual.find_available()
    assert [notice.code for notice in metrics.missing] == ["no-lpips", "no-flip"]
    check_text("\n".join(notice.text for notice in metrics.missing))
    scores = metrics.scores(make_photograph(0), make_photograph(1))
    assert scores.lpips is None
    assert scores.flip is None
    assert np.isfinite(scores.psnr)


def test_lpips_without_its_weights_downloads_nothing(monkeypatch, tmp_path):
    torch = import_or_skip("torch")
    find_spec = importlib.util.find_spec
    monkeypatch.setattr(perceptual, "find_spec", lambda name: find_spec("json" if name == "lpips" else name))
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))
    monkeypatch.setattr(perceptual, "require", pytest.fail)
    metrics = Perceptual.find_available()
    assert metrics.lpips is None
    assert metrics.missing[0].code == "no-lpips"
    check_text(metrics.missing[0].text)


@pytest.mark.slow
def test_lpips_equals_the_lpips_package(monkeypatch, tmp_path):
    """The weights are random: the test checks the inputs of the network, not what it has learned."""
    try:
        import lpips
        import torch
        import torchvision
    except (ImportError, RuntimeError) as error:  # a torchvision of another torch raises the latter
        pytest.skip(str(error))
    torch.manual_seed(0)
    (tmp_path / "checkpoints").mkdir()
    torch.save(torchvision.models.vgg16().state_dict(), tmp_path / "checkpoints" / "vgg16-397923af.pth")
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))
    truth = make_photograph(2, 64, 80)
    image = degrade(truth, 2)
    network = lpips.LPIPS(net="vgg", verbose=False)
    tensors = (lpips.im2tensor(pixels) for pixels in (image, truth))
    metrics = Perceptual.find_available()
    scores = metrics.scores(image, truth)
    assert scores.lpips == pytest.approx(float(network(*tensors)), rel=1e-5)
    assert scores.lpips > 0
    mask = np.zeros(truth.shape[:2], dtype=bool)
    mask[:, :40] = True
    half_black = image.copy()
    half_black[:, 40:] = 0
    assert metrics.scores(half_black, truth, mask).lpips == metrics.scores(image, truth, mask).lpips > 0
