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


def png_chunk(kind, data):
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def with_large_size(data):
    """The file is complete, but its header states 60000 x 60000 pixels."""
    header = struct.pack(">IIBBBBB", 60_000, 60_000, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + png_chunk(b"IHDR", header) + data[data.index(b"IDAT") - 4 :]


def flip_byte(data, index):
    return data[:index] + bytes([data[index] ^ 0xFF]) + data[index + 1 :]


DAMAGE = {
    "truncated": lambda data: data[: len(data) // 2],
    "too large (60000 x 60000 pixels, at most 600 million)": with_large_size,
    "unreadable (broken PNG file": lambda data: flip_byte(data, data.rindex(b"IEND") - 5),  # checksum of the pixels
    "unreadable": lambda data: flip_byte(data, data.index(b"IHDR") + 17),  # checksum of the header
}


@pytest.fixture
def photos(tmp_path):
    folder = tmp_path / "photos"
    folder.mkdir()
    for number, camera in enumerate(corner.cameras(5, corner.standard_intrinsics(160, 120))):
        pillow.fromarray(corner.photograph(camera)).save(folder / f"{number}.png")
    return folder


@pytest.mark.parametrize("reason", DAMAGE)
def test_unreadable_images_are_dropped_with_the_reason(photos, tmp_path, reason):
    (photos / "2.png").write_bytes(DAMAGE[reason]((photos / "2.png").read_bytes()))
    scene = read_scene(photos)
    for _ in range(2):  # decoded, and from the stored result
        readable_scene, (warning,) = drop_unreadable(scene, tmp_path)
        assert readable_scene.images == ("0.png", "1.png", "3.png", "4.png")
        assert warning.startswith("warning: 2.png ")
        assert reason in warning
        assert "\n" not in warning


def test_a_truncated_jpeg_is_dropped(photos, tmp_path):
    pillow.open(photos / "0.png").save(photos / "0.jpg")
    (photos / "0.png").unlink()
    data = (photos / "0.jpg").read_bytes()
    (photos / "0.jpg").write_bytes(data[: len(data) // 2])
    _, (warning,) = drop_unreadable(read_scene(photos), tmp_path)
    assert warning.startswith("warning: 0.jpg ")
    assert "truncated" in warning


def test_all_readable_images_are_used_and_too_few_are_refused(photos, tmp_path):
    scene = read_scene(photos)
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    assert drop_unreadable(scene, tmp_path / "a") == (scene, [])
    for number in range(4):
        (photos / f"{number}.png").write_bytes(DAMAGE["truncated"]((photos / f"{number}.png").read_bytes()))
    with pytest.raises(ReconstructionError, match="4 of 5 images"):  # Pillow says what is wrong
        drop_unreadable(read_scene(photos), tmp_path / "b")


def test_the_readable_images_are_reconstructed(photos, tmp_path):
    import_or_skip("pycolmap")
    (photos / "2.png").write_bytes(DAMAGE["unreadable"]((photos / "2.png").read_bytes()))
    result = run(ReconstructionJob("sfm", photos, {"features": "1000"}), tmp_path / "work")
    assert (result.status, result.message) == ("ok", "")
    reconstruction = result.require_reconstruction()
    assert set(reconstruction.cameras) <= {"0.png", "1.png", "3.png", "4.png"}
    assert any("2.png" in note and "unreadable" in note for note in reconstruction.notes)
