"""`info` and `convert` accept every format that `compare` accepts; small examples of each."""

import json
import re
import struct

import e57_bytes
import ept_bytes
import height_grid_files
import mesh_bytes
import numpy as np
import ptx_bytes
import pytest
import splat_bytes
import splat_models
from command_line import is_one_line
from las_bytes import las
from optional import import_or_skip
from wording import check_text

from pcbench import Cloud, read_cloud, write_cloud
from pcbench.io.formats import CLOUDS, MESHES

POINTS = np.random.default_rng(0).uniform(0, 9, (20, 3)).round(3)
CUBE_VERTICES = 8
EXTRAS = {".laz": "lazrs", ".glb": "trimesh", ".gltf": "trimesh", ".e57": "pye57"}
EXTRAS |= dict.fromkeys((".tif", ".tiff"), "tifffile")


def make_gltf():
    """Return the same cubes as text: the second chunk of the binary file is embedded in the document."""
    import base64

    data = mesh_bytes.glb()
    length = struct.unpack_from("<I", data, 12)[0]
    document = json.loads(data[20 : 20 + length])
    body = base64.b64encode(data[28 + length :]).decode()
    document["buffers"][0]["uri"] = f"data:application/octet-stream;base64,{body}"
    return json.dumps(document).encode()


def make_colmap_text():
    rows = [" ".join(map(str, [k, *point, 1, 2, 3, 0.5])) for k, point in enumerate(POINTS.tolist(), 1)]
    return "".join(f"{row}\n" for row in rows).encode()


def make_colmap_binary():
    rows = [struct.pack("<Q3d3BdQ", k, *point, 1, 2, 3, 0.5, 0) for k, point in enumerate(POINTS.tolist(), 1)]
    return struct.pack("<Q", len(rows)) + b"".join(rows)


# Formats that pcbench does not write: the bytes of a file and its number of points or vertices.
UNWRITABLE_FORMATS = {
    ".bin": (np.column_stack([POINTS, POINTS[:, 0]]).astype("<f4").tobytes(), 20),
    ".ksplat": (None, 9),
    ".ptx": (ptx_bytes.scan([(*point, 0.5) for point in POINTS.tolist()]).encode(), 20),
    ".splat": (splat_bytes.SPLAT_ROW * 20, 20),
    ".spz": (splat_bytes.packed_spz(3), 2),
    ".tif": (None, 16),
    ".tiff": (None, 16),
    **dict.fromkeys((".xyzi", ".xyzn", ".xyzrgb"), (b"1 2 3\n" * 20, 20)),
    ".pts": (b"20\n" + "\n".join(" ".join(map(str, p)) for p in POINTS.tolist()).encode(), 20),
    ".stl": (mesh_bytes.stl(), CUBE_VERTICES),
    ".obj": (mesh_bytes.obj(), CUBE_VERTICES),
    ".off": (mesh_bytes.off(), CUBE_VERTICES),
    ".glb": (mesh_bytes.glb(), 2 * CUBE_VERTICES),
    ".gltf": (make_gltf(), 2 * CUBE_VERTICES),
    "points3D.bin": (make_colmap_binary(), 20),
    "points3D.txt": (make_colmap_text(), 20),
    "mesh.ply": (mesh_bytes.ply_mesh(), CUBE_VERTICES),
    "tile.copc.laz": (None, 12),
    "ept.json": (None, 60),
}
ALL_FORMATS = sorted({*CLOUDS, *MESHES, *UNWRITABLE_FORMATS})


@pytest.fixture
def example(request, tmp_path, monkeypatch):
    """Write a file of the format to the current folder; return it and its number of points or vertices."""
    monkeypatch.chdir(tmp_path)
    extension = request.param
    if library := EXTRAS.get(extension if extension.startswith(".") else f".{extension.rpartition('.')[2]}"):
        import_or_skip(library)
    file = tmp_path / (f"a{extension}" if extension.startswith(".") else extension)
    if extension == "tile.copc.laz":
        file.write_bytes(las(7, 12, compress="variable"))
    elif extension == "ept.json":
        ept_bytes.write(tmp_path, 60, "binary")
    elif extension in (".tif", ".tiff"):
        height_grid_files.write_tif(file, np.arange(16.0).reshape(4, 4))
    elif extension == ".ksplat":
        file.write_bytes(splat_bytes.ksplat(0, splats=9))
    elif extension == ".e57":
        e57_bytes.write(file, [dict(zip(e57_bytes.XYZ, POINTS.T, strict=True))])
    elif extension in UNWRITABLE_FORMATS:
        file.write_bytes(UNWRITABLE_FORMATS[extension][0])
    else:
        write_cloud(file, Cloud(POINTS))
    return file, UNWRITABLE_FORMATS.get(extension, (None, len(POINTS)))[1]


