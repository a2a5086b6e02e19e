"""What several tests of scenes start from."""

import pytest
from scene_folders import ten_pictures


@pytest.fixture
def photographs(tmp_path):
    """A folder with images/0.png to 9.png of 64 x 48 pixels."""
    return ten_pictures(tmp_path)
