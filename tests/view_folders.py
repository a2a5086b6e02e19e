"""Folders of rendered views: photographs of noise, and renderings that are off by so many levels."""

import numpy as np

from pcbench.scenes.splits import every, in_blocks
from pcbench.scenes.views import Pictures, write_views

OFF = 8  # levels that the first view is off by; each next one by one more


def photograph(number, size=(64, 48)):
    rng = np.random.default_rng(number)
    return rng.integers(40, 200, (size[1], size[0], 3), dtype=np.uint8)


def views_of(folder, scene="city", count=18, blocks=None, mask=None, method="splat"):
    """Write a folder of views; of k.png the rendering is OFF + k levels lighter."""
    names = [f"{k}.png" for k in range(count)]
    split = every(names) if blocks is None else in_blocks(names, blocks)

    def render(name):
        number = int(name.removesuffix(".png"))
        truth = photograph(number)
        return Pictures(name, truth + np.uint8(OFF + number), truth, mask)

    write_views(folder, scene, method, split, render)
    return folder


def psnr_of(number):
    """Of view `number`, by the definition."""
    return 20 * np.log10(255 / (OFF + number))
