"""`rasterize` with torch: gradients, types, distant coordinates, and refusal of wrong input."""

import subprocess
import sys
import weakref
from dataclasses import replace
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
from optional import import_or_skip
from repository import TESTS
from splat_scenes import make_scene, no_gaussians, scattered_cloud
from wording import check_error

from pcbench.errors import MissingExtra
from pcbench.geometry.transform import Similarity
from reconstructors.splat import rasterize
from reconstructors.splat.interface import GaussianTensors
from reconstructors.splat.view import View

torch = import_or_skip("torch")
reference = pytest.importorskip("reconstructors.splat.reference")


@pytest.fixture
def device(engine, monkeypatch):
    """Make `rasterize` use the engine's kernels if they are emulated; it selects the others itself."""
    if not isinstance(engine.kernels, ModuleType):
        monkeypatch.setattr(sys.modules[rasterize.__module__], "kernels_of", lambda _: engine.kernels)
    return engine


def given(device, scene, dtype=torch.float32):
    return [device.tensor(array).to(dtype).requires_grad_() for array in scene.arrays]


def random_loss(rendering, seed=5):
    """Return a random linear combination of all images with a gradient."""
    rng = np.random.default_rng(seed)
    images = (rendering.color, rendering.alpha, rendering.depth, rendering.normal)
    return sum((image * torch.from_numpy(rng.normal(size=image.shape)).to(image)).sum() for image in images)


def test_images_and_gradients_equal_those_of_the_reference(device):
    """Depth is the mean, whose gradient also passes through alpha; the background has a gradient, too."""
    scene = make_scene(scattered_cloud)
    background = device.tensor(scene.background).requires_grad_()
    tensors = given(device, scene)
    ours = rasterize(*tensors, scene.camera, background=background)
    random_loss(ours).backward()

    exact = [torch.from_numpy(array).double().requires_grad_() for array in (*scene.arrays, scene.background)]
    drawn = reference.render(GaussianTensors(*exact[:5]), View.of(scene.camera), exact[5])
    alpha = 1 - drawn.transmittance
    theirs = ours._replace(
        color=drawn.color,
        alpha=alpha,
        depth=drawn.depth / torch.where(alpha > 0, alpha, 1),
        normal=drawn.normal,
        median_depth=drawn.median_depth,
    )
    random_loss(theirs).backward()
    assert (theirs.alpha == 0).any() and (ours.depth[ours.alpha == 0] == 0).all()
    for name, image in ours._asdict().items():
        assert image.dtype == torch.float32 and image.requires_grad == (name != "median_depth")
        wanted = getattr(theirs, name).detach().numpy()
        # Where alpha is a few thousandths its rounding error is 1e-5 of it, and of the depth.
        np.testing.assert_allclose(image.detach().cpu().numpy(), wanted, rtol=0, atol=1e-4, err_msg=name)
    for ours_by, theirs_by in zip([*tensors, background], exact, strict=True):
        scale = theirs_by.grad.abs().max().item()
        # Likewise the gradient of a depth divided by such an alpha.
        np.testing.assert_allclose(ours_by.grad.cpu().numpy(), theirs_by.grad.numpy(), rtol=1e-3, atol=3e-5 * scale)


def test_a_scene_far_from_the_origin_has_the_same_images(device):
    """In float64 UTM coordinates; float32 would be wrong by half a metre."""
    scene = make_scene(scattered_cloud)
    far = np.array([654_321.0, 5_432_109.0, 512.0])
    motion = scene.camera.cam_from_world
    moved = replace(
        scene.camera, cam_from_world=Similarity(motion.rotation, motion.translation - motion.rotation @ far)
    )
    means, *others = given(device, scene, torch.float64)
    near, there = rasterize(means, *others, scene.camera), None
    far_means = (means.detach() + device.tensor(far)).requires_grad_()
    there = rasterize(far_means, *others, moved)
    for ours, theirs in zip(there, near, strict=True):
        # The coordinates are exact to 1e-9; a pixel may change sides at the threshold of 1/255.
        assert (ours - theirs).abs().max() < 5e-3 and ((ours - theirs).abs() > 1e-5).float().mean() < 1e-3
    random_loss(near).backward()
    random_loss(there).backward()
    assert means.grad.dtype == torch.float64
    assert torch.allclose(far_means.grad, means.grad, rtol=1e-3, atol=1e-4 * means.grad.abs().max().item())


