"""Pictures, compared with small golden ones in the folder `pictures` within a tolerance.

Golden pictures are reduced to at most 240 x 180 pixels. Mean colours of blocks of 10 x 10 pixels are compared, because
other processors, versions of matplotlib and FreeType, and OpenGL drivers place dots and letters elsewhere, and smooth
lines differently, by a pixel or two of the original. `make pictures` renews the golden ones; look at them then.
"""

import io

import numpy as np
import pytest
from PIL import Image
from repository import TESTS

GOLDEN = TESTS / "pictures"
MAX_DIFFERENCE, MAX_MEAN_DIFFERENCE = 22.0, 1.1
"""Limits of the difference of blocks, of 255, and of its mean over all blocks.

matplotlib 3.9 instead of 3.11 differs by up to 5 and 0.2, VTK 9.4 instead of 9.7 not at all, and Mesa's softpipe, which
does not smooth, instead of llvmpipe by up to 19 and 0.9. A shift by 3 % of the width differs by at least 25, a missing
third of what is drawn by at least 1.6 on average, and colours that are paler by a third by at least 28 or 2.4.
"""
_MAX_SIZE = (240, 180)
_BLOCK_PX = 10
_COMPRESSION_ERROR = 2.0  # of a golden picture's colours


def reduced(picture):
    """Return a picture (height, width, 3), reduced by averaging to at most 240 x 180 pixels."""
    image = Image.fromarray(np.asarray(picture, np.uint8)[..., :3])
    factor = max(1.0, *(size / limit for size, limit in zip(image.size, _MAX_SIZE, strict=True)))
    size = [max(1, round(side / factor)) for side in image.size]
    return np.asarray(image.resize(size, Image.Resampling.BOX))


def read(path):
    """Return the picture of a file (height, width, 3)."""
    with Image.open(path) as image:
        return np.asarray(image.convert("RGB"))


def compressed(picture):
    """Return the bytes of a golden picture."""
    file = io.BytesIO()
    Image.fromarray(picture).save(file, "JPEG", quality=85, subsampling=0)
    return file.getvalue()


def difference(one, other):
    """Return the largest and the mean difference of the colours of blocks between two reduced pictures."""
    height, width = (side // _BLOCK_PX for side in one.shape[:2])
    blocks = [
        picture[: height * _BLOCK_PX, : width * _BLOCK_PX]
        .reshape(height, _BLOCK_PX, width, _BLOCK_PX, 3)
        .mean(axis=(1, 3), dtype=float)
        for picture in (one, other)
    ]
    apart = np.maximum(np.abs(blocks[0] - blocks[1]).max(axis=2) - _COMPRESSION_ERROR, 0.0)
    return float(apart.max()), float(apart.mean())


def is_similar(one, other):
    """Return whether two reduced pictures show the same."""
    if one.shape != other.shape:
        return False
    largest, mean = difference(one, other)
    return largest <= MAX_DIFFERENCE and mean <= MAX_MEAN_DIFFERENCE


def check_picture(name, picture, *, renew=False):
    """Compare a picture (height, width, 3) with the golden one of a name, or renew that."""
    shown, path = reduced(picture), GOLDEN / f"{name}.jpg"
    if renew:
        GOLDEN.mkdir(exist_ok=True)
        path.write_bytes(compressed(shown))
    golden = read(path)
    if not is_similar(golden, shown):
        apart = difference(golden, shown) if golden.shape == shown.shape else (golden.shape, shown.shape)
        pytest.fail(f"{path.name} shows something else (difference {apart}); `make pictures` renews it", pytrace=False)
