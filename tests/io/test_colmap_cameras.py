"""Cameras of COLMAP models in text: two lines an image, as COLMAP, other programs and editors write them."""

import numpy as np
import pytest
from optional import import_or_skip
from scene_folders import NAMES, orbit
from wording import check_error, check_text

from pcbench.io.colmap_model import read_colmap_cameras, write_colmap_model

CAMERAS = "1 PINHOLE 64 48 50 50 32 24\n"
SPACED = ["a b.png", "DJI 0001 (2).jpg", "d/e f g.png", "plain.png"]
KEYPOINTS = ["1.5 2.5 -1 3 4 7", "", "10 20 30", "1 2 -1 3 4 -1 5 6 -1 7 8 -1"]


def pose_lines(names=SPACED):
    return [f"{k} 0.5 0.5 0.5 0.5 {k} 0 1 1 {name}" for k, name in enumerate(names, 1)]


def two_lines(names=SPACED):
    return [line for pair in zip(pose_lines(names), KEYPOINTS, strict=True) for line in pair]


def model(folder, images, cameras=CAMERAS):
    (folder / "cameras.txt").write_text(cameras)
    (folder / "images.txt").write_bytes(images.encode() if isinstance(images, str) else images)
    return folder


def read(folder):
    notes = []
    return read_colmap_cameras(folder, notes.append), notes


LAYOUTS = {
    "keypoints": two_lines(),
    "one line": pose_lines(),
    "blank lines stripped": [line for line in two_lines() if line],
    "blank second lines": [line for pose in pose_lines() for line in (pose, "")],
    "doubled line breaks": [line for text in two_lines() for line in (text, "")],
    "comments": [line for text in two_lines() for line in ("# edited", text)],
    "trailing blanks": [f"{line}  " for line in two_lines()],
    "tabs": [f"\t{line}".replace(" ", "\t", 9) for line in pose_lines()],
}


@pytest.mark.parametrize("ending", ["\n", "\r\n"])
@pytest.mark.parametrize("layout", LAYOUTS)
def test_each_image_is_read(tmp_path, layout, ending):
    text = ending.join([*LAYOUTS[layout], ""])
    for start in ("", "\ufeff", f"# Number of images: 4, mean observations per image: 2{ending}"):
        cameras, notes = read(model(tmp_path, start + text))
        assert [camera.name for camera in cameras] == sorted(SPACED)
        by_name = {camera.name: camera.cam_from_world.translation[0] for camera in cameras}
        assert [by_name[name] for name in SPACED] == [1, 2, 3, 4]
        assert not notes


def test_names_of_digits_are_names(tmp_path):
    names = ["0001", "12 34 56", "1.5", "7 8 9 10"]
    assert [camera.name for camera in read(model(tmp_path, "\n".join([*two_lines(names), ""])))[0]] == sorted(names)


def test_empty_second_lines_before_names_of_digits(tmp_path):
    names = ["1 2 3", "2 2 3", "3 2 3"]
    text = "".join(f"{k} 1 0 0 0 0 0 {k} 1 {name}\n\n" for k, name in enumerate(names))
    assert [camera.name for camera in read(model(tmp_path, text))[0]] == names


def cut(text, after):
    return text[: text.index(after) + len(after)]


WHOLE = "\n".join([*two_lines(), ""])
HEADER = "# Number of images: 4, mean observations per image: 2\n"
DAMAGED = {
    "cut in a pose": cut(WHOLE, "3 0.5 0.5 0.5"),
    "cut in keypoints": cut(WHOLE, "10 20"),
    "fewer than stated": HEADER + cut(WHOLE, "10 20 30\n"),
    "cut in a name, stated": HEADER + cut(WHOLE, "(2).j"),
    "keypoints first": "1 2 3\n" + WHOLE,
    "twice keypoints": WHOLE + "1 2 3\n4 5 6\n",
    "other text": WHOLE + "this is no image\n",
    "missing camera": WHOLE.replace(" 1 plain", " 2 plain"),
    "not a rotation": WHOLE.replace("4 0.5 0.5", "4 0.5 0.9"),
    "nothing": "# no images\n",
}


@pytest.mark.parametrize("case", DAMAGED)
def test_damaged_images_are_refused(tmp_path, case):
    with check_error() as caught:
        read(model(tmp_path, DAMAGED[case]))
    assert str(caught.value).startswith(f"{tmp_path / 'images.txt'}: ")


@pytest.mark.parametrize("end", ["(2).j", "(2).jpg\n", "10 20 30"])
def test_a_file_that_may_be_cut_off_is_named(tmp_path, end):
    cameras, (note,) = read(model(tmp_path, cut(WHOLE, end)))
    assert len(cameras) == (3 if end == "10 20 30" else 2)
    check_text(note)


def test_damaged_cameras_are_refused(tmp_path):
    images = pose_lines()[0] + "\n"
    for cameras in (
        "1 PINHOLE 64 48 50 50 32\n",
        "1 PINHOLE 64\n",
        f"{CAMERAS}1 PINHOLE 64 48 60 60 32 24\n",
        f"# Number of cameras: 2\n{CAMERAS}",
        "1 FOV 64 48 50 50 32 24 0.1\n",
    ):
        with check_error():
            read(model(tmp_path, images, cameras))
    check_text(read(model(tmp_path, images, CAMERAS.strip()))[1][0])


def test_full_opencv_without_its_higher_terms_is_opencv(tmp_path):
    cameras = "1 FULL_OPENCV 64 48 50 51 32 24 0.1 0.02 0.003 0.004 0 0 0 0\n"
    intrinsics = read(model(tmp_path, pose_lines()[0] + "\n", cameras))[0][0].intrinsics
    assert intrinsics.distortion == (0.1, 0.02, 0.003, 0.004)


def test_models_that_pycolmap_writes(tmp_path):
    """Besides cameras, images and points there are rigs and frames."""
    pycolmap = import_or_skip("pycolmap")
    names = [*NAMES[:3], "a b.png", "12 34.png"]
    write_colmap_model(tmp_path, orbit(NAMES[:5]))
    reconstruction = pycolmap.Reconstruction(str(tmp_path))
    for number, name in enumerate(names, 1):
        reconstruction.image(number).name = name
    expected = {name: camera.position for name, camera in zip(names, orbit(NAMES[:5]), strict=True)}
    for kind, write in (("text", reconstruction.write_text), ("binary", reconstruction.write_binary)):
        (tmp_path / kind).mkdir()
        write(str(tmp_path / kind))
        cameras, notes = read(tmp_path / kind)
        assert [camera.name for camera in cameras] == sorted(names)
        assert not notes
        for camera in cameras:
            np.testing.assert_allclose(camera.position, expected[camera.name], atol=1e-9)  # the text has 17 digits
