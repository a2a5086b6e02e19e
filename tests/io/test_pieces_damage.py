"""Damaged files of a cloud in pieces: the error names the file and the piece, and `skip_bad` leaves files out."""

import struct

import numpy as np
import ply_bytes
import pytest
from cloud_pieces import check_pieces
from las_bytes import las
from optional import import_or_skip
from wording import check_error, check_text

from pcbench.geometry.cloud import Cloud
from pcbench.io import las_header, laz, read_cloud, write_cloud
from pcbench.io.pieces import open_cloud, read_piece


@pytest.fixture
def large_laz(tmp_path):
    """A file of three chunks."""
    import_or_skip("lazrs")
    rng = np.random.default_rng(1)
    sources = {"point_source_id": rng.integers(0, 1 << 16, 120_000)}
    write_cloud(tmp_path / "a.laz", Cloud(rng.uniform(0, 50, (120_000, 3)), attributes=sources))
    return tmp_path / "a.laz"


def chunks_of(data):
    """Return the first byte of the points and the position of the chunk table."""
    start = struct.unpack_from("<I", data, 96)[0]
    return start, struct.unpack_from("<q", data, start)[0]


def read_all(path, **options):
    disk = open_cloud(path, **options)
    return [read_piece(disk, piece) for piece in disk.pieces]


TRUNCATED = {
    "a.las": (las(1, 50), -100),
    "header.las": (las(1, 50), 100),
    "a.ply": (ply_bytes.ply("binary_little_endian", ("vertex", ply_bytes.XYZ, ply_bytes.points(9))), -5),
    "header.ply": (ply_bytes.ply("ascii", ("vertex", ply_bytes.XYZ, ply_bytes.points(9))), 30),
    "a.xyz": (b"1 2 3\n4 5", None),
    "zero.las": (b"", None),
}


@pytest.mark.parametrize("name", TRUNCATED)
def test_truncated_files_are_found_when_opened(tmp_path, name):
    data, end = TRUNCATED[name]
    (tmp_path / name).write_bytes(data[:end])
    (tmp_path / "good.las").write_bytes(las(1, 50))
    for read in (read_cloud, open_cloud):
        with check_error():
            read(tmp_path)
    disk = open_cloud(tmp_path, skip_bad=True)
    assert [file.path.name for file in disk.left_out] == [name]
    assert disk.left_out[0].count == {"a.las": 50, "a.ply": 9}.get(name)
    assert disk.count == 50 == sum(len(points.points) for points in read_all(tmp_path, skip_bad=True))
    check_text(disk.left_out[0].reason)


def test_all_files_damaged(tmp_path):
    (tmp_path / "a.las").write_bytes(b"LASF")
    with check_error():
        open_cloud(tmp_path, skip_bad=True)


def test_truncated_laz(large_laz):
    data = large_laz.read_bytes()
    large_laz.write_bytes(data[:-1000])
    with check_error():
        open_cloud(large_laz)


def test_damaged_chunk_is_named_and_others_are_read(large_laz):
    data = bytearray(large_laz.read_bytes())
    start, _ = chunks_of(data)
    with large_laz.open("rb") as file:
        first, *_ = laz.read_chunks(file, las_header.read_header(file, lambda _: None))
    sizes = start + 8 + first.size + 30  # of the layers of the second chunk, after its first point
    data[sizes : sizes + 40] = b"\xff" * 40
    large_laz.write_bytes(data)
    disk = open_cloud(large_laz, piece_points=50_000)
    assert len(read_piece(disk, disk.pieces[0]).points) == 50_000
    with check_error():
        read_piece(disk, disk.pieces[1])
    assert len(read_piece(disk, disk.pieces[2]).points) == 20_000
    with check_error():
        read_cloud(large_laz)


def test_mutated_chunk_table(large_laz):
    data = large_laz.read_bytes()
    start, table = chunks_of(data)
    rng = np.random.default_rng(0)
    outcomes = set()
    for _ in range(200):
        changed = bytearray(data)
        changed[rng.integers(table, len(data))] = rng.integers(256)
        changed[rng.integers(start, start + 8)] ^= rng.integers(256) * (rng.random() < 0.2)
        large_laz.write_bytes(changed)
        try:
            disk = open_cloud(large_laz, piece_points=50_000)
        except ValueError as error:
            outcomes.add("refused")
            assert str(error).startswith(f"{large_laz}: ") and "\n" not in str(error)
        else:
            outcomes.add("opened")
            assert disk.count == 120_000 == sum(piece.count for piece in disk.pieces)
    assert outcomes == {"refused", "opened"}


def test_file_that_changes_after_opening(tmp_path):
    (tmp_path / "a.las").write_bytes(las(1, 50))
    (tmp_path / "a.ply").write_bytes(
        ply_bytes.ply("binary_little_endian", ("vertex", ply_bytes.XYZ, ply_bytes.points(50)))
    )
    disk = open_cloud(tmp_path, piece_points=20)
    for name in ("a.las", "a.ply"):
        (tmp_path / name).write_bytes((tmp_path / name).read_bytes()[:-50])
        with check_error():
            read_piece(disk, next(piece for piece in disk.pieces if piece.file.name == name))
    (tmp_path / "a.las").unlink()
    with check_error():
        read_piece(disk, disk.pieces[0])


def test_withheld_points_and_returns_are_counted_over_all_pieces(tmp_path):
    data = bytearray(las(6, 50))
    start = struct.unpack_from("<I", data, 96)[0]
    for i in range(0, 50, 3):
        data[start + 30 * i + 15] |= 4  # withheld
        data[start + 30 * i + 14] = 5 | 2 << 4  # return 5 of 2
    struct.pack_into("<15Q", data, 375 - 120, *([17] * 3), *([0] * 12))
    (tmp_path / "a.las").write_bytes(data)
    check_pieces(tmp_path / "a.las", 8)
    lines = []
    read_cloud(tmp_path / "a.las", on_warning=lines.append)
    assert len(lines) == 3
