"""Intrinsics from K.txt: for the image size, for larger images, and invalid ones."""

import numpy as np
import pytest
from data_folder import data_folder
from optional import import_or_skip
from scene_folders import NAMES, orbit
from wording import check_error, check_text

from pcbench.io.colmap_model import write_colmap_model
from pcbench.scenes import read_scene

K_TEXT = "50 0 31\n0 51 25\n0 0 1\n"  # for images of 64 x 48 pixels


def read_with_k(folder, text, **options):
    notes = []
    (folder / "K.txt").write_text(text)
    return read_scene(folder, on_warning=notes.append, **options), notes


@pytest.mark.parametrize("in_image_folder", [True, False])
def test_k_for_the_image_size(photographs, in_image_folder):
    scene, notes = read_with_k(photographs / "images" if in_image_folder else photographs, K_TEXT)
    if in_image_folder:
        scene = read_scene(photographs, on_warning=notes.append)
    assert notes == []
    assert list(scene.intrinsics) == NAMES
    k = scene.intrinsics["3.png"]
    assert (k.width, k.height, k.fx, k.fy, k.cx, k.cy) == (64, 48, 50, 51, 31, 25)
    check_text(scene.describe()[2])
    assert list(scene.select(["1.png"]).intrinsics) == ["1.png"]


@pytest.mark.parametrize("factor", [2, 3, 4, 8])
def test_k_for_larger_images_is_scaled(photographs, factor):
    text = f"{50 * factor} 0 {31 * factor}\n0 {51 * factor} {25 * factor}\n0 0 1"
    scene, notes = read_with_k(photographs, text, image_scale=0.5)
    k = scene.intrinsics["3.png"]
    assert (k.width, k.height) == (32, 24)
    assert (k.fx, k.fy, k.cx, k.cy) == pytest.approx((25, 25.5, 15.5, 12.5), rel=1e-12)
    assert len(notes) == 1
    assert f"{64 * factor} x {48 * factor}" in notes[0]
    check_text(notes[0])


def test_cameras_take_precedence(photographs):
    write_colmap_model(photographs / "sparse", orbit(NAMES)[:4])
    scene, _ = read_with_k(photographs, K_TEXT)
    assert list(scene.cameras) == NAMES[:4]
    assert list(scene.intrinsics) == NAMES[4:]


def test_intrinsics_change_the_fingerprint(photographs):
    scene = read_scene(photographs)
    scene_with_intrinsics, _ = read_with_k(photographs, K_TEXT)
    assert scene_with_intrinsics.fingerprint() != scene.fingerprint()
    assert scene_with_intrinsics.fingerprint(cameras=False) == scene.fingerprint(cameras=False)


@pytest.mark.parametrize(
    "text",
    [
        "50 0 31 0 51 25 0 0",
        "50 0 31 0 51 25 0 0 nan",
        "fx 0 31 0 51 25 0 0 1",
        "50 1 31 0 51 25 0 0 1",
        "-50 0 31 0 51 25 0 0 1",
        "50 0 31 0 51 25 0 0 2",
        # The principal point is the centre of 93 x 50 pixels, which is another aspect ratio.
        "50 0 46 0 51 25 0 0 1",
        "0.8 0 0.5 0 0.8 0.5 0 0 1",
        "1 0 31 0 1 25 0 0 1",
    ],
)
def test_invalid_matrices_are_refused(photographs, text):
    with check_error() as caught:
        read_with_k(photographs, text)
    assert str(caught.value).startswith(f"{photographs / 'K.txt'}: ")


def test_scaled_k_matches_the_cameras_of_fountain():
    folder = data_folder("fountain")
    notes = []
    scene = read_scene(folder, cameras="none", on_warning=notes.append)
    posed_scene = read_scene(folder, on_warning=lambda _: None)
    assert posed_scene.intrinsics == {}
    assert list(scene.intrinsics) == list(posed_scene.cameras)
    for name, camera in posed_scene.cameras.items():
        np.testing.assert_allclose(scene.intrinsics[name].matrix, camera.intrinsics.matrix, rtol=1e-12)
    assert "3072 x 2048" in notes[0]


def test_sfm_starts_with_the_intrinsics(photographs):
    import_or_skip("pycolmap")
    from reconstructors.sfm.features import shared_intrinsics

    scene, _ = read_with_k(photographs, K_TEXT)
    (group,) = shared_intrinsics(scene)
    assert group.intrinsics == scene.intrinsics["0.png"]
    assert group.names == tuple(NAMES)
