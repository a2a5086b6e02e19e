"""Points of glTF: clouds, vertices of meshes, colours, nodes, and damage."""

import base64
import json
import struct

import numpy as np
import pytest
import shapes
from mesh_bytes import VERTICES, glb, glb_parts, gltf_bytes
from refusals import refusal
from wording import check_text

from pcbench import read_cloud
from pcbench.io import gltf_points
from pcbench.io.source import Source

POINTS = np.array([[0, 0, 0.5], [1, 0, 0.25], [2.5, 0.125, 0]])
COLORS = np.array([[255, 0, 128], [1, 2, 3], [10, 20, 30]])
CODES = {"<f4": 5126, "|u1": 5121, "<u2": 5123, "<i2": 5122}


def cloud_glb(arrays, *, mode=0, indices=None, nodes=({"mesh": 0},), changes=(), **more):
    """Return a .glb file of one part with attributes by name: (values, type, whether they are normalised)."""
    body, accessors, views, attributes = b"", [], [], {}
    columns = dict(arrays) | ({} if indices is None else {"indices": (np.array(indices)[:, None], "<u2", False)})
    for name, (values, code, normalized) in columns.items():
        data = np.asarray(values).astype(code)
        # Rows start at multiples of four bytes.
        stride = -(-data.shape[1] * data.itemsize // 4) * 4
        rows = np.zeros((len(data), stride), np.uint8)
        rows[:, : data.shape[1] * data.itemsize] = np.ascontiguousarray(data).view(np.uint8)
        views.append({"buffer": 0, "byteOffset": len(body), "byteLength": rows.size, "byteStride": stride})
        kind = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}[data.shape[1]]
        accessors.append({"bufferView": len(views) - 1, "componentType": CODES[code], "count": len(data), "type": kind})
        accessors[-1] |= {"normalized": True} if normalized else {}
        body += rows.tobytes()
        if name != "indices":
            attributes[name] = len(accessors) - 1
    primitive = {"attributes": attributes, "mode": mode} | ({} if indices is None else {"indices": len(accessors) - 1})
    document = {"asset": {"version": "2.0"}, "scenes": [{"nodes": [0]}], "nodes": list(nodes)}
    document |= {"meshes": [{"primitives": [primitive]}], "accessors": accessors, "bufferViews": views, **more}
    for place, value in changes:
        target = document
        for key in place[:-1]:
            target = target[key]
        target[place[-1]] = value
    return gltf_bytes(document, body)


XYZ = {"POSITION": (POINTS, "<f4", False)}
STORED_COLORS = {
    "bytes": (COLORS, "|u1", True),
    "bytes and alpha": (np.column_stack([COLORS, [255, 0, 7]]), "|u1", True),
    "16 bits": (COLORS * 257, "<u2", True),
    "floats": (COLORS / 255, "<f4", False),
}


@pytest.mark.parametrize("name", STORED_COLORS)
def test_colours(tmp_path, name):
    (tmp_path / "a.glb").write_bytes(cloud_glb(XYZ | {"COLOR_0": STORED_COLORS[name]}))
    cloud = read_cloud(tmp_path / "a.glb")
    assert Source.open(tmp_path / "a.glb").kind == "cloud"
    assert (cloud.points.tolist(), cloud.colors.tolist(), cloud.unit) == (POINTS.tolist(), COLORS.tolist(), "m")


def test_nodes_move_points_and_normals(tmp_path):
    half = np.sqrt(0.5)
    nodes = [
        {"children": [1], "matrix": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 10, 20, 30, 1]},
        {"mesh": 0, "rotation": [0, 0, half, half], "scale": [2, 2, 4], "translation": [1, 0, 0]},
    ]
    normals = {"NORMAL": (np.eye(3), "<f4", False)}
    (tmp_path / "a.glb").write_bytes(cloud_glb(XYZ | normals, nodes=nodes))
    cloud = read_cloud(tmp_path / "a.glb")
    x, y, z = POINTS.T
    np.testing.assert_allclose(cloud.points, np.column_stack([11 - 2 * y, 20 + 2 * x, 30 + 4 * z]), atol=1e-12)
    directions = cloud.normals / np.linalg.norm(cloud.normals, axis=1, keepdims=True)
    np.testing.assert_allclose(directions, [[0, 1, 0], [-1, 0, 0], [0, 0, 1]], atol=1e-12)


def test_a_node_turns_points_about_any_axis(tmp_path):
    axis, angle_deg = np.array([0.36, -0.48, 0.8]), 70
    quaternion = [*np.sin(np.deg2rad(angle_deg / 2)) * axis, np.cos(np.deg2rad(angle_deg / 2))]
    (tmp_path / "a.glb").write_bytes(cloud_glb(XYZ, nodes=[{"mesh": 0, "rotation": quaternion}]))
    expected = POINTS @ shapes.rotation(axis, angle_deg).T
    np.testing.assert_allclose(read_cloud(tmp_path / "a.glb").points, expected, atol=1e-12)


def test_points_with_an_index_and_whole_numbers(tmp_path):
    stored = {"POSITION": (np.array([[32767, 0, -32767], [0, 1, 2], [3, 4, 5]]), "<i2", True)}
    (tmp_path / "a.glb").write_bytes(cloud_glb(stored, indices=[0, 2]))
    np.testing.assert_allclose(read_cloud(tmp_path / "a.glb").points * 32767, [[32767, 0, -32767], [3, 4, 5]])


