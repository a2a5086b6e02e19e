"""The shared header of mathematics, compiled in simple loops, against the reference rasterizer."""

import ctypes
import os
import re
import shutil
import subprocess
from typing import NamedTuple

import numpy as np
import pytest
from optional import import_or_skip
from repository import ROOT
from splat_scenes import SCENES, crowd, make_scene, needles, no_gaussians, opaque_gaussians, scattered_cloud

from reconstructors.splat.interface import GaussianTensors
from reconstructors.splat.view import View

torch = import_or_skip("torch")
reference = pytest.importorskip("reconstructors.splat.reference")

HEADERS = [ROOT / "reconstructors" / "splat" / name for name in ("pinhole.h", "maths.h")]
LOOPS = ROOT / "tests" / "reconstructors" / "splat" / "maths.cpp"
COMPILER = shutil.which(os.environ.get("CXX", "c++"))

pytestmark = pytest.mark.skipif(COMPILER is None, reason="needs a C++ compiler")


def double_precision_source(text):
    """Return the header for double precision, its constants with all digits, so that remaining differences are errors.
    Thresholds keep their float values."""
    digits_of = {
        "kWhitening": "0.84932180028801904",
        "kLn2": "0.69314718055994531",
        "0.282094792": "0.28209479177387814",
        "0.488602512": "0.48860251190291992",
        "1.09254843": "1.09254843059207907",
        "0.315391565": "0.31539156525252001",
        "0.630783131": "0.63078313050504001",
        "0.546274215": "0.54627421529603953",
        "0.590043590": "0.59004358992664351",
        "2.89061144": "2.89061144264055405",
        "0.457045799": "0.45704579946446573",
        "0.373176333": "0.37317633259011539",
        "1.44530572": "1.44530572132027702",
    }
    thresholds = r"constexpr float kMaxAlpha .*\n"
    parts = zip(re.split(thresholds, text), [*re.findall(thresholds, text), ""], strict=True)
    text = "".join(re.sub(r"(?<=[\d.])f\b", "", part) + threshold for part, threshold in parts)
    text = re.sub(r"\bfloat\b", "double", text)
    for constant, all_digits in digits_of.items():
        if constant.startswith("k"):
            text, count = re.subn(rf"(constexpr double {constant} = )[-\d.]+;", rf"\g<1>{all_digits};", text)
        else:
            text, count = re.subn(rf"(?<![\d.]){re.escape(constant)}(?!\d)", all_digits, text)
        assert count >= 1, constant
    return text


class Loops:
    """The compiled loops in one floating type."""

    def __init__(self, folder, real):
        header, library = folder / f"maths_{real}.h", folder / f"maths_{real}.so"
        text = "".join(path.read_text(encoding="utf-8") for path in HEADERS if path.exists())
        header.write_text(double_precision_source(text) if real == "double" else text, encoding="utf-8")
        flags = [f"-DREAL={real}", f'-DMATHS="{header}"', *(["-DEXACT"] if real == "double" else [])]
        command = [
            COMPILER,
            "-std=c++17",
            "-O1",
            "-Wall",
            "-Wextra",
            "-Werror",
            "-ffp-contract=off",
            "-shared",
            "-fPIC",
        ]
        process = subprocess.run([*command, *flags, str(LOOPS), "-o", str(library)], capture_output=True, text=True)
        assert process.returncode == 0, process.stderr
        self.library, self.type = ctypes.CDLL(str(library)), np.dtype({"double": "f8", "float": "f4"}[real])

    def call(self, name, *arguments):
        getattr(self.library, name)(
            *(
                ctypes.c_void_p(a.ctypes.data)
                if isinstance(a, np.ndarray)
                else ctypes.c_int(a)
                if a is not None
                else None
                for a in arguments
            )
        )

    def rasterize(self, scene, view, sums):
        count, harmonics = scene.sh.shape[:2]
        arrays = [np.ascontiguousarray(a, self.type) for a in scene.arrays]
        numbers = [*view.rotation.ravel(), *view.position, view.fx, view.fy, view.cx, view.cy, *view.limits, view.near]
        numbers += view.cutoffs
        pixels = view.width * view.height
        images, median, boxes = (np.zeros(s, self.type) for s in ((pixels, 8), pixels, (count, 5)))
        gradients, sh_gradients = np.zeros((count, 13), self.type), np.zeros((count, harmonics, 3), self.type)
        self.call(
            "rasterize", count, harmonics, *arrays, np.array(numbers, self.type), view.width, view.height,
            scene.background.astype(self.type), images, median, boxes, sums.astype(self.type), gradients, sh_gradients,
        )  # fmt: skip
        return PassArrays(images, median, gradients, sh_gradients, boxes)


