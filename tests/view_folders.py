"""Folders of rendered views: photographs of noise, and renderings with a constant error."""

import numpy as np

from pcbench.scenes.splits import split_blocks, split_every
from pcbench.scenes.views import ViewImages, write_views

LEVEL_OFFSET = 8  # error of the first view, in grey levels; it grows by one per view


def photograph(number, size=(64, 48)):
    rng = np.random.default_rng(number)
    return rng.integers(40, 200, (size[1], size[0], 3), dtype=np.uint8)


def write_view_folder(folder, scene="city", count=18, blocks=None, mask=None, method="splat"):
    """Write a folder of views; the rendering of k.png is LEVEL_OFFSET + k grey levels brighter."""
    names = [f"{k}.png" for k in range(count)]
    split = split_every(names) if blocks is None else split_blocks(names, blocks)

    def render(name):
        number = int(name.removesuffix(".png"))
        truth = photograph(number)
        return ViewImages(name, truth + np.uint8(LEVEL_OFFSET + number), truth, mask)

    write_views(folder, scene, method, split, render)
    return folder


def psnr_of(number):
    """PSNR of view `number` by its definition, in dB."""
    return 20 * np.log10(255 / (LEVEL_OFFSET + number))