def test_text_files_and_their_buffers(tmp_path):
    data = cloud_glb(XYZ)
    length = struct.unpack_from("<I", data, 12)[0]
    document, body = json.loads(data[20 : 20 + length]), data[28 + length :]
    for uri in ("my points.bin", "data:application/octet-stream;base64," + base64.b64encode(body).decode()):
        document["buffers"][0]["uri"] = uri.replace(" ", "%20")
        (tmp_path / "my points.bin").write_bytes(body)
        (tmp_path / "a.gltf").write_text(json.dumps(document))
        np.testing.assert_array_equal(read_cloud(tmp_path / "a.gltf").points, POINTS)


def test_vertices_of_meshes_need_no_library(tmp_path):
    (tmp_path / "a.glb").write_bytes(glb())
    notes = []
    cloud = read_cloud(tmp_path / "a.glb", on_warning=notes.append)
    expected = np.unique(np.concatenate([VERTICES, 2 * VERTICES + [10, 0, 0]]), axis=0)
    np.testing.assert_array_equal(cloud.points, expected)
    check_text("\n".join(notes))


def test_lines_beside_points(tmp_path):
    (tmp_path / "a.glb").write_bytes(glb_parts((0, POINTS, None), (1, POINTS, None)))
    with pytest.warns(UserWarning, match="left out 1 parts, which are lines"):
        assert len(read_cloud(tmp_path / "a.glb")) == 3


DAMAGED = {
    "2^31 points": cloud_glb(XYZ, changes=[(("accessors", 0, "count"), 2**31)]),
    "negative": cloud_glb(XYZ, changes=[(("accessors", 0, "count"), -1)]),
    "no points": cloud_glb(XYZ, changes=[(("accessors", 0, "count"), 0)]),
    "offset": cloud_glb(XYZ, changes=[(("accessors", 0, "byteOffset"), 2**40)]),
    "view": cloud_glb(XYZ, changes=[(("bufferViews", 0, "byteLength"), 2**40)]),
    "stride": cloud_glb(XYZ, changes=[(("bufferViews", 0, "byteStride"), 4)]),
    "buffer": cloud_glb(XYZ, changes=[(("bufferViews", 0, "buffer"), 7)]),
    "type": cloud_glb(XYZ, changes=[(("accessors", 0, "type"), ["VEC3"])]),
    "component": cloud_glb(XYZ, changes=[(("accessors", 0, "componentType"), [])]),
    "sparse": cloud_glb(XYZ, changes=[(("accessors", 0, "sparse"), {})]),
    "no view": cloud_glb(XYZ, changes=[(("accessors", 0), {"count": 9, "type": "VEC3", "componentType": 5126})]),
    "accessor": cloud_glb(XYZ, changes=[(("accessors",), [])]),
    "no position": cloud_glb(XYZ, changes=[(("meshes", 0, "primitives", 0, "attributes"), {})]),
    "mode": cloud_glb(XYZ, changes=[(("meshes", 0, "primitives", 0, "mode"), [0])]),
    "cycle": cloud_glb(XYZ, nodes=[{"mesh": 0, "children": [0]}]),
    "node": cloud_glb(XYZ, nodes=[{"children": [5]}]),
    "rotation": cloud_glb(XYZ, nodes=[{"mesh": 0, "rotation": [1, 2]}]),
    "matrix": cloud_glb(XYZ, nodes=[{"mesh": 0, "matrix": ["a"] * 16}]),
    "empty scene": cloud_glb(XYZ, scenes=[{"nodes": []}]),
    "fewer colours": cloud_glb(XYZ | {"COLOR_0": (COLORS[:2], "|u1", True)}),
    "index": cloud_glb(XYZ, indices=[0, 9]),
    "lines alone": cloud_glb(XYZ, mode=1),
    "splats": cloud_glb(XYZ, extensionsUsed=["KHR_gaussian_splatting"]),
    "meshopt": cloud_glb(XYZ, extensionsRequired=["EXT_meshopt_compression"]),
    "repeated": cloud_glb(
        {"POSITION": (np.zeros((9000, 3)), "<f4", False)},
        meshes=[{"primitives": [{"attributes": {"POSITION": 0}, "mode": 0}] * 2000}],
    ),
    "list": gltf_bytes({"meshes": 1, "nodes": {}}, b""),
}


@pytest.mark.parametrize("name", DAMAGED)
def test_damaged_points(tmp_path, name):
    refusal(tmp_path / "a.glb", DAMAGED[name])


def test_a_file_without_nodes_shows_all_meshes(tmp_path):
    (tmp_path / "a.glb").write_bytes(glb_parts((0, POINTS, None), nodes=[]))
    assert len(read_cloud(tmp_path / "a.glb")) == 3


def test_a_file_that_is_named_often_is_read_once(tmp_path, monkeypatch):
    names = []
    monkeypatch.setattr(gltf_points, "read_bytes", lambda path, limit: names.append(path.name) or path.read_bytes())
    (tmp_path / "a.bin").write_bytes(POINTS.astype("<f4").tobytes())
    document = {
        "asset": {"version": "2.0"},
        "buffers": [{"uri": uri, "byteLength": 36} for uri in ("a.bin", "./a.bin", "%61.bin")],
        "bufferViews": [{"buffer": 2, "byteLength": 36}],
        "accessors": [{"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "mode": 0}]}],
    }
    (tmp_path / "a.gltf").write_text(json.dumps(document))
    assert read_cloud(tmp_path / "a.gltf").points.tolist() == POINTS.tolist() and names == ["a.bin"]
