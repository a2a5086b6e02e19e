"""Previews of a training as a reconstructor writes them."""

import numpy as np

from pcbench import Cloud
from pcbench.scenes.previews import Preview, Progress, SizeScore, write_preview


def preview_of(steps, held_out=True):
    """Return a training with a state at each of the steps; PSNR grows by 1 dB in ten steps."""
    history = tuple(Progress(k, k, 1 / k, 20 + k / 10, 18 + k / 10 if held_out else None, 2 * k) for k in steps)
    sizes = [
        SizeScore(2 * k, degree, metric, 0.2 * k, 0.1 * k, 0.3 * k, k == steps[-1])
        for metric in ("PSNR, dB", "SSIM")
        for k in steps
        for degree in (0, 1)
    ]
    return Preview("key", 100, "a/1.png", held_out, history, tuple(sizes) if held_out else (), "Few suffice.")


def write_preview_folder(workspace, steps, rendering=180, held_out=True):
    """Write the preview into a workspace, with as many points as the last step, and return its folder."""
    folder = workspace / "plugin" / "preview"
    folder.parent.mkdir(parents=True, exist_ok=True)
    points = np.random.default_rng(0).uniform(0, 10, (steps[-1], 3))
    cloud = Cloud(points, colors=np.full((len(points), 3), 150, np.uint8))
    images = (None if level is None else np.full((30, 40, 3), level, np.uint8) for level in (rendering, 200))
    write_preview(folder, preview_of(steps, held_out), *images, cloud)
    return folder