class PassArrays(NamedTuple):
    """Images (P, 8), median depth (P,), gradients (N, 13), gradients of harmonics, and boxes (N, 5)."""

    images: np.ndarray
    median: np.ndarray
    gradients: np.ndarray
    sh_gradients: np.ndarray
    boxes: np.ndarray | None = None


@pytest.fixture(scope="module")
def double_loops(tmp_path_factory):
    return Loops(tmp_path_factory.mktemp("maths"), "double")


@pytest.fixture(scope="module")
def float_loops(tmp_path_factory):
    return Loops(tmp_path_factory.mktemp("maths"), "float")


def reference_pass(scene, view, sums):
    """Return the results of the reference rasterizer."""
    size, n = (view.height, view.width), len(scene.means)
    rasterizer = reference.Rasterizer()
    tensors = [torch.from_numpy(a) for a in (*scene.arrays, scene.background)]
    rendering = rasterizer.forward(GaussianTensors(*tensors[:5]), view, tensors[5], geometry=True)
    image_gradients = torch.from_numpy(sums)
    gradient_images = [
        image_gradients[:, :3].reshape(*size, 3),
        image_gradients[:, 3].reshape(size),
        image_gradients[:, 4].reshape(size),
        image_gradients[:, 5:].reshape(*size, 3),
    ]
    pass_gradients = rasterizer.backward(*gradient_images)
    images = torch.cat([image.reshape(size[0] * size[1], -1) for image in rendering[:4]], dim=1).numpy()
    gradients = np.zeros((n, 13))
    parts = [
        pass_gradients.means,
        pass_gradients.quats,
        pass_gradients.scales,
        pass_gradients.opacities,
        pass_gradients.screen,
    ]
    gradients[pass_gradients.ids] = torch.cat(
        [part if part.ndim == 2 else part[:, None] for part in parts], dim=1
    ).numpy()
    sh_gradients = np.zeros(scene.sh.shape)
    sh_gradients[pass_gradients.ids] = pass_gradients.sh.numpy()
    return PassArrays(images, rendering.median_depth.numpy().ravel(), gradients, sh_gradients)


def random_gradients(scene, seed=3):
    rng, pixels = np.random.default_rng(seed), scene.camera.intrinsics.width * scene.camera.intrinsics.height
    return rng.normal(size=(pixels, 8))


@pytest.mark.parametrize("kind", SCENES)
def test_formulas_agree_with_the_reference(double_loops, kind):
    """In float64: images and gradients."""
    scene = make_scene(kind)
    view, image_gradients = View.of(scene.camera), random_gradients(scene)
    ours, theirs = double_loops.rasterize(scene, view, image_gradients), reference_pass(scene, view, image_gradients)
    assert max_relative_difference(ours, theirs) < rounding_bound(scene, view)
    visible = np.abs(theirs.gradients).sum(axis=1) > 0
    assert (ours.boxes[visible, 4] > 0).all()
    assert kind is no_gaussians or (theirs.median.any() and visible.any())


@pytest.mark.parametrize("kind", [kind for kind in SCENES if kind not in (crowd, needles, opaque_gaussians)])
def test_formulas_agree_in_float(float_loops, kind):
    """The polynomials have errors of 2e-7, the rest some roundings; sums over hundreds of Gaussians and pixels leave
    a few 1e-5 of the maximum. Scenes with many values at thresholds, which rounding can flip, have their own tests."""
    scene = make_scene(kind)
    view, image_gradients = View.of(scene.camera), random_gradients(scene)
    assert (
        max_relative_difference(
            float_loops.rasterize(scene, view, image_gradients), reference_pass(scene, view, image_gradients)
        )
        < 1e-4
    )


def rounding_bound(scene, view):
    """Return the bound of rounding errors in float64 on any processor, relative to the maximum of a column.

    About 100 operations lead from a Gaussian's numbers to its share of a pixel and back to its gradient. Each rounds by
    at most eps, which the inverse of the covariance in pixels multiplies by no more than its condition number (Higham
    2002, section 14.1). Sums over Gaussians and pixels round once per term.
    """
    splats = reference.project(GaussianTensors(*(torch.from_numpy(a).double() for a in scene.arrays)), view)
    condition = torch.linalg.cond(splats.inverse).max().item() if len(splats.ids) else 1.0
    return np.finfo(float).eps * (100 * condition + len(scene.means) + view.width * view.height)


