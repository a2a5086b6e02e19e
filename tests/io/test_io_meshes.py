"""Mesh files of all formats, hand-made or written by trimesh; damaged files give a one-line error."""

import random
import re
import struct

import numpy as np
import pytest
from children_here import libraries_read_here
from mesh_bytes import CUBES, FACES, OBJ, STRIPS, VERTICES, ascii_stl, glb, glb_parts, obj, off, ply_mesh, stl
from mesh_shapes import icosphere
from optional import break_library, import_or_skip
from ply_bytes import XYZ, damage, ply
from wording import check_error, check_text

from pcbench import read_cloud
from pcbench.children import Limits, run_script
from pcbench.errors import InputError, MissingExtra, PcbenchError
from pcbench.io.meshes import read_mesh
from pcbench.io.source import Source


def check_cube(mesh):
    assert (len(mesh.vertices), len(mesh)) == (8, 12)
    assert mesh.is_closed
    assert mesh.area == 24
    centres = mesh.vertices[mesh.faces].mean(axis=1)
    assert (np.einsum("ni,ni->n", mesh.normals(), centres) == 1).all()


@pytest.mark.parametrize("name", CUBES)
def test_builtin_readers(tmp_path, name):
    path = tmp_path / name
    path.write_bytes(CUBES[name])
    mesh = read_mesh(path, on_warning=pytest.fail)
    check_cube(mesh)
    assert (mesh.crs, mesh.unit) == (("EPSG:32632", "m") if name.endswith("ply") else (None, None))
    assert Source.open(path).holds_mesh


@pytest.mark.parametrize("name", [name for name, data in CUBES.items() if data.isascii() and b"\0" not in data])
def test_line_ends_of_old_macs(tmp_path, name):
    path = tmp_path / name
    path.write_bytes(CUBES[name].replace(b"\n", b"\r"))
    assert Source.open(path).holds_mesh
    check_cube(read_mesh(path))


@pytest.fixture
def trimesh():
    """Let trimesh read files in this process; other tests show that the child process protects it."""
    with libraries_read_here():
        yield import_or_skip("trimesh")


@pytest.mark.usefixtures("trimesh")
def test_glb_scene(tmp_path):
    path = tmp_path / "a.glb"
    path.write_bytes(glb())
    mesh = read_mesh(path)
    assert (len(mesh.vertices), len(mesh), mesh.unit) == (16, 24, "m")
    assert mesh.is_closed
    assert mesh.area == 24 + 4 * 24
    np.testing.assert_array_equal(mesh.vertices.max(axis=0), [12, 2, 2])


@pytest.mark.filterwarnings("ignore:unclosed file:ResourceWarning")  # trimesh does not close its .gltf file
@pytest.mark.parametrize("extension", ["glb", "gltf", "off", "stl", "obj", "ply"])
def test_files_written_by_trimesh(tmp_path, trimesh, extension):
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
    with check_error(MissingExtra):
        read_mesh(path)


def test_polygons_become_fans_and_omissions_are_reported(tmp_path):
    path = tmp_path / "a.ply"
    path.write_bytes(ply_mesh(polygons=[(0, 1, 3, 2, 6), (1, 2), (), (4, 6, 7)]))
    notes = []
    mesh = read_mesh(path, on_warning=notes.append)
    np.testing.assert_array_equal(mesh.faces, [(0, 1, 3), (0, 3, 2), (0, 2, 6), (4, 6, 7)])
    assert notes == [f"{path}: left out 2 of 4 faces with fewer than three corners"]
    with pytest.warns(UserWarning) as caught:
        read_mesh(path)
    assert caught[0].filename == __file__
    path = tmp_path / "a.obj"
    path.write_bytes(obj() + b"l 1 2\np 1\n")
    notes.clear()
    check_cube(read_mesh(path, on_warning=notes.append))
    assert notes == [f"{path}: left out 2 point and line elements"]


def test_obj_coordinates_keep_their_digits_and_colors_do_not_matter(tmp_path):
    path = tmp_path / "a.obj"
    path.write_bytes(b"v 468012.123456 5428771.5 0 1 0 0\nv 468013 5428771 0 1 1 1\nf 1 2 3\nv 468012 5428772 1\n")
    np.testing.assert_array_equal(read_mesh(path).vertices[0], [468012.123456, 5428771.5, 0])


