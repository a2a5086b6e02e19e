"""Bytes after the last record of a file: padding and less than a record is left out, more records are refused."""

import io
import struct

import numpy as np
import pytest
from mesh_bytes import glb, off, ply_mesh, stl
from optional import import_or_skip
from pcd_bytes import XYZ as FIELDS
from pcd_bytes import pcd
from ply_bytes import XYZ, ply, points
from wording import check_error, check_text

from pcbench.io import read_cloud
from pcbench.io.colmap_model import read_colmap_cameras
from pcbench.io.meshes import read_mesh
from pcbench.io.pieces import open_cloud, read_piece


def npy():
    buffer = io.BytesIO()
    np.save(buffer, np.array(points(4)))
    return buffer.getvalue()


def vertices(form):
    return ply(form, ("vertex", XYZ, points(4)))


POINT = struct.pack("<Q3d3BdQ", 1, 1, 2, 3, 4, 5, 6, 0.5, 0)
CLOUDS = {  # file: its bytes, and a further record
    "binary.ply": (vertices("binary_little_endian"), struct.pack("<3f", 1, 2, 3)),
    "ascii.ply": (vertices("ascii"), b"1 2 3\n"),
    "binary.pcd": (pcd("binary", FIELDS, points(4)), bytes(range(12))),
    "ascii.pcd": (pcd("ascii", FIELDS, points(4)), b"1 2 3\n"),
    "compressed.pcd": (pcd("binary_compressed", FIELDS, points(4)), bytes(range(12))),
    "a.npy": (npy(), bytes(range(24))),
    "points3D.bin": (struct.pack("<Q", 4) + 4 * POINT, POINT),
}
MESHES = {
    "binary.ply": (ply_mesh("binary_little_endian"), bytes(range(99))),
    "ascii.ply": (ply_mesh(), b"7 2 1 2 3 0 1 2 0.5\n"),
    "a.off": (off(), b"3 0 1 2\n"),
    "a.glb": (glb(), bytes(range(12))),
    "a.stl": (stl(), None),
}
PADDING = {"text": b"abc", "padding": bytes(4096), "end of file": b"\x1a"}


@pytest.mark.parametrize("padding", PADDING)
@pytest.mark.parametrize("name", CLOUDS)
def test_less_than_a_point_is_left_out(tmp_path, name, padding):
    path, notes = tmp_path / name, []
    path.write_bytes(CLOUDS[name][0] + PADDING[padding])
    assert len(read_cloud(path, on_warning=notes.append)) == 4
    assert len(notes) == 1
    cloud = open_cloud(path)
    assert [len(read_piece(cloud, piece).points) for piece in cloud.pieces] == [4]
    assert [line for _, line in cloud.file_warnings] == [notes[0].removeprefix(f"{path}: ")]
    check_text(notes[0])


@pytest.mark.parametrize("name", CLOUDS)
def test_more_points_are_refused(tmp_path, name):
    path = tmp_path / name
    path.write_bytes(CLOUDS[name][0] + CLOUDS[name][1])
    with check_error():
        read_cloud(path)
    with check_error():
        open_cloud(path)


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.long) if name == "a.glb" else name for name in MESHES]
)
def test_bytes_after_a_mesh(tmp_path, name):
    if name == "a.glb":
        import_or_skip("trimesh")
    path, (data, record) = tmp_path / name, MESHES[name]
    for padding in PADDING.values():
        notes = []
        path.write_bytes(data + padding)
        assert len(read_mesh(path, on_warning=notes.append).faces) in (12, 24)
        assert len(notes) == 1
    check_text(notes[0])
    if record is not None:
        path.write_bytes(data + record)
        with check_error():
            read_mesh(path)


def test_bytes_after_cameras(tmp_path):
    camera = struct.pack("<iiQQ4d", 1, 1, 64, 48, 50, 50, 32, 24)
    image = struct.pack("<I7di", 1, 1, 0, 0, 0, 0, 0, 0, 1) + b"a b.png\0" + struct.pack("<Q", 0)
    whole = {"cameras.bin": struct.pack("<Q", 1) + camera, "images.bin": struct.pack("<Q", 1) + image}
    for name in whole:
        for other, data in whole.items():
            (tmp_path / other).write_bytes(data + (b"abc" if other == name else b""))
        notes = []
        assert len(read_colmap_cameras(tmp_path, notes.append)) == 1
        check_text(*notes)
        for other, data in whole.items():
            (tmp_path / other).write_bytes(data + (image if other == name else b""))
        with check_error():
            read_colmap_cameras(tmp_path)
