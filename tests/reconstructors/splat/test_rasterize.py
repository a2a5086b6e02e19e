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


def scene_tensors(device, scene, dtype=torch.float32):
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
    tensors = scene_tensors(device, scene)
    ours = rasterize(*tensors, scene.camera, background=background)
    random_loss(ours).backward()

    exact = [torch.from_numpy(array).double().requires_grad_() for array in (*scene.arrays, scene.background)]
    rendering = reference.render(GaussianTensors(*exact[:5]), View.of(scene.camera), exact[5])
    alpha = 1 - rendering.transmittance
    theirs = ours._replace(
        color=rendering.color,
        alpha=alpha,
        depth=rendering.depth / torch.where(alpha > 0, alpha, 1),
        normal=rendering.normal,
        median_depth=rendering.median_depth,
    )
    random_loss(theirs).backward()
    assert (theirs.alpha == 0).any() and (ours.depth[ours.alpha == 0] == 0).all()
    for name, image in ours._asdict().items():
        assert image.dtype == torch.float32 and image.requires_grad == (name != "median_depth")
        expected = getattr(theirs, name).detach().numpy()
        # Where alpha is a few thousandths its rounding error is 1e-5 of it, and of the depth.
        np.testing.assert_allclose(image.detach().cpu().numpy(), expected, rtol=0, atol=1e-4, err_msg=name)
    for tensor, exact_tensor in zip([*tensors, background], exact, strict=True):
        scale = exact_tensor.grad.abs().max().item()
        # Likewise the gradient of a depth divided by such an alpha.
        np.testing.assert_allclose(tensor.grad.cpu().numpy(), exact_tensor.grad.numpy(), rtol=1e-3, atol=3e-5 * scale)


def test_a_scene_far_from_the_origin_has_the_same_images(device):
    """In float64 UTM coordinates; float32 would be wrong by half a metre."""
    scene = make_scene(scattered_cloud)
    offset = np.array([654_321.0, 5_432_109.0, 512.0])
    pose = scene.camera.cam_from_world
    moved_camera = replace(
        scene.camera, cam_from_world=Similarity(pose.rotation, pose.translation - pose.rotation @ offset)
    )
    means, *others = scene_tensors(device, scene, torch.float64)
    near_rendering = rasterize(means, *others, scene.camera)
    far_means = (means.detach() + device.tensor(offset)).requires_grad_()
    far_rendering = rasterize(far_means, *others, moved_camera)
    for ours, theirs in zip(far_rendering, near_rendering, strict=True):
        # The coordinates are exact to 1e-9; a pixel may change sides at the threshold of 1/255.
        assert (ours - theirs).abs().max() < 5e-3 and ((ours - theirs).abs() > 1e-5).float().mean() < 1e-3
    random_loss(near_rendering).backward()
    random_loss(far_rendering).backward()
    assert means.grad.dtype == torch.float64
    assert torch.allclose(far_means.grad, means.grad, rtol=1e-3, atol=1e-4 * means.grad.abs().max().item())


@pytest.mark.parametrize("dtype", [torch.float64, torch.float16, torch.bfloat16])
def test_other_types_are_rendered_in_float32(device, dtype):
    scene = make_scene(scattered_cloud)
    tensors = scene_tensors(device, scene, dtype)
    rendering = rasterize(*tensors, scene.camera)
    random_loss(rendering).backward()
    float_tensors = [tensor.detach().float().requires_grad_() for tensor in tensors]
    expected = rasterize(*float_tensors, scene.camera)
    random_loss(expected).backward()
    assert rendering.color.dtype == torch.float32 and torch.equal(rendering.color, expected.color)
    for ours, theirs in zip(tensors, float_tensors, strict=True):
        assert ours.grad.dtype == dtype
        assert torch.equal(ours.grad, theirs.grad.to(dtype))


def test_tensors_that_are_not_contiguous_have_the_same_gradients(device):
    scene = make_scene(scattered_cloud)
    tensors = scene_tensors(device, scene)
    strided_tensors = [torch.stack([tensor.detach()] * 2, dim=-1)[..., 0].requires_grad_() for tensor in tensors]
    assert not any(tensor.is_contiguous() for tensor in strided_tensors)
    for leaves in (tensors, strided_tensors):
        random_loss(rasterize(*leaves, scene.camera)).backward()
    for ours, theirs in zip(strided_tensors, tensors, strict=True):
        assert torch.equal(ours.grad, theirs.grad)


