"""Photographs and masks of 8 and 16 bits."""

import numpy as np
import pytest
from PIL import Image

from pcbench.scenes.decode import decode_image, decode_luminance, decode_mask


@pytest.fixture
def deep(tmp_path):
    """A grey PNG of 16 bits, 4 x 2 pixels."""
    values = np.array([[0, 100, 257, 514], [4095, 32896, 65278, 65535]], np.uint16)
    Image.fromarray(values).save(tmp_path / "deep.png")
    return tmp_path / "deep.png", values


def test_16_bit_values_are_scaled(deep):
    path, values = deep
    rgb = decode_image(path, (4, 2))
    np.testing.assert_array_equal(rgb, np.rint(values / 257)[..., None].repeat(3, axis=2))
    np.testing.assert_allclose(decode_luminance(path, (4, 2)), values / 257, rtol=1e-6)
    assert decode_luminance(path, (2, 1)).max() < 255.5


def test_masks_of_16_bits_are_valid_where_not_black(deep):
    path, values = deep
    np.testing.assert_array_equal(decode_mask(path, (4, 2)), values > 0)


def test_luminance_of_colours_is_not_rounded(tmp_path):
    rgb = np.array([[[255, 0, 0], [0, 255, 0], [0, 0, 1], [10, 20, 30]]], np.uint8)
    Image.fromarray(rgb).save(tmp_path / "colours.png")
    expected = rgb @ [0.299, 0.587, 0.114]
    np.testing.assert_allclose(decode_luminance(tmp_path / "colours.png", (4, 1)), expected, rtol=1e-5)
