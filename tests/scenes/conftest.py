"""Fixtures that several tests of scenes share."""

import pytest
from scene_folders import ten_images_folder

from pcbench.scenes.synthetic.plan import CitySettings
from pcbench.scenes.synthetic.surface import build_city


@pytest.fixture(scope="session")
def city():
    """A small city with texels of half a metre."""
    return build_city(CitySettings(extent=120.0, seed=3), texel=0.5)


@pytest.fixture
def photographs(tmp_path):
    """A folder with images/0.png to 9.png of 64 x 48 pixels."""
    return ten_images_folder(tmp_path)
