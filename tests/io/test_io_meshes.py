"""Mesh files of every format, by hand or by trimesh; damaged ones are refused in one line."""

import random
import struct

import numpy as np
import pytest
from mesh_bytes import CUBES, FACES, OBJ, VERTICES, ascii_stl, glb, obj, off, ply_mesh, stl
from mesh_shapes import icosphere
from optional import break_library, import_or_skip
from ply_bytes import XYZ, damaged, ply
from wording import refused

from pcbench.children import Limits, run_script
from pcbench.errors import InputError, MissingExtra, PcbenchError
from pcbench.io.meshes import holds_mesh, read_mesh


def is_the_cube(mesh):
    assert (len(mesh.vertices), len(mesh)) == (8, 12)
    assert mesh.is_closed
    assert mesh.area == 24
    centres = mesh.vertices[mesh.faces].mean(axis=1)
    assert (np.einsum("ni,ni->n", mesh.normals(), centres) == 1).all()


@pytest.mark.parametrize("name", CUBES)
def test_own_readers(tmp_path, name):
    path = tmp_path / name
    path.write_bytes(CUBES[name])
    mesh = read_mesh(path, on_warning=pytest.fail)
    is_the_cube(mesh)
    assert (mesh.crs, mesh.unit) == (("EPSG:32632", "m") if name.endswith("ply") else (None, None))
    assert holds_mesh(path)


@pytest.fixture
def trimesh():
    return import_or_skip("trimesh")


@pytest.mark.usefixtures("trimesh")
def test_glb_scene(tmp_path):
    path = tmp_path / "a.glb"
    path.write_bytes(glb())
    mesh = read_mesh(path)
    assert (len(mesh.vertices), len(mesh), mesh.unit) == (16, 24, "m")
    assert mesh.is_closed
    assert mesh.area == 24 + 4 * 24
    np.testing.assert_array_equal(mesh.vertices.max(axis=0), [12, 2, 2])


@pytest.mark.parametrize("extension", ["glb", "gltf", "off", "stl", "obj", "ply"])
def test_what_trimesh_writes(tmp_path, trimesh, extension):
    vertices, faces = icosphere(2)
    path = tmp_path / f"a.{extension}"
    trimesh.Trimesh(vertices, faces, process=False).export(path)
    mesh = read_mesh(path)
    assert (len(mesh.vertices), len(mesh)) == (162, 320)
    assert mesh.is_closed
    assert mesh.area == pytest.approx(trimesh.Trimesh(vertices, faces).area, rel=1e-6)


def test_without_trimesh(tmp_path, monkeypatch):
    path = tmp_path / "a.glb"
    path.write_bytes(glb())
    break_library(monkeypatch, tmp_path / "packages", "trimesh", None)
    with refused(MissingExtra):
        read_mesh(path)


def test_polygons_become_fans_and_what_is_left_out_is_said(tmp_path):
    path = tmp_path / "a.ply"
    path.write_bytes(ply_mesh(polygons=[(0, 1, 3, 2, 6), (1, 2), (), (4, 6, 7)]))
    notes = []
    mesh = read_mesh(path, on_warning=notes.append)
    np.testing.assert_array_equal(mesh.faces, [(0, 1, 3), (0, 3, 2), (0, 2, 6), (4, 6, 7)])
    assert notes == [f"{path}: left out 2 of 4 faces with fewer than three corners"]
    with pytest.warns(UserWarning, match="left out 2 of 4") as caught:
        read_mesh(path)
    assert caught[0].filename == __file__
    path = tmp_path / "a.obj"
    path.write_bytes(obj() + b"l 1 2\np 1\n")
    notes.clear()
    is_the_cube(read_mesh(path, on_warning=notes.append))
    assert notes == [f"{path}: left out 2 points and lines"]


def test_obj_coordinates_keep_their_digits_and_colors_do_not_matter(tmp_path):
    path = tmp_path / "a.obj"
    path.write_bytes(b"v 468012.123456 5428771.5 0 1 0 0\nv 468013 5428771 0 1 1 1\nf 1 2 3\nv 468012 5428772 1\n")
    np.testing.assert_array_equal(read_mesh(path).vertices[0], [468012.123456, 5428771.5, 0])


