"""Scene folders with small random images and their cameras."""

import numpy as np
from PIL import Image

from pcbench.geometry.cameras import Camera, Intrinsics, look_at

K = Intrinsics(64, 48, 50.0, 51.0, 31.0, 25.0, (0.01, -0.02, 0.001, 0.002))
NAMES = [f"{number}.png" for number in range(10)]


def orbit(names, intrinsics=K):
    angles = 2 * np.pi * np.arange(len(names)) / len(names)
    return [
        Camera(name, intrinsics, look_at([5 * np.cos(a), 5 * np.sin(a), 2 + 0.1 * a], [0, 0, 0]))
        for name, a in zip(names, angles, strict=True)
    ]


def picture(path, size=(64, 48), value=0):
    path.parent.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(value)
    Image.fromarray(rng.integers(0, 255, (size[1], size[0], 3), dtype=np.uint8)).save(path)


def ten_images_folder(folder):
    """Create a folder with images/0.png to 9.png of 64 x 48 pixels."""
    for number in range(10):
        picture(folder / "images" / f"{number}.png", value=number)
    return folder
