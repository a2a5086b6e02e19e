"""The kernels of each device against the reference rasterizer, and against themselves."""

from dataclasses import replace

import numpy as np
import pytest
from optional import import_or_skip
from splat_passes import Engine, random_image_gradients, run_pass
from splat_scenes import (
    SCENES,
    crowd,
    huge_gaussians,
    make_scene,
    needles,
    no_gaussians,
    one_pixel_image,
    opaque_gaussians,
    scattered_cloud,
    tall_image,
    whole_tile_image,
)

from reconstructors.splat.view import View

torch = import_or_skip("torch")
reference = pytest.importorskip("reconstructors.splat.reference")

REFERENCE = Engine(reference, "cpu")


def disagreeing_share(ours, theirs, rtol, relative_atol):
    """Return the share of values that differ by more than `rtol` of themselves plus `relative_atol` of the maximum."""
    allowed = rtol * np.abs(theirs) + relative_atol * np.abs(theirs).max(initial=0)
    return (np.abs(ours - theirs) > allowed).mean() if theirs.size else 0.0


@pytest.mark.parametrize("kind", SCENES)
def test_images_and_gradients_equal_those_of_the_reference(engine, kind):
    """float32 against float64: a value is a sum of up to a thousand terms that cancel, each exact to about 1e-6.

    In a crowd the depths of means are closer than the precision of float32, so the order of blending differs; this
    shows in one of a hundred gradients. Elsewhere at most one value in a thousand may differ, by a pixel on the other
    side of a threshold.
    """
    scene = make_scene(kind)
    image_gradients = random_image_gradients(scene)
    ours, theirs = run_pass(engine, scene, image_gradients), run_pass(REFERENCE, scene, image_gradients)
    relative_atol, max_disagreeing = (1e-4, 1e-2) if kind is crowd else (1e-5, 1e-3)
    shares = {
        name: disagreeing_share(array, theirs.arrays()[name], 1e-3, relative_atol)
        for name, array in ours.arrays().items()
    }
    assert max(shares.values()) <= max_disagreeing, shares
    # All visible Gaussians are drawn; of the others only those that pass the bounds of tiles, which are wider.
    assert ours.drawn[theirs.drawn].all()
    assert all(np.isfinite(array).all() for array in ours.arrays().values())
    if kind is not no_gaussians:
        assert all(array.any() for array in theirs.arrays().values())


def test_images_of_long_needles_equal_those_of_the_reference(engine):
    """A hundred times as long as their distance and a thousandth as wide: depth grows along them, not across."""
    scene = make_scene(needles)
    scene.scales[np.arange(60), scene.scales.argmax(axis=1)] = 300
    ours, theirs = run_pass(engine, scene).images, run_pass(REFERENCE, scene).images
    for name, image in theirs.items():
        assert disagreeing_share(ours[name], image, 0, 1e-5) <= 1e-3, name


@pytest.mark.parametrize("kind", [scattered_cloud, tall_image])
def test_without_geometry_colour_is_the_same(engine, kind):
    scene = make_scene(kind)
    image_gradients = random_image_gradients(scene)._replace(depth=None, normal=None)
    full, plain = run_pass(engine, scene, image_gradients), run_pass(engine, scene, image_gradients, geometry=False)
    assert plain.images.keys() == {"color", "transmittance"}
    for name, array in plain.arrays().items():
        np.testing.assert_allclose(array, full.arrays()[name], rtol=0, atol=1e-6 * np.abs(array).max(), err_msg=name)


@pytest.mark.parametrize("kind", [scattered_cloud, tall_image])
def test_without_normals_colour_and_depth_are_the_same(engine, kind):
    scene = make_scene(kind)
    image_gradients = random_image_gradients(scene)._replace(normal=None)
    full, some = run_pass(engine, scene, image_gradients), run_pass(engine, scene, image_gradients, normals=False)
    assert some.images.keys() == {"color", "transmittance", "depth"}
    for name, array in some.arrays().items():
        np.testing.assert_allclose(array, full.arrays()[name], rtol=0, atol=1e-6 * np.abs(array).max(), err_msg=name)


@pytest.mark.parametrize("kind", [scattered_cloud, opaque_gaussians])
@pytest.mark.parametrize("cutoffs", [{"min_alpha": 1 / 64}, {"min_transmittance": 0.05}])
def test_the_cutoffs_of_a_view_apply_to_images_and_gradients(engine, kind, cutoffs):
    """Up to two of 814 pixels may lie on the other side of a threshold; the cutoffs change more pixels."""
    scene = make_scene(kind)
    image_gradients, view = random_image_gradients(scene), replace(View.of(scene.camera), **cutoffs)
    ours, theirs = (run_pass(each, scene, image_gradients, view=view) for each in (engine, REFERENCE))
    for name, array in ours.arrays().items():
        assert disagreeing_share(array, theirs.arrays()[name], 1e-3, 1e-5) <= 3e-3, name
    plain = run_pass(REFERENCE, scene).images["transmittance"]
    assert disagreeing_share(theirs.images["transmittance"], plain, 1e-3, 1e-5) > 0.005