def test_two_renderings_have_independent_gradients(device):
    """Each keeps the data for its own gradient, which can be computed in any order and twice."""
    scenes = make_scene(scattered_cloud), make_scene(scattered_cloud, seed=1)
    gradients = []
    for scene in scenes:
        tensors = scene_tensors(device, scene)
        random_loss(rasterize(*tensors, scene.camera)).backward()
        gradients.append([tensor.grad for tensor in tensors])
    tensors = [scene_tensors(device, scene) for scene in scenes]
    losses = [random_loss(rasterize(*leaves, scene.camera)) for leaves, scene in zip(tensors, scenes, strict=True)]
    (losses[0] + losses[1]).backward(retain_graph=True)
    losses[0].backward()
    for tensor, gradient in zip(tensors[0], gradients[0], strict=True):
        assert torch.equal(tensor.grad, gradient + gradient)
    for tensor, gradient in zip(tensors[1], gradients[1], strict=True):
        assert torch.equal(tensor.grad, gradient)


def test_overwritten_tensors_have_no_gradient(device):
    """Torch raises an error if a parameter or an image was changed in place."""
    scene = make_scene(scattered_cloud)
    tensors = scene_tensors(device, scene)
    loss = random_loss(rasterize(*tensors, scene.camera))
    with torch.no_grad():
        tensors[2] *= 0.5
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        loss.backward()
    rendering = rasterize(*scene_tensors(device, scene), scene.camera)
    loss = random_loss(rendering._replace(color=rendering.color.clamp_(0, 1)))
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        loss.backward()
    background = device.tensor(scene.background)
    loss = random_loss(rasterize(*scene_tensors(device, scene), scene.camera, background=background))
    background += 1
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        loss.backward()


def test_gradients_with_respect_to_one_tensor_only(device):
    scene = make_scene(scattered_cloud)
    all_tensors = scene_tensors(device, scene)
    random_loss(rasterize(*all_tensors, scene.camera)).backward()
    for index in range(5):
        tensors = [tensor.requires_grad_(n == index) for n, tensor in enumerate(scene_tensors(device, scene))]
        random_loss(rasterize(*tensors, scene.camera)).backward()
        assert [tensor.grad is not None for tensor in tensors] == [n == index for n in range(5)]
        assert torch.equal(tensors[index].grad, all_tensors[index].grad)


def test_the_backward_pass_is_prepared_only_if_a_tensor_requires_a_gradient(device, monkeypatch):
    """On CUDA it needs memory."""
    gradient_options = []

    class RecordingRasterizer:
        def __init__(self):
            self.rasterizer = device.kernels.Rasterizer()

        def forward(self, *arguments, gradient, **options):
            gradient_options.append(gradient)
            return self.rasterizer.forward(*arguments, gradient=gradient, **options)

    monkeypatch.setattr(
        sys.modules[rasterize.__module__], "kernels_of", lambda _: SimpleNamespace(Rasterizer=RecordingRasterizer)
    )
    scene = make_scene(scattered_cloud)
    tensors = [tensor.requires_grad_(False) for tensor in scene_tensors(device, scene)]
    rasterize(*tensors, scene.camera)
    rasterize(*tensors[:4], tensors[4].requires_grad_(), scene.camera)
    assert gradient_options == [False, True]


def test_a_deleted_rendering_is_freed(device):
    """With all its memory, immediately: there is no reference cycle."""
    scene = make_scene(scattered_cloud)
    rendering = rasterize(*scene_tensors(device, scene), scene.camera)
    node = rendering.color.grad_fn
    rasterizer_reference = weakref.ref(node.rasterizer)
    assert rasterizer_reference() is not None
    del rendering, node
    assert rasterizer_reference() is None


def test_renderings_without_gradients_or_without_gaussians(device):
    scene = make_scene(scattered_cloud)
    with torch.no_grad():
        rendering = rasterize(*scene_tensors(device, scene), scene.camera)
    assert not rendering.color.requires_grad
    empty, background = make_scene(no_gaussians), [0.1, 0.2, 0.3]
    tensors = scene_tensors(device, empty)
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


def set_one_value(value):
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
        {"means": set_one_value(np.nan)},
        {"means": lambda t: 1e39 * t.double()},
        {"quats": set_one_value(np.inf)},
        {"quats": set_one_value(-1e20)},
        {"scales": lambda t: t.to_sparse()},
        {"sh": set_one_value(-np.inf)},
        {"scales": set_one_value(-2.5)},
        {"opacities": set_one_value(1.5)},
        {"opacities": set_one_value(-0.5)},
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
    process = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert process.stdout == "False\n", process.stderr
    scene = make_scene(scattered_cloud)
    monkeypatch.setitem(sys.modules, "torch", None)
    with check_error(MissingExtra):
        rasterize(*scene.arrays, scene.camera)


@pytest.mark.long
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
    process = subprocess.run([sys.executable, "-c", script.format(path=str(TESTS))], capture_output=True, text=True)
    assert (process.returncode, process.stderr) == (0, "")
