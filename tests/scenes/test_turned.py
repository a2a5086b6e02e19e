"""Photographs that EXIF turns or mirrors for display, with cameras of either form."""

import numpy as np
import pytest
from PIL import Image, ImageOps
from scene_folders import K, orbit
from wording import check_error, check_text

from pcbench.geometry.cameras import Intrinsics
from pcbench.io.colmap_model import write_colmap_model
from pcbench.io.image_header import read_image_header
from pcbench.scenes import read_scene

TURNED_K = Intrinsics(48, 64, 51.0, 50.0, 25.0, 31.0, (0.01, -0.02, 0.001, 0.002))
POINTS = np.random.default_rng(1).uniform(-0.5, 0.5, (20, 3))


def scene_folder(folder, orientation, intrinsics, size=(64, 48), extension="jpg"):
    names = [f"{k}.{extension}" for k in range(2)]
    (folder / "images").mkdir()
    for name in names:
        image = Image.new("RGB", size)
        exif = image.getexif()
        exif[0x0112] = orientation
        image.save(folder / "images" / name, exif=exif)
    cameras = orbit(names, intrinsics)
    write_colmap_model(folder / "sparse/0", cameras)
    notes = []
    return cameras, read_scene(folder, on_warning=notes.append), notes


def stored_pixels(pixels, displayed_size, orientation):
    """Return where Pillow finds displayed pixels in the stored image, from a picture of its stored coordinates."""
    rows, columns = np.mgrid[0:48, 0:64]
    coordinates = []
    for values in (columns, rows):
        image = Image.fromarray(values.astype(np.uint8))
        image.getexif()[0x0112] = orientation
        coordinates.append(np.asarray(ImageOps.exif_transpose(image), dtype=float) + 0.5)
    column, row = np.floor(pixels).astype(int).T
    assert coordinates[0].shape[::-1] == displayed_size
    return np.column_stack([values[row, column] for values in coordinates])


@pytest.mark.parametrize("extension", ["jpg", "png"])
@pytest.mark.parametrize("orientation", [6, 8])
def test_cameras_of_turned_photographs_are_turned_to_the_stored_pixels(tmp_path, orientation, extension):
    given, scene, notes = scene_folder(tmp_path, orientation, TURNED_K, extension=extension)
    for camera in given:
        pixels, depths = camera.project(POINTS)
        inside = ((pixels > 0) & (pixels < (48, 64))).all(axis=1)
        assert inside.sum() > 10
        found, found_depths = scene.cameras[camera.name].project(POINTS)
        np.testing.assert_allclose(found_depths, depths, rtol=1e-12)
        # Pillow's pixels are whole: the positions agree within half a pixel.
        expected = stored_pixels(pixels[inside], (48, 64), orientation)
        assert np.abs(found[inside] - expected).max() <= 0.5 + 1e-9
        np.testing.assert_allclose(scene.cameras[camera.name].position, camera.position, atol=1e-12)
    check_text(notes)


@pytest.mark.parametrize("orientation", [1, 6, 8])
def test_cameras_of_stored_pixels_are_kept(tmp_path, orientation):
    given, scene, notes = scene_folder(tmp_path, orientation, K)
    assert [scene.cameras[camera.name].intrinsics for camera in given] == [K, K]
    assert not notes


@pytest.mark.parametrize(("orientation", "size"), [(3, (64, 48)), (2, (64, 48)), (6, (48, 48))])
def test_sizes_that_cannot_tell_are_said(tmp_path, orientation, size):
    k = Intrinsics(*size, 50, 50, 24, 24)
    given, scene, notes = scene_folder(tmp_path, orientation, k, size)
    assert scene.cameras[given[0].name].intrinsics == k
    check_text(notes)


@pytest.mark.parametrize("orientation", [1, 5, 7])
def test_turned_photographs_without_a_remedy_are_refused_with_the_cause(tmp_path, orientation):
    with check_error():
        scene_folder(tmp_path, orientation, TURNED_K)


def test_a_damaged_orientation_is_none(tmp_path):
    scene_folder(tmp_path, 6, K)
    path = tmp_path / "images/0.jpg"
    data = path.read_bytes()
    assert read_image_header(path).orientation == 6
    for value in (0, 9):
        tag = data.index(b"\x01\x12\x00\x03")
        path.write_bytes(data[: tag + 8] + bytes([0, value]) + data[tag + 10 :])
        assert read_image_header(path).orientation == 1
