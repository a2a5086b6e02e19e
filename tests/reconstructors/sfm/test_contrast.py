"""Dark and faint photographs: their contrast is stretched for features, and only for these."""

import numpy as np
import pytest
import textured_corner as corner
from dark_photographs import write_dark_copy
from optional import import_or_skip
from wording import check_text

from pcbench.scenes import read_scene
from reconstructors.sfm.alignment import camera_errors
from reconstructors.sfm.contrast import stretch_contrast
from reconstructors.sfm.features import count_features, describe_stretched, extract_features
from reconstructors.sfm.sfm import ColmapSfm

K = corner.standard_intrinsics(320, 240)


def test_low_contrast_is_stretched_over_the_full_range():
    gray = np.random.default_rng(0).uniform(20, 87, (100, 150)).astype(np.float32)
    stretched = stretch_contrast(gray)
    assert stretched.dtype == np.uint8
    assert stretched.min() == 0
    assert stretched.max() == 255
    assert np.corrcoef(stretched.ravel(), gray.ravel())[0, 1] > 0.999
    # A lamp, or a hot pixel, does not keep the rest dark.
    gray[3, 5] = 255
    np.testing.assert_allclose(np.delete(stretch_contrast(gray), 3, axis=0), np.delete(stretched, 3, axis=0), atol=1)


def test_sufficient_contrast_and_blank_photographs_stay_unchanged():
    gray = np.random.default_rng(0).uniform(0, 120, (100, 150)).astype(np.float32)
    assert stretch_contrast(gray) is None
    assert stretch_contrast(np.full((100, 150), 30.4, np.float32)) is None


@pytest.fixture(scope="module")
def bright(tmp_path_factory):
    return corner.write_scene(tmp_path_factory.mktemp("corner"), corner.cameras(4, K))


@pytest.mark.parametrize(("gain", "bits"), [(0.34, 8), (0.08, 8), (0.02, 16)])
def test_dark_photographs_have_nearly_all_features(bright, tmp_path, gain, bits):
    import_or_skip("pycolmap")
    noise = 0.5 if bits == 8 else 0.02
    dark = write_dark_copy(bright, tmp_path / "dark", gain, noise=noise, bits=bits)
    counts = {}
    for folder in (bright, dark):
        work = tmp_path / f"{folder.name}-work"
        work.mkdir()
        features = extract_features(read_scene(folder), work, 2000, upsample=False)
        counts[folder] = np.array(list(count_features(features).values()))
        assert not (features / "stretched").exists()
    assert describe_stretched(features)
    assert (counts[dark] > 0.7 * counts[bright]).all()


@pytest.mark.parametrize("poses", ["given", "solve"])
def test_dark_photographs_yield_cameras_and_points_in_their_colours(bright, tmp_path, poses):
    import_or_skip("pycolmap")
    scene = read_scene(write_dark_copy(bright, tmp_path / "dark", 0.15))
    (tmp_path / "work").mkdir()
    settings = ColmapSfm(poses=poses, refine="none", upsample=False, features=2000)
    reconstruction = settings.reconstruct(scene, tmp_path / "work")
    check_text(next(note for note in reconstruction.notes if "contrast" in note))
    positions, _ = camera_errors(reconstruction.cameras, scene.cameras)
    assert len(positions) == 4
    assert positions.max() < 0.03
    assert np.median(corner.distances(reconstruction.cloud.points)) < 0.03
    assert len(reconstruction.cloud) > 80
    assert reconstruction.cloud.colors.max() <= 0.15 * 255 + 5


def test_two_images_are_enough(bright, tmp_path):
    import_or_skip("pycolmap")
    scene = read_scene(bright).select(["001.png", "002.png"])
    for poses in ("given", "solve"):
        (tmp_path / poses).mkdir()
        settings = ColmapSfm(poses=poses, refine="none", min_views=2, upsample=False)
        reconstruction = settings.reconstruct(scene, tmp_path / poses)
        assert len(reconstruction.cameras) == 2
        assert len(reconstruction.cloud) > 100
        if poses == "given":
            assert np.median(corner.distances(reconstruction.cloud.points)) < 0.03
