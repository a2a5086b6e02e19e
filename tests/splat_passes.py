"""Forward and backward pass of any rasterizer, with results as comparable arrays."""

from types import ModuleType
from typing import NamedTuple

import numpy as np

from reconstructors.splat.interface import GaussianTensors
from reconstructors.splat.view import View

IMAGES = ("color", "transmittance", "depth", "normal", "median_depth")


class Engine(NamedTuple):
    """A module of `reconstructors.splat.interface.Kernels`, and the device of its tensors."""

    kernels: ModuleType
    device: str

    def tensor(self, array):
        """Return an array as a tensor on the device."""
        import torch

        return torch.from_numpy(np.ascontiguousarray(array)).to(self.device)


class Pass(NamedTuple):
    """Results of a rasterizer, with gradients for all N Gaussians: zeros for those that were not drawn."""

    images: dict  # by name, (P, 1 or 3)
    gradients: dict  # by name, (N, ...)
    drawn: np.ndarray  # (N,) bool

    def arrays(self):
        """Return images and gradients by name."""
        return {**self.images, **self.gradients}


class ImageGradients(NamedTuple):
    """Gradients with respect to the images, or None."""

    color: np.ndarray
    transmittance: np.ndarray | None
    depth: np.ndarray | None
    normal: np.ndarray | None


def random_image_gradients(scene, seed=3):
    rng, k = np.random.default_rng(seed), scene.camera.intrinsics
    size = (k.height, k.width)
    shapes = [(*size, 3), size, size, (*size, 3)]
    return ImageGradients(*(rng.normal(size=shape).astype(np.float32) for shape in shapes))


def run_pass(engine, scene, image_gradients=None, rasterizer=None, view=None, **images):
    """Run a forward pass, and a backward pass if gradients are given; `images` are those to render."""
    rasterizer = rasterizer or engine.kernels.Rasterizer()
    view = view or View.of(scene.camera)
    *gaussians, background = (engine.tensor(array) for array in (*scene.arrays, scene.background))
    output = rasterizer.forward(GaussianTensors(*gaussians), view, background, **{"geometry": True} | images)
    pixels = view.width * view.height
    images = {
        name: image.cpu().double().numpy().reshape(pixels, -1)
        for name, image in zip(IMAGES, output, strict=True)
        if image is not None
    }
    if image_gradients is None:
        return Pass(images, {}, np.zeros(0, bool))
    gradients = rasterizer.backward(*(None if image is None else engine.tensor(image) for image in image_gradients))
    ids, count = gradients.ids.cpu().numpy(), len(scene.means)
    assert (np.diff(ids) > 0).all()
    all_gradients = {}
    for name, rows in zip(gradients._fields[1:], gradients[1:], strict=True):
        all_gradients[name] = np.zeros((count, *rows.shape[1:]))
        all_gradients[name][ids] = rows.cpu().double().numpy()
    return Pass(images, all_gradients, np.isin(np.arange(count), ids))