def test_a_missing_gradient_equals_zero(engine):
    scene = make_scene(scattered_cloud)
    missing = random_image_gradients(scene)._replace(transmittance=None, depth=None, normal=None)
    zeros = missing._replace(**{name: np.zeros((22, 37), np.float32) for name in ("transmittance", "depth")})
    zeros = zeros._replace(normal=np.zeros((22, 37, 3), np.float32))
    ours, theirs = run_pass(engine, scene, missing), run_pass(engine, scene, zeros)
    for name, array in ours.arrays().items():
        np.testing.assert_array_equal(array, theirs.arrays()[name], err_msg=name)
    assert ours.gradients["sh"].any()


def test_a_reused_rasterizer_keeps_nothing_of_the_previous_view(engine):
    """With other sizes and numbers of Gaussians and harmonics: the buffers keep nothing of the view before."""
    rasterizer = engine.kernels.Rasterizer()
    for kind in (huge_gaussians, one_pixel_image, crowd, no_gaussians, tall_image, whole_tile_image, scattered_cloud):
        scene = make_scene(kind)
        image_gradients = random_image_gradients(scene)
        again, fresh = run_pass(engine, scene, image_gradients, rasterizer), run_pass(engine, scene, image_gradients)
        for name, array in fresh.arrays().items():
            np.testing.assert_array_equal(again.arrays()[name], array, err_msg=f"{kind.__name__} {name}")


def test_the_gradient_can_be_computed_twice(engine):
    """Another gradient of the same image: the first one does not consume the stored data."""
    scene, rasterizer = make_scene(scattered_cloud), engine.kernels.Rasterizer()
    run_pass(engine, scene, random_image_gradients(scene, seed=8), rasterizer)
    first = run_pass(engine, scene, random_image_gradients(scene), rasterizer)
    tensors = [engine.tensor(image) for image in random_image_gradients(scene)]
    for name, rows in zip(first.gradients, rasterizer.backward(*tensors)[1:], strict=True):
        np.testing.assert_array_equal(rows.cpu().numpy(), first.gradients[name][first.drawn], err_msg=name)


def similar_images(rng, height, width):
    """Return an image and a similar target, with values beyond 0..1, too."""
    smooth = np.cumsum(np.cumsum(rng.normal(size=(height, width, 3)), axis=0), axis=1)
    target = 0.5 + 0.2 * smooth / (smooth.std() or 1)
    image = target + 0.1 * rng.normal(size=target.shape)
    return image.astype(np.float32), target.astype(np.float32)


@pytest.mark.parametrize("height, width", [(1, 1), (3, 7), (11, 5), (16, 32), (37, 50)])
@pytest.mark.parametrize("weight", [0.0, 0.2, 1.0])
def test_loss_of_an_image(engine, height, width, weight):
    """Squares of values about 1 are subtracted in float32: 1e-7 of them is 1e-4 of the constant 9e-4 that is added."""
    image, target = (engine.tensor(array) for array in similar_images(np.random.default_rng(4), height, width))
    ours, theirs = engine.kernels.image_loss(image, target, weight), reference.image_loss(image, target, weight)
    assert float(ours.l1) == pytest.approx(float(theirs.l1), rel=1e-6)
    assert float(ours.ssim) == pytest.approx(float(theirs.ssim), abs=1e-5)
    assert disagreeing_share(ours.gradient.cpu().numpy(), theirs.gradient.cpu().numpy(), 0, 1e-4) == 0


def test_the_loss_of_equal_images_is_zero(engine):
    image, _ = (engine.tensor(array) for array in similar_images(np.random.default_rng(4), 20, 30))
    loss = engine.kernels.image_loss(image, image.clone(), 0.2)
    assert float(loss.l1) == 0
    assert float(loss.ssim) == pytest.approx(1, abs=1e-5)
    # SSIM is flat at its maximum.
    assert float(loss.gradient.abs().max()) < 1e-5 / (20 * 30)


@pytest.mark.parametrize("columns", [1, 3, 4, 48])
def test_adam_steps_equal_those_of_the_reference(engine, columns):
    """On the rows with a gradient, from the first step on, whose moments are zero."""
    rng = np.random.default_rng(6)
    tensors = [engine.tensor(rng.normal(size=(40, columns)).astype(np.float32)), *[None] * 2]
    tensors[1:] = [torch.zeros_like(tensors[0]) for _ in range(2)]
    exact_tensors = [tensor.double() for tensor in tensors]
    start = tensors[0].clone()
    for step in range(1, 6):
        ids = np.flatnonzero(rng.random(30) < 0.6)  # the last ten rows never have a gradient
        gradient = (rng.normal(size=(len(ids), columns)) * 10.0 ** rng.integers(-8, 4, (len(ids), 1))).astype(
            np.float32
        )
        arguments = engine.tensor(gradient), engine.tensor(ids)
        engine.kernels.adam(*tensors, *arguments, 0.01, step)
        reference.adam(*exact_tensors, arguments[0].double(), arguments[1], 0.01, step)
    for ours, theirs in zip(tensors, exact_tensors, strict=True):
        np.testing.assert_allclose(ours.cpu().numpy(), theirs.cpu().numpy(), rtol=2e-5, atol=1e-7)
    assert torch.equal(tensors[0][30:], start[30:]) and not torch.equal(tensors[0][:30], start[:30])


def test_a_step_of_adam_on_no_rows(engine):
    tensors = [engine.tensor(np.ones((5, 3), np.float32)) for _ in range(3)]
    engine.kernels.adam(*tensors, engine.tensor(np.zeros((0, 3), np.float32)), engine.tensor(np.zeros(0, int)), 0.1, 1)
    assert all(bool((tensor == 1).all()) for tensor in tensors)