@pytest.mark.parametrize("dtype", [torch.float64, torch.float16, torch.bfloat16])
def test_other_types_are_drawn_in_float32(device, dtype):
    scene = make_scene(scattered_cloud)
    tensors = given(device, scene, dtype)
    rendering = rasterize(*tensors, scene.camera)
    random_loss(rendering).backward()
    again = [tensor.detach().float().requires_grad_() for tensor in tensors]
    wanted = rasterize(*again, scene.camera)
    random_loss(wanted).backward()
    assert rendering.color.dtype == torch.float32 and torch.equal(rendering.color, wanted.color)
    for ours, theirs in zip(tensors, again, strict=True):
        assert ours.grad.dtype == dtype
        assert torch.equal(ours.grad, theirs.grad.to(dtype))


def test_rows_that_are_not_contiguous(device):
    scene = make_scene(scattered_cloud)
    tensors = given(device, scene)
    spread = [torch.stack([tensor.detach()] * 2, dim=-1)[..., 0].requires_grad_() for tensor in tensors]
    assert not any(tensor.is_contiguous() for tensor in spread)
    for each in (tensors, spread):
        random_loss(rasterize(*each, scene.camera)).backward()
    for ours, theirs in zip(spread, tensors, strict=True):
        assert torch.equal(ours.grad, theirs.grad)


def test_two_renderings_at_once(device):
    """Each keeps the data for its own gradient, which can be computed in any order and twice."""
    scenes = make_scene(scattered_cloud), make_scene(scattered_cloud, seed=1)
    apart = []
    for scene in scenes:
        tensors = given(device, scene)
        random_loss(rasterize(*tensors, scene.camera)).backward()
        apart.append([tensor.grad for tensor in tensors])
    tensors = [given(device, scene) for scene in scenes]
    losses = [random_loss(rasterize(*each, scene.camera)) for each, scene in zip(tensors, scenes, strict=True)]
    (losses[0] + losses[1]).backward(retain_graph=True)
    losses[0].backward()
    for tensor, grad in zip(tensors[0], apart[0], strict=True):
        assert torch.equal(tensor.grad, grad + grad)
    for tensor, grad in zip(tensors[1], apart[1], strict=True):
        assert torch.equal(tensor.grad, grad)


def test_overwritten_tensors_have_no_gradient(device):
    """Torch raises an error if a parameter or an image was changed in place."""
    scene = make_scene(scattered_cloud)
    tensors = given(device, scene)
    loss = random_loss(rasterize(*tensors, scene.camera))
    with torch.no_grad():
        tensors[2] *= 0.5
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        loss.backward()
    rendering = rasterize(*given(device, scene), scene.camera)
    loss = random_loss(rendering._replace(color=rendering.color.clamp_(0, 1)))
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        loss.backward()
    background = device.tensor(scene.background)
    loss = random_loss(rasterize(*given(device, scene), scene.camera, background=background))
    background += 1
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        loss.backward()


def test_gradients_with_respect_to_one_tensor_only(device):
    scene = make_scene(scattered_cloud)
    everything = given(device, scene)
    random_loss(rasterize(*everything, scene.camera)).backward()
    for only in range(5):
        tensors = [tensor.requires_grad_(n == only) for n, tensor in enumerate(given(device, scene))]
        random_loss(rasterize(*tensors, scene.camera)).backward()
        assert [tensor.grad is not None for tensor in tensors] == [n == only for n in range(5)]
        assert torch.equal(tensors[only].grad, everything[only].grad)


def test_a_gradient_is_prepared_only_if_one_may_follow(device, monkeypatch):
    """On CUDA it needs memory."""
    prepared = []

    class Spy:
        def __init__(self):
            self.own = device.kernels.Rasterizer()

        def forward(self, *given, gradient, **options):
            prepared.append(gradient)
            return self.own.forward(*given, gradient=gradient, **options)

    monkeypatch.setattr(sys.modules[rasterize.__module__], "kernels_of", lambda _: SimpleNamespace(Rasterizer=Spy))
    scene = make_scene(scattered_cloud)
    tensors = [tensor.requires_grad_(False) for tensor in given(device, scene)]
    rasterize(*tensors, scene.camera)
    rasterize(*tensors[:4], tensors[4].requires_grad_(), scene.camera)
    assert prepared == [False, True]


def test_a_deleted_rendering_is_freed(device):
    """With all its memory, immediately: there is no reference cycle."""
    scene = make_scene(scattered_cloud)
    rendering = rasterize(*given(device, scene), scene.camera)
    node = rendering.color.grad_fn
    held = weakref.ref(node.rasterizer)
    assert held() is not None
    del rendering, node
    assert held() is None


