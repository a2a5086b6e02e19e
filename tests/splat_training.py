"""A model with known images, which training has to recover."""

from dataclasses import replace

import numpy as np
import torch
from splat_scenes import scattered_cloud

from pcbench.geometry.cameras import look_at
from reconstructors.splat.model import Gaussians
from reconstructors.splat.photographs import Photograph
from reconstructors.splat.train import evaluate, render
from reconstructors.splat.view import View


def truth():
    """Return a model of 60 Gaussians and eight images of it from around."""
    scene = scattered_cloud(np.random.default_rng(5), 60, width=48, height=32, degree=0, size=0.25)
    means, quats, scales, opacities, sh = (torch.from_numpy(a) for a in scene.arrays)
    model = Gaussians(means, quats, scales.log(), torch.logit(opacities.clamp(0.3, 0.95)), sh * 0.5)
    pictures = []
    for k, angle in enumerate(np.linspace(0, 2 * np.pi, 8, endpoint=False)):
        position = (4 * np.cos(angle), 4 * np.sin(angle), 1.5)
        camera = replace(scene.camera, name=str(k), cam_from_world=look_at(position, (0, 0, 0)))
        view = View.of(camera)
        pictures.append([Photograph(str(k), view, (render(model, view) * 255).round().to(torch.uint8), None)])
    return model, pictures


def grey(model):
    """Return grey spheres at the same positions."""
    return Gaussians(
        model.means.clone(),
        torch.tensor([1.0, 0, 0, 0]).repeat(len(model), 1),
        torch.full_like(model.log_scales, float(np.log(0.2))),
        torch.full_like(model.logits, -2.0),
        torch.zeros_like(model.sh[:, :1]),
    )


def numbers(model):
    """Return the bytes of all parameters."""
    return [part.numpy().tobytes() for part in (model.means, model.quats, model.log_scales, model.logits, model.sh)]


def mean_psnr(model, photographs, background=None, **options):
    """Return the mean PSNR of photographs in dB."""
    return np.mean([score.psnr for score in evaluate(model, photographs, background, **options)])
