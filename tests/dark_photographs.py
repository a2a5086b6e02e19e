"""Darker copies of the photographs of a scene."""

import shutil

import numpy as np
from PIL import Image


def write_dark_copy(scene_folder, folder, gain, *, noise=0.7, bits=8):
    """Write a copy of a scene into a new folder: values multiplied, sensor noise added. Return the folder.

    Args:
        scene_folder: scene with images in `images/`.
        folder: folder to create.
        gain: factor of the grey values.
        noise: standard deviation of the sensor noise, in 8-bit grey levels.
        bits: 8 for colour, or 16 for grey images of 16 bits.
    """
    shutil.copytree(scene_folder, folder)
    rng = np.random.default_rng(7)
    for path in sorted((folder / "images").iterdir()):
        image = Image.open(path)
        values = gain * np.asarray(image if bits == 8 else image.convert("L"), dtype=float)
        values += rng.normal(0, noise, values.shape)
        scale, dtype = (1, np.uint8) if bits == 8 else (257, np.uint16)
        Image.fromarray(np.clip(np.rint(scale * values), 0, 256 * scale - 1).astype(dtype)).save(path)
    return folder
