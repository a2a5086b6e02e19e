"""The comparison of pictures finds wrong colours, shifts and missing clouds, and allows for other smoothing."""

import numpy as np
import pictures
import pytest
from pictures import GOLDEN, check_picture, is_similar, read

PATHS = sorted(GOLDEN.glob("*.jpg"))


def foreground(picture):
    background = np.median(picture.reshape(-1, 3), axis=0)
    return np.abs(picture - background).max(axis=2) > 12, background


def swapped(picture):
    return picture[..., ::-1]


def shifted(picture):
    """Shift by 3 % of the width."""
    return np.roll(picture, round(0.03 * picture.shape[1]), axis=1)


def raised(picture):
    """Shift by 3 % of the width upwards."""
    return np.roll(picture, -round(0.03 * picture.shape[1]), axis=0)


def incomplete(picture):
    """Leave out the middle third."""
    drawn, background = foreground(picture)
    third = picture.shape[1] // 3
    drawn[:, :third] = drawn[:, 2 * third :] = False
    return np.where(drawn[..., None], background, picture)


def paler(picture):
    """Mix a third of the background into what is drawn."""
    drawn, background = foreground(picture)
    return np.where(drawn[..., None], 2 / 3 * picture + 1 / 3 * background, picture)


def smoothed(picture):
    """Shift by a quarter of a pixel, which is one to two pixels of the original."""
    return 0.75 * picture + 0.25 * np.roll(picture, 1, axis=1)


def noisy(picture):
    return picture + np.random.default_rng(0).normal(0, 6, picture.shape)


@pytest.mark.parametrize("path", PATHS, ids=lambda path: path.stem)
def test_wrong_pictures_are_found(path):
    picture = read(path)
    for change in (swapped, shifted, raised, incomplete, paler):
        assert not is_similar(picture, np.clip(change(picture), 0, 255)), change.__name__


@pytest.mark.parametrize("path", PATHS, ids=lambda path: path.stem)
def test_other_smoothing_is_no_difference(path):
    picture = read(path)
    for change in (smoothed, noisy):
        assert is_similar(picture, np.clip(change(picture), 0, 255)), change.__name__


def test_golden_pictures_are_small():
    assert PATHS
    for path in PATHS:
        assert path.stat().st_size < 15_000
        height, width, _ = read(path).shape
        assert width <= 240 and height <= 180


def test_a_picture_is_renewed_only_on_request(tmp_path, monkeypatch):
    monkeypatch.setattr(pictures, "GOLDEN", tmp_path)
    picture = np.full((300, 400, 3), 40, np.uint8)
    picture[100:200, 100:300] = (200, 100, 50)
    with pytest.raises(FileNotFoundError):
        check_picture("a", picture)
    check_picture("a", picture, renew=True)
    check_picture("a", picture)
    with pytest.raises(pytest.fail.Exception, match="make pictures"):
        check_picture("a", picture[:, ::-1] // 2)
    with pytest.raises(pytest.fail.Exception, match="make pictures"):
        check_picture("a", picture[:250])