def test_without_gradients_and_without_gaussians(device):
    scene = make_scene(scattered_cloud)
    with torch.no_grad():
        rendering = rasterize(*given(device, scene), scene.camera)
    assert not rendering.color.requires_grad
    empty, background = make_scene(no_gaussians), [0.1, 0.2, 0.3]
    tensors = given(device, empty)
    rendering = rasterize(*tensors, empty.camera, background=background)
    assert torch.equal(rendering.color.cpu(), torch.tensor(background).expand(22, 37, 3))
    assert not any(image.any() for image in rendering[1:])
    random_loss(rendering).backward()
    assert [tensor.grad.shape for tensor in tensors] == [tensor.shape for tensor in tensors]


def check_refusal(change, **options):
    """Expect a refusal of a scene of five Gaussians after `change` of its tensors by name."""
    scene = scattered_cloud(np.random.default_rng(0), 5)
    names = ("means", "quats", "scales", "opacities", "sh")
    tensors = {name: torch.from_numpy(array) for name, array in zip(names, scene.arrays, strict=True)}
    changed = tensors | {name: tensor(tensors[name]) for name, tensor in change.items()}
    with check_error():
        rasterize(*changed.values(), **{"camera": scene.camera, **options})


def with_one(value):
    def change(tensor):
        tensor = tensor.clone()
        tensor.view(len(tensor), -1)[3, 0] = value
        return tensor

    return change


@pytest.mark.parametrize(
    "change",
    [
        {"means": lambda t: t.numpy()},
        {"means": lambda t: t[:, :2]},
        {"means": lambda t: t[0, 0]},
        {"quats": lambda t: t[:4]},
        {"scales": lambda t: t[:, :2]},
        {"opacities": lambda t: t[:, None]},
        {"sh": lambda t: t[:, :5]},
        {"sh": lambda t: t[:, 0]},
        {"quats": lambda t: t.int()},
        {"means": with_one(np.nan)},
        {"means": lambda t: 1e39 * t.double()},
        {"quats": with_one(np.inf)},
        {"quats": with_one(-1e20)},
        {"scales": lambda t: t.to_sparse()},
        {"sh": with_one(-np.inf)},
        {"scales": with_one(-2.5)},
        {"opacities": with_one(1.5)},
        {"opacities": with_one(-0.5)},
        {"scales": lambda t: t.to("meta")},
    ],
)
def test_wrong_tensors_are_refused(change):
    check_refusal(change)


def test_other_wrong_input_is_refused():
    camera = make_scene(scattered_cloud).camera
    distorted = replace(camera, intrinsics=replace(camera.intrinsics, distortion=(0.1, 0.0, 0.0, 0.0)))
    check_refusal({}, camera=distorted)
    check_refusal({}, camera=View.of(camera))
    scaled = replace(camera, cam_from_world=Similarity(np.eye(3), np.zeros(3), 2.0))
    check_refusal({}, camera=scaled)
    wide = replace(camera, intrinsics=replace(camera.intrinsics, width=2**19 + 1))
    check_refusal({}, camera=wide)
    check_refusal({}, background="black")
    check_refusal({}, background=None)
    check_refusal({}, background=torch.tensor([1j, 0, 0]))
    check_refusal({}, background=[1, 1])
    check_refusal({}, background=[1, np.nan, 1])
    meta = dict.fromkeys(("means", "quats", "scales", "opacities", "sh"), lambda t: t.to("meta"))
    check_refusal(meta)


def test_torch_is_imported_on_first_use(monkeypatch):
    script = "import sys; import reconstructors.splat; print('torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert done.stdout == "False\n", done.stderr
    scene = make_scene(scattered_cloud)
    monkeypatch.setitem(sys.modules, "torch", None)
    with check_error(MissingExtra):
        rasterize(*scene.arrays, scene.camera)


def test_a_graph_alive_at_exit_prints_nothing():
    """Torch keeps it and its rasterizer; nanobind must not report them as leaks."""
    script = """
import sys
sys.path[:0] = [{path!r}]
import torch
from splat_scenes import make_scene, scattered_cloud
from reconstructors.splat import rasterize
scene = make_scene(scattered_cloud)
rendering = rasterize(*(torch.from_numpy(array).requires_grad_() for array in scene.arrays), scene.camera)
"""
    done = subprocess.run([sys.executable, "-c", script.format(path=str(TESTS))], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