def test_holds_mesh(tmp_path):
    (tmp_path / "cloud.ply").write_bytes(ply("ascii", ("vertex", XYZ, [(0.0, 0.0, 0.0)])))
    (tmp_path / "none.ply").write_bytes(
        ply("ascii", ("vertex", XYZ, [(0.0, 0.0, 0.0)]), ("face", ["list uchar int a"], []))
    )
    head = ply_mesh().partition(b"end_header\n")
    (tmp_path / "head.ply").write_bytes(head[0] + head[1])  # the body is not looked at
    (tmp_path / "damaged.ply").write_bytes(b"plyply")
    names = {"cloud.ply": False, "none.ply": False, "head.ply": True, "damaged.ply": False, "missing.ply": False}
    names |= {"a.obj": True, "a.GLB": True, "a.npy": False, "a": False}
    assert {name: holds_mesh(tmp_path / name) for name in names} == names


# ---- damage ----


def one_line(path):
    with pytest.raises(InputError) as caught:
        read_mesh(path, on_warning=lambda note: None)
    message = str(caught.value)
    assert message.startswith(f"{path}: ") and message.isprintable()
    return message.removeprefix(f"{path}: ")


PLY = ply_mesh("binary_little_endian")
REFUSED = {
    "a.xyz": (b"1 2 3", "expected a mesh file that ends in .stl, .obj, .ply, .glb, .gltf, .off; got '.xyz'"),
    "empty.stl": (b"", "expected a point cloud, got an empty file"),
    "short.stl": (b"abc", "expected an STL file: 84 bytes or more, or the word 'solid'; got 3 bytes"),
    "cut.stl": (stl()[:-130], "truncated: 9 of 12 triangles: copy or export the file again"),
    "huge.stl": (stl()[:80] + b"\xff" * 4 + stl()[84:], "truncated: 12 of 4294967295 triangles"),
    "long.stl": (stl() + b"abc", "expected 684 bytes for 12 triangles, got 687: header and body disagree"),
    "none.stl": (stl(faces=FACES[:0]), "expected a mesh with at least one face, got none"),
    "nan.stl": (stl(VERTICES * np.nan), "expected finite coordinates, got NaN or Inf in 36 of 36 vertices"),
    "cut ascii.stl": (ascii_stl()[:-90], "truncated: expected an ascii STL file to end with 'endsolid'"),
    "gap.stl": (ascii_stl().replace(b"endloop", b"", 1), "facet 0: expected 'facet normal x y z outer loop"),
    "word.stl": (ascii_stl().replace(b"vertex 1.0", b"vertex one"), "expected coordinates as numbers"),
    "long word.stl": (ascii_stl().replace(b"1.0", b"1" * 99), "expected words of at most 32 characters"),
    "no facets.stl": (b"solid a\nendsolid a\n", "expected a mesh with at least one face, got an STL file without"),
    "points.obj": (OBJ.encode(), "expected a mesh with at least one face, got none"),
    "zero.obj": (OBJ.encode() + b"f 0 1 2\n", "line 14: expected 'f a b c' with vertices 1 to 8, got 'f 0 1 2'"),
    "high.obj": (OBJ.encode() + b"f 1 2 9\n", "expected faces of the 8 vertices 0 to 7, got 8"),
    "low.obj": (OBJ.encode() + b"f -9 1 2\n", "line 14: expected 'f a b c' with vertices 1 to 8"),
    "words.obj": (b"v 1 2\n", "line 1: expected 'v x y z', got 'v 1 2'"),
    "overflow.obj": (OBJ.encode() + b"f 1 2 " + b"9" * 30, "line 14: expected 'f a b c'"),
    "digits.obj": (OBJ.encode() + b"f 1 2 " + b"9" * 5000, "line 14: expected 'f a b c'"),
    "points.ply": (ply("ascii", ("vertex", XYZ, [(0.0, 0.0, 0.0)])), "expected an element 'face' with a list vertex_"),
    "no faces.ply": (ply_mesh(polygons=[]), "expected a mesh with at least one face, got none"),
    "no faces binary.ply": (ply_mesh("binary_big_endian", polygons=[]), "expected a mesh with at least one face"),
    "cut.ply": (PLY[:-30], "truncated: 4 of 6 faces: copy or export the file again"),
    "high.ply": (ply_mesh(polygons=[(0, 1, 8)]), "expected faces of the 8 vertices 0 to 7, got 8"),
    "low.ply": (ply_mesh(polygons=[(0, 1, -1)]), "expected faces of the 8 vertices 0 to 7, got -1"),
    "half.ply": (ply_mesh(types="uchar float", polygons=[(0, 1, 2.5)]), "expected whole numbers of vertices in the"),
    "word.ply": (ply_mesh().replace(b"4 0 1 3 2", b"4 0 1 x 2"), "expected vertex numbers in the faces, got something"),
    "magic.off": (b"ply\n", "expected an OFF file that starts with 'OFF', got b'ply'"),
    "comment.off": (b"# OFF\n", "expected an OFF file, got an empty one"),
    "counts.off": (b"OFF\nmany words\n", "expected counts of vertices, faces and edges, got b'many words'"),
    "huge.off": (off().replace(b"8 12 0", b"8 999999999 0"), "truncated: 12 of 999999999 faces"),
    "cut.off": (off()[:30], "truncated: 2 of 8 vertices"),
    "long.off": (off() + b"3 0 1 2\n", "1 lines after the last face: header and body disagree"),
    "short face.off": (off()[:-3] + b"\n", "face 11: expected a count and as many vertices, got b'3 1 "),
    "words.off": (off().replace(b"8 12 0\n-1.0", b"8 12 0\none"), "vertex 0: expected x y z, got b'one "),
    "flat.off": (b"OFF 1 1\n0 0\n3 0 0 0\n", "vertex 0: expected x y z, got b'0 0'"),
    "magic.glb": (b"abc", "expected a binary glTF 2 file, got b'abc"),
    "cut.glb": (glb()[:-8], "truncated: "),
    "long.glb": (glb() + b"abc", "3 bytes too many"),
    "chunk.glb": (glb()[:12] + b"\xff" * 4 + glb()[16:], "truncated: the last chunk ends at byte "),
    "json.gltf": (b"{", "expected glTF, which is JSON: "),
    "deep.gltf": (b"[" * 100_000, "expected glTF, which is JSON: "),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_refusals(tmp_path, name):
    data, message = REFUSED[name]
    path = tmp_path / name
    path.write_bytes(data)
    assert one_line(path)[: len(message)] == message


def test_no_file(tmp_path):
    assert one_line(tmp_path / "a.stl") == "no such file: check the name and the folder"
    assert one_line(tmp_path) == "expected a file, got a folder: name the file inside it"


@pytest.mark.usefixtures("trimesh")
@pytest.mark.parametrize(
    ("name", "data"),
    {
        "count.glb": glb().replace(b'"count": 36', b'"count": 99'),
        "memory.glb": glb().replace(b'"name": "cube"', b'"a": "b"     ').replace(b'"count": 8,', b'"count":9e9'),
        "index.glb": glb()[:-4] + b"\xff" * 4,
        "nothing.gltf": b"{}",
        "list.gltf": b"[1, 2]",
        "no file.gltf": b'{"asset": {"version": "2.0"}, "buffers": [{"uri": "none.bin", "byteLength": 9}]}',
    }.items(),
)  # fmt: skip
def test_what_trimesh_refuses(tmp_path, name, data):
    path = tmp_path / name
    path.write_bytes(data)
    one_line(path)


@pytest.mark.usefixtures("trimesh")
def test_a_reader_that_crashes_hangs_or_grows_ends_in_one_line(tmp_path, monkeypatch):
    path = tmp_path / "a.glb"
    path.write_bytes(glb())
    child = tmp_path / "child.py"
    monkeypatch.setattr("pcbench.io.trimesh_child.__file__", str(child))
    limits = "import resource, sys\nresource.setrlimit(resource.RLIMIT_CPU, (1, 1))\n"
    for code, said in {
        "import os\nos.abort()": "it ended with -6",
        limits + "while True: pass": "it ended with -9",
        "raise ValueError('two\\nlines')": "lines",
    }.items():
        child.write_text(code)
        assert one_line(path) == f"trimesh cannot read it: {said}"
    from pcbench.io import trimesh_child  # the real one, with little memory

    monkeypatch.undo()
    outputs = str(tmp_path / "v.npy"), str(tmp_path / "f.npy")
    done = run_script(trimesh_child.__file__, str(path), *outputs, limits=Limits(memory=60 << 20, cpu_seconds=9))
    assert done.code != 0


def damaged_glb(tmp_path, count, seed):
    rng = random.Random(seed)
    for _ in range(count):
        data = bytearray(damaged(glb(), rng))
        data[8:12] = struct.pack("<I", len(data))  # past the first check
        (tmp_path / "a.glb").write_bytes(data)
        try:
            read_mesh(tmp_path / "a.glb", on_warning=lambda note: None)
        except PcbenchError as error:
            assert str(error).startswith(f"{tmp_path / 'a.glb'}: ") and str(error).isprintable()


@pytest.mark.usefixtures("trimesh")
def test_damaged_glb(tmp_path):
    damaged_glb(tmp_path, 20, 1)  # a process each where the header holds


@pytest.mark.slow
@pytest.mark.usefixtures("trimesh")
def test_damaged_glb_by_the_hundred(tmp_path):
    damaged_glb(tmp_path, 500, 2)