def test_holds_mesh(tmp_path):
    (tmp_path / "cloud.ply").write_bytes(ply("ascii", ("vertex", XYZ, [(0.0, 0.0, 0.0)])))
    (tmp_path / "none.ply").write_bytes(
        ply("ascii", ("vertex", XYZ, [(0.0, 0.0, 0.0)]), ("face", ["list uchar int a"], []))
    )
    header_parts = ply_mesh().partition(b"end_header\n")
    (tmp_path / "head.ply").write_bytes(header_parts[0] + header_parts[1])  # the body is not read
    (tmp_path / "damaged.ply").write_bytes(b"plyply")
    (tmp_path / "a.obj").write_bytes(obj())
    (tmp_path / "a.GLB").write_bytes(glb())
    for name in ("points.obj", "damaged.glb", "a.npy", "a"):
        (tmp_path / name).write_bytes(b"v 1 2 3\nv 4 5 6\n")
    expected = {"cloud.ply": False, "none.ply": False, "head.ply": True, "damaged.ply": False}
    expected |= {"a.obj": True, "points.obj": False, "a.GLB": True, "damaged.glb": False, "a.npy": False, "a": False}
    assert {name: Source.open(tmp_path / name).holds_mesh for name in expected} == expected


@pytest.mark.usefixtures("trimesh")
def test_modes_of_glb(tmp_path):
    """Strips, triangles without indices and triangles with them; lines and points are named."""
    path = tmp_path / "a.glb"
    sides, ends = np.array(STRIPS[0]), np.array([STRIPS[1][:4], STRIPS[1][5:]])
    parts = [(5, VERTICES, sides), (5, VERTICES[ends[0]], None), (5, VERTICES, ends[1])]
    path.write_bytes(glb_parts(*parts))
    check_cube(read_mesh(path, on_warning=pytest.fail))
    parts = [(None, VERTICES[FACES[:5]].reshape(-1, 3), None), (4, VERTICES, FACES[5:].ravel())]
    path.write_bytes(glb_parts(*parts, (1, VERTICES, [0, 1]), (0, VERTICES, None)))
    notes = []
    check_cube(read_mesh(path, on_warning=notes.append))
    check_text(*notes)


def test_concave_polygons_keep_their_area(tmp_path):
    """A star, an arrow and a comb, in planes of all three axes: fans of their first corners would overlap."""
    angles = np.arange(10) * np.pi / 5
    star = np.column_stack([np.cos(angles), np.sin(angles)]) * np.where(np.arange(10) % 2, 0.4, 1)[:, None]
    arrow = np.array([(1, 0.2), (2, 0), (1, 2), (0, 0)])
    comb = np.array([(0, 0), (5, 0), (5, 2), (4, 2), (4, 1), (3, 1), (3, 2), (2, 2), (2, 1), (1, 1), (1, 2), (0, 2)])
    for outline, area in ((star, 10 * 0.4 * np.sin(np.pi / 5) / 2), (arrow, 1.8), (comb, 8.0)):
        for shift, axes in ((0, (0, 1)), (3, (1, 2)), (5, (2, 0)), (1, (1, 0))):
            corners = np.zeros((len(outline), 3))
            corners[:, axes] = np.roll(outline, shift, axis=0)
            rows = "".join(f"v {x!r} {y!r} {z!r}\n" for x, y, z in corners.tolist())
            path = tmp_path / "a.obj"
            path.write_text(rows + "f " + " ".join(map(str, range(1, len(outline) + 1))))
            mesh = read_mesh(path)
            assert mesh.area == pytest.approx(area, rel=1e-12)
            assert len(np.unique(mesh.normals().round(12), axis=0)) == 1


@pytest.mark.usefixtures("trimesh")
def test_morph_targets_are_named(tmp_path):
    path, notes = tmp_path / "a.glb", []
    primitive = {"attributes": {"POSITION": 0}, "indices": 1, "targets": [{"POSITION": 0}]}
    path.write_bytes(glb_parts((4, VERTICES, FACES.ravel()), meshes=[{"primitives": [primitive], "weights": [1.0]}]))
    check_cube(read_mesh(path, on_warning=notes.append))
    check_text(*notes)


def test_surplus_bytes_after_stl(tmp_path):
    path = tmp_path / "a.stl"
    for head in (b"made by hand", b"solid but binary"):
        path.write_bytes(stl(head=head) + b"\0 made by hand")
        notes = []
        check_cube(read_mesh(path, on_warning=notes.append))
    check_text(*notes)


