"""Fixtures that several tests of scenes share."""

import pytest
from scene_folders import ten_images_folder


@pytest.fixture
def photographs(tmp_path):
    """A folder with images/0.png to 9.png of 64 x 48 pixels."""
    return ten_images_folder(tmp_path)