def max_relative_difference(ours, theirs):
    """Return the maximum difference relative to the maximum of the column."""
    pairs = [(ours.images, theirs.images), (ours.median[:, None], theirs.median[:, None])]
    pairs += [(ours.gradients, theirs.gradients), (ours.sh_gradients, theirs.sh_gradients)]
    return max((np.abs(a - b) / np.abs(b).max(axis=0, initial=1e-30)).max(initial=0) for a, b in pairs)


def test_boxes_bound_the_ellipses(double_loops):
    """The half size is sqrt(2 ln(opacity / min_alpha) covariance): there alpha is min_alpha."""
    scene = make_scene(scattered_cloud)
    view = View.of(scene.camera)
    boxes = double_loops.rasterize(scene, view, random_gradients(scene)).boxes
    splats = reference.project(GaussianTensors(*(torch.from_numpy(a).double() for a in scene.arrays)), view)
    assert len(splats.ids) == (boxes[:, 4] > 0).sum()
    spread = torch.linalg.inv(splats.inverse).diagonal(dim1=1, dim2=2)
    half_sizes = (2 * torch.log(splats.opacities[:, None] / view.cutoffs[0]) * spread).sqrt()
    # 1e-9 of a pixel or of the box: a thousand times the rounding bound of this scene, whose covariances have condition
    # numbers up to 30.
    low, high = (splats.xy - half_sizes).numpy(), (splats.xy + half_sizes).numpy()
    np.testing.assert_allclose(boxes[splats.ids][:, [0, 2]], low, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(boxes[splats.ids][:, [1, 3]], high, rtol=1e-9, atol=1e-9)


def test_powers_and_logarithms_are_accurate(float_loops):
    """To the 2e-7 that the header claims, three roundings of a float."""
    x = np.concatenate([np.linspace(-125, 125, 100_001), np.geomspace(1e-37, 1e37, 100_001)]).astype(np.float32)
    powers, logarithms = np.empty_like(x), np.empty_like(x)
    inside = np.where(np.abs(x) < 126, x, 1).astype(np.float32)
    float_loops.call("exp2_and_log2", len(x), inside, powers, logarithms)
    expected_powers = np.exp2(inside.astype(np.float64))
    assert (np.abs(powers - expected_powers) / expected_powers).max() < 2e-7
    positive = np.where(x > 0, x, 1).astype(np.float32)
    float_loops.call("exp2_and_log2", len(x), positive, powers, logarithms)
    expected_logarithms = np.log2(positive.astype(np.float64))
    assert (np.abs(logarithms - expected_logarithms) / np.maximum(1, np.abs(expected_logarithms))).max() < 2e-7


def test_the_minimum_of_the_squared_norm_over_a_box(double_loops):
    """Against the minimum over a fine grid in each box, which may exceed it by the second order of the step."""
    rng = np.random.default_rng(5)
    shapes = np.column_stack([rng.uniform(0.1, 2, 300), rng.uniform(-2, 2, 300), rng.uniform(0.05, 2, 300)])
    corner, size = rng.uniform(-12, 8, (300, 2)), rng.uniform(0, 8, (300, 2))
    boxes = np.column_stack([corner[:, 0], corner[:, 0] + size[:, 0], corner[:, 1], corner[:, 1] + size[:, 1]])
    minima = np.empty(300)
    double_loops.call("min_squared_norms", 300, np.column_stack([shapes, boxes]), minima)
    fractions = np.linspace(0, 1, 201)
    x = corner[:, 0, None, None] + size[:, 0, None, None] * fractions[:, None]
    y = corner[:, 1, None, None] + size[:, 1, None, None] * fractions
    uu, uv, vv = shapes.T[:, :, None, None]
    grid_minima = ((uu * x + uv * y) ** 2 + (vv * y) ** 2).min(axis=(1, 2))
    assert (minima < grid_minima + 1e-12).all()
    step = (size / 200).max(axis=1)
    assert (grid_minima - minima < 2 * (uu + np.abs(uv) + vv)[:, 0, 0] ** 2 * step * (step + 1e-12)).all()
    assert (minima == 0).any() and (minima > 1).any()
