"""Images that cannot be decoded: each is named with the reason, and the others are used."""

import struct
import zlib

import pytest
import textured_corner as corner
from optional import import_or_skip

from pcbench.errors import ReconstructionError
from pcbench.plugins.run import ReconstructionJob, run
from pcbench.scenes import read_scene
from reconstructors.sfm.images import drop_unreadable

pillow = import_or_skip("PIL.Image")


def chunk(kind, data):
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def large(data):
    """The file is complete, but its header states 60000 x 60000 pixels."""
    header = struct.pack(">IIBBBBB", 60_000, 60_000, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + data[data.index(b"IDAT") - 4 :]


def flipped(data, place):
    return data[:place] + bytes([data[place] ^ 0xFF]) + data[place + 1 :]


DAMAGE = {
    "truncated": lambda data: data[: len(data) // 2],
    "too large (60000 x 60000 pixels, at most 600 million)": large,
    "unreadable (broken PNG file": lambda data: flipped(data, data.rindex(b"IEND") - 5),  # the pixels' check sum
    "unreadable": lambda data: flipped(data, data.index(b"IHDR") + 17),  # the header's
}


@pytest.fixture
def photos(tmp_path):
    folder = tmp_path / "photos"
    folder.mkdir()
    for number, camera in enumerate(corner.cameras(5, corner.standard_intrinsics(160, 120))):
        pillow.fromarray(corner.photograph(camera)).save(folder / f"{number}.png")
    return folder


@pytest.mark.parametrize("what", DAMAGE)
def test_the_reason_is_reported(photos, tmp_path, what):
    (photos / "2.png").write_bytes(DAMAGE[what]((photos / "2.png").read_bytes()))
    scene = read_scene(photos)
    for _ in range(2):  # by looking, and from what was kept
        left, (warning,) = drop_unreadable(scene, tmp_path)
        assert left.images == ("0.png", "1.png", "3.png", "4.png")
        assert warning.startswith("warning: 2.png ")
        assert what in warning
        assert "\n" not in warning


def test_a_photograph_that_is_cut_off(photos, tmp_path):
    pillow.open(photos / "0.png").save(photos / "0.jpg")
    (photos / "0.png").unlink()
    whole = (photos / "0.jpg").read_bytes()
    (photos / "0.jpg").write_bytes(whole[: len(whole) // 2])
    _, (warning,) = drop_unreadable(read_scene(photos), tmp_path)
    assert warning.startswith("warning: 0.jpg ")
    assert "truncated" in warning


def test_whole_images_are_all_used_and_too_few_are_refused(photos, tmp_path):
    scene = read_scene(photos)
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    assert drop_unreadable(scene, tmp_path / "a") == (scene, [])
    for number in range(4):
        (photos / f"{number}.png").write_bytes(DAMAGE["truncated"]((photos / f"{number}.png").read_bytes()))
    with pytest.raises(ReconstructionError, match="4 of 5 images"):  # Pillow says what is wrong
        drop_unreadable(read_scene(photos), tmp_path / "b")


def test_the_others_are_reconstructed(photos, tmp_path):
    import_or_skip("pycolmap")
    (photos / "2.png").write_bytes(DAMAGE["unreadable"]((photos / "2.png").read_bytes()))
    result = run(ReconstructionJob("sfm", photos, {"features": "1000"}), tmp_path / "work")
    assert (result.status, result.message) == ("ok", "")
    made = result.require_reconstruction()
    assert set(made.cameras) <= {"0.png", "1.png", "3.png", "4.png"}
    assert any("2.png" in note and "unreadable" in note for note in made.notes)