@pytest.mark.parametrize(
    "example",
    [pytest.param(each, marks=pytest.mark.long) if each == ".gltf" else each for each in ALL_FORMATS],  # as .glb
    indirect=True,
)
def test_info_and_convert(example, run):
    file, count = example
    code, out, err = run("info", file.name)
    assert (code, err) == (0, "")
    noun = "vertices" if count % CUBE_VERTICES == 0 else "points"
    assert out.startswith(f"{file.name}: {count} {noun}\n")
    assert (re.search("^  mesh ", out, re.MULTILINE) is not None) == (noun == "vertices")
    code, out, err = run("convert", file.name, "out.xyz")
    assert (code, out) == (0, f"out.xyz: {count} points\n")
    is_grid = file.suffix in (".tif", ".tiff")  # its cells are points without a warning
    assert ("vertices of a mesh, not its surface" in err) if noun == "vertices" and not is_grid else not err
    assert len(read_cloud("out.xyz")) == count


def test_a_colmap_model_is_read_by_its_folder(tmp_path, run):
    (tmp_path / "sparse/0").mkdir(parents=True)
    (tmp_path / "sparse/0/points3D.bin").write_bytes(make_colmap_binary())
    assert run("info", str(tmp_path))[1].startswith(f"{tmp_path}: 20 points\n")
    code, out, _ = run("convert", str(tmp_path), str(tmp_path / "out.ply"))
    assert (code, out) == (0, f"{tmp_path}/out.ply: 20 points\n")


def test_points_are_sampled_on_a_mesh(tmp_path, run, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "cube.stl").write_bytes(mesh_bytes.stl())
    code, out, _ = run("convert", "cube.stl", "drawn.ply", "--sample", "500")
    assert (code, out) == (0, "drawn.ply: 500 points\n")
    samples = read_cloud("drawn.ply")
    on_a_face = np.isclose(np.abs(samples.points), np.abs(samples.points).max(), atol=1e-9).any(axis=1)
    assert on_a_face.all()
    np.testing.assert_allclose(np.linalg.norm(samples.normals, axis=1), 1, atol=1e-6)
    assert "12 faces of area 24" in check_text(run("info", "cube.stl")[1])
    write_cloud("cloud.ply", POINTS)
    for arguments in (("cloud.ply", "b.ply", "--sample", "9"), ("cube.stl", "b.ply", "--classes", "2")):
        code, _, err = run("convert", *arguments)
        assert code == 2
        assert is_one_line(err)
        check_text(err)


def test_damaged_faces_still_give_the_points(tmp_path, run, monkeypatch):
    monkeypatch.chdir(tmp_path)
    head = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
    rows = "element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n0 1 0\n3 0 1 7\n"
    (tmp_path / "a.ply").write_text(head + rows)
    code, out, err = run("info", "a.ply")
    assert code == 0
    assert out.startswith("a.ply: 3 points\n")
    assert "7" in check_text(err)


@pytest.mark.parametrize("dimensions", [3, 2])
def test_splats_are_reported_and_filtered(tmp_path, run, monkeypatch, dimensions):
    monkeypatch.chdir(tmp_path)
    write_cloud("splats.ply", splat_models.make_gaussians(5, dimensions))
    code, out, _ = run("info", "splats.ply")
    assert code == 0
    check_text(out)
    axes = {3: "0.03 to 0.15, median 0.09", 2: "0.02 to 0.1, median 0.06"}[dimensions]
    for value in (f"{dimensions}D ", "5 splats", "degree 3", "0.1 to 0.9, median 0.5", axes):
        assert value in out
    assert "f_rest" not in out
    code, out, _ = run("convert", "splats.ply", "opaque.ply", "--min-opacity", "0.6")
    assert (code, out) == (0, "opaque.ply: 2 points\n")
    code, out, _ = run("convert", "splats.ply", "small.ply", "--max-axis", "0.065")
    assert (code, out) == (0, f"small.ply: {2 if dimensions == 3 else 3} points\n")
    code, _, err = run("convert", "splats.ply", "none.ply", "--min-opacity", "2")
    assert code == 2
    assert is_one_line(err)


def test_compare_filters_splats(files, run):
    points = read_cloud("a.ply").points
    opacities = np.where(np.arange(len(points)) < 500, 0.05, 0.9)
    write_cloud("splats.ply", splat_models.model(points, opacities, np.full((len(points), 3), 0.01)))
    code, out, _ = run("compare", "ref.ply", "splats.ply", "--min-opacity", "0.5", "--json", "-", "--register", "none")
    assert code == 0
    document = json.loads(out)
    assert document["candidates"][0]["points"] == 1000
    code, _, err = run("compare", "ref.ply", "a.ply", "--min-opacity", "0.5", "--register", "none")
    assert code == 2
    assert is_one_line(err)
    check_text(err)