def test_a_mesh_is_not_a_cloud_without_a_word(tmp_path):
    (tmp_path / "a.obj").write_bytes(re.sub(rb"(v .*)", rb"\1 9 9 9", obj()))
    for name in ("ascii.ply", "strips.ply"):
        (tmp_path / name).write_bytes(CUBES[name])
    for name in ("ascii.ply", "strips.ply", "a.obj"):
        with pytest.warns(UserWarning) as caught:
            assert len(read_cloud(tmp_path / name)) == 8
        check_text(caught[0].message)
        source = Source.open(tmp_path / name)
        assert source.kind == "mesh" and len(source.read(pytest.fail)) == 12
        source = Source.open(tmp_path / name, vertices=True)
        assert source.kind == "cloud" and source.holds_mesh and len(source.read(pytest.fail)) == 8
        assert source.pieces().warnings == (str(caught[0].message),)
    assert source.read(pytest.fail).colors is not None
    cells = ("cell", ["list uchar int corners"], [((0, 1, 2),)])
    (tmp_path / "cells.ply").write_bytes(ply("ascii", ("vertex", XYZ, [(0.0, 0.0, 0.0)] * 3), cells))
    notes = []
    Source.open(tmp_path / "cells.ply").read(notes.append)
    check_text(*notes)
    grid = ("range_grid", ["list uchar int vertex_indices"], [((0,),), ((),)])
    (tmp_path / "scan.ply").write_bytes(ply("ascii", ("vertex", XYZ, [(0.0, 0.0, 0.0)]), grid))
    assert not Source.open(tmp_path / "scan.ply").holds_mesh
    (tmp_path / "a.off").write_bytes(off())
    with check_error():
        read_cloud(tmp_path / "a.off")


# ---- damage ----


def read_error(path):
    with pytest.raises(InputError) as caught:
        read_mesh(path, on_warning=lambda note: None)
    message = str(caught.value)
    assert message.startswith(f"{path}: ") and message.isprintable()
    return message.removeprefix(f"{path}: ")


ONE_VERTEX = ("vertex", XYZ, [(0.0, 0.0, 0.0)])
BINARY_PLY = ply_mesh("binary_little_endian")
REFUSED_FILES = {
    "a.xyz": b"1 2 3",
    "empty.stl": b"",
    "short.stl": b"abc",
    "cut.stl": stl()[:-130],
    "huge.stl": stl()[:80] + b"\xff" * 4 + stl()[84:],
    "no count.stl": stl()[:80] + bytes(4) + stl()[84:],
    "none.stl": stl(faces=FACES[:0]),
    "nan.stl": stl(VERTICES * np.nan),
    "cut ascii.stl": ascii_stl()[:-90],
    "gap.stl": ascii_stl().replace(b"endloop", b"", 1),
    "long word.stl": ascii_stl().replace(b"1.0", b"1" * 99),
    "no facets.stl": b"solid a\nendsolid a\n",
    "points.obj": OBJ.encode(),
    "zero.obj": OBJ.encode() + b"f 0 1 2\n",
    "high.obj": OBJ.encode() + b"f 1 2 9\n",
    "low.obj": OBJ.encode() + b"f -9 1 2\n",
    "words.obj": b"v 1 2\n",
    "overflow.obj": OBJ.encode() + b"f 1 2 " + b"9" * 30,
    "digits.obj": OBJ.encode() + b"f 1 2 " + b"9" * 5000,
    "curved.obj": OBJ.encode() + b"cstype bezier\ndeg 3 3\nsurf 0 1 0 1 1 2 3 4\nf 1 2 3\n",
    "patch.obj": OBJ.encode() + b"bzp 1 2 3 4\n",
    "strip.ply": ply("ascii", ONE_VERTEX, ("strip", ["list uchar int other"], [((0, 0, 0),)])),
    "grid.ply": ply("ascii", ONE_VERTEX, ("range_grid", ["list uchar int vertex_indices"], [((0,),)])),
    "fan.glb": glb_parts((6, VERTICES, [0, 1, 3, 2])),
    "normalized.glb": glb_parts((4, VERTICES, FACES.ravel()), accessors=[{"normalized": True}]),
    "points.glb": glb_parts((0, VERTICES, None)),
    "draco.glb": glb_parts((4, VERTICES, FACES.ravel()), extensionsRequired=["KHR_draco_mesh_compression"]),
    "instances.glb": glb_parts((4, VERTICES, FACES.ravel()), extensionsUsed=["EXT_mesh_gpu_instancing"]),
    "points.ply": ply("ascii", ("vertex", XYZ, [(0.0, 0.0, 0.0)])),
    "no faces.ply": ply_mesh(polygons=[]),
    "no faces binary.ply": ply_mesh("binary_big_endian", polygons=[]),
    "cut.ply": BINARY_PLY[:-30],
    "high.ply": ply_mesh(polygons=[(0, 1, 8)]),
    "low.ply": ply_mesh(polygons=[(0, 1, -1)]),
    "half.ply": ply_mesh(types="uchar float", polygons=[(0, 1, 2.5)]),
    "magic.off": b"ply\n",
    "comment.off": b"# OFF\n",
    "counts.off": b"OFF\nmany words\n",
    "points.off": b"OFF\n1 0 0\n0 0 0\n",
    "short words.off": off().replace(b"\n", b" ")[:-20],
    "huge.off": off().replace(b"8 12 0", b"8 999999999 0"),
    "cut.off": off()[:30],
    "short face.off": off()[:-3] + b"\n",
    "words.off": off().replace(b"8 12 0\n-1.0", b"8 12 0\none"),
    "binary.off": b"OFF BINARY\n" + bytes(40),
    "dimensions.off": b"nOFF\n4\n" + off()[4:],
    "no w.off": off().replace(b"OFF", b"4OFF"),
    "flat.off": b"OFF 1 1\n0 0\n3 0 0 0\n",
    "magic.glb": b"abc",
    "cut.glb": glb()[:-8],
    "chunk.glb": glb()[:12] + b"\xff" * 4 + glb()[16:],
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED_FILES)
def test_invalid_files_are_refused(tmp_path, name):
    path = tmp_path / name
    path.write_bytes(REFUSED_FILES[name])
    with check_error():
        read_mesh(path)


@pytest.mark.parametrize(
    ("name", "data", "expected"),
    [
        ("cut.gltf", b"{", "JSON"),
        ("deep.gltf", b"[" * 100_000, "JSON"),
        ("word.stl", ascii_stl().replace(b"vertex 1.0", b"vertex one"), "numbers"),
        ("word.ply", ply_mesh().replace(b"4 0 1 3 2", b"4 0 1 x 2"), "vertex indices"),
    ],
    ids=["cut.gltf", "deep.gltf", "word.stl", "word.ply"],
)
def test_damage_reported_by_libraries(tmp_path, name, data, expected):
    """The rest of the message comes from the library and depends on its version."""
    (tmp_path / name).write_bytes(data)
    assert expected in read_error(tmp_path / name)


def test_missing_file(tmp_path):
    for path in (tmp_path / "a.stl", tmp_path):
        with check_error():
            read_mesh(path)


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
def test_files_that_trimesh_refuses(tmp_path, name, data):
    path = tmp_path / name
    path.write_bytes(data)
    read_error(path)


def test_crash_hang_or_memory_growth_gives_a_one_line_error(tmp_path, monkeypatch):
    import_or_skip("trimesh")
    path = tmp_path / "a.glb"
    path.write_bytes(glb())
    child = tmp_path / "child.py"
    monkeypatch.setattr("pcbench.io.trimesh_child.__file__", str(child))
    cpu_limit = "import resource, sys\nresource.setrlimit(resource.RLIMIT_CPU, (1, 1))\n"
    for code in ("import os\nos.abort()", cpu_limit + "while True: pass", "raise ValueError('two\\nlines')"):
        child.write_text(code)
        with check_error():
            read_mesh(path)
    from pcbench.io import trimesh_child  # the actual worker, with little memory

    monkeypatch.undo()
    outputs = str(tmp_path / "v.npy"), str(tmp_path / "f.npy")
    result = run_script(trimesh_child.__file__, str(path), *outputs, limits=Limits(memory=60 << 20, cpu_seconds=9))
    assert result.code != 0


def check_damaged_glb(tmp_path, count, seed):
    import_or_skip("trimesh")
    rng = random.Random(seed)
    for _ in range(count):
        data = bytearray(damage(glb(), rng))
        data[8:12] = struct.pack("<I", len(data))  # passes the first check
        (tmp_path / "a.glb").write_bytes(data)
        try:
            read_mesh(tmp_path / "a.glb", on_warning=lambda note: None)
        except PcbenchError as error:
            assert str(error).startswith(f"{tmp_path / 'a.glb'}: ") and str(error).isprintable()


def test_damaged_glb(tmp_path):
    check_damaged_glb(tmp_path, 20, 1)  # a valid header starts a child process


@pytest.mark.slow
def test_many_damaged_glb(tmp_path):
    check_damaged_glb(tmp_path, 500, 2)
