"""Hand-made mesh files of a cube in all formats. Does not import pcbench."""

import json
import struct

import numpy as np
from mesh_shapes import cube
from ply_bytes import FORMATS, XYZ, ply

VERTICES, FACES = cube()
QUADS = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]


def stl(vertices=VERTICES, faces=FACES, head=b"made by hand"):
    rows = [struct.pack("<12fH", *[0.0] * 3, *vertices[face].ravel(), 0) for face in faces]
    return head.ljust(80, b"\0") + struct.pack("<I", len(faces)) + b"".join(rows)


def ascii_stl(vertices=VERTICES, faces=FACES):
    def facet(face):
        corners = "".join(f"      vertex {x} {y} {z}\n" for x, y, z in vertices[face])
        return f"  facet normal 0 0 1e0\n    outer loop\n{corners}    endloop\n  endfacet\n"

    return ("solid a cube of facet\n" + "".join(map(facet, faces)) + "endsolid a cube\n").encode()


OBJ = "# a cube\nmtllib a.mtl\no cube\n" + "".join(f"v {x} {y} {z}\n" for x, y, z in VERTICES) + "vn 0 0 1\nvt 0 0\n"


def obj(corner="{0}/1/1"):
    lines = ["f " + " ".join(corner.format(c + 1, c - len(VERTICES)) for c in quad) for quad in QUADS]
    return (OBJ + "\n".join(lines) + "\n").encode()


def ply_mesh(form="ascii", name="vertex_indices", polygons=QUADS, order=1, types="uchar int"):
    vertex = ("vertex", XYZ, [tuple(v) for v in VERTICES.tolist()])
    rows = [(7, (1, 2), polygon, 0.5) for polygon in polygons]
    face = ("face", ["uchar flag", "list uchar short other", f"list {types} {name}", "float quality"], rows)
    return ply(form, *[vertex, face][::order], comments=["comment crs EPSG:32632", "comment unit m"])


def gltf_bytes(document, body):
    """Build a binary glTF file of a document and its only buffer."""
    text = json.dumps({**document, "buffers": [{"byteLength": len(body)}]}).encode()
    text, body = text + b" " * (-len(text) % 4), body + bytes(-len(body) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(body), b"BIN\0") + body
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def glb_parts(*parts, **more):
    """Build a mesh of parts (mode, positions (V, 3), indices or None), of which None leaves out the mode or indices."""
    body, accessors, views, primitives = b"", [], [], []

    def add(values, code, kind):
        nonlocal body
        data = values.astype(code).tobytes()
        views.append({"buffer": 0, "byteOffset": len(body), "byteLength": len(data)})
        component = {"<f4": 5126, "<u4": 5125, "<i2": 5122}[code]
        bounds = {"min": values.min(axis=0).tolist(), "max": values.max(axis=0).tolist()} if kind == "VEC3" else {}
        accessors.append(
            {"bufferView": len(views) - 1, "componentType": component, "count": len(values), "type": kind, **bounds}
        )
        body += data + bytes(-len(data) % 4)
        return len(accessors) - 1

    for mode, positions, indices in parts:
        primitive = {"attributes": {"POSITION": add(np.asarray(positions, dtype=float), "<f4", "VEC3")}}
        primitive |= {} if mode is None else {"mode": mode}
        primitive |= {} if indices is None else {"indices": add(np.asarray(indices), "<u4", "SCALAR")}
        primitives.append(primitive)
    document = {"asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}]}
    document |= {"meshes": [{"primitives": primitives}], "accessors": accessors, "bufferViews": views, **more}
    return gltf_bytes(document, body)


def glb(name="cube"):
    """Build two cubes, one translated and scaled by 2 by its node."""
    positions, indices = VERTICES.astype("<f4").tobytes(), FACES.astype("<u2").tobytes()
    document = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0, 1]}],
        "nodes": [{"mesh": 0, "name": name}, {"mesh": 0, "translation": [10, 0, 0], "scale": [2, 2, 2]}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 8, "type": "VEC3", "min": [-1] * 3, "max": [1] * 3},
            {"bufferView": 1, "componentType": 5123, "count": 36, "type": "SCALAR"},
        ],
        "bufferViews": [
            {"buffer": 0, "byteOffset": 0, "byteLength": len(positions)},
            {"buffer": 0, "byteOffset": len(positions), "byteLength": len(indices)},
        ],
    }
    return gltf_bytes(document, positions + indices)


def off():
    rows = ["OFF", f"{len(VERTICES)} {len(FACES)} 0", *(f"{x} {y} {z}" for x, y, z in VERTICES)]
    return "\n".join([*rows, *(f"3 {a} {b} {c}" for a, b, c in FACES), ""]).encode()


# The four sides of the cube, whose last two vertices are the first, and the ends.
STRIPS = [(1, 0, 5, 4, 7, 6, 3, 2, 1, 0), (4, 0, 6, 2, -1, 3, 1, 7, 5)]


def ply_strips(form="ascii", rows=STRIPS):
    vertex = ("vertex", XYZ, [tuple(v) for v in VERTICES.tolist()])
    tags = ["comment crs EPSG:32632", "comment unit m"]
    return ply(form, vertex, ("tristrips", ["list int int vertex_indices"], [(row,) for row in rows]), comments=tags)


CUBES = {
    "binary.stl": stl(),
    "named.stl": stl(head=b"solid but binary"),
    "ascii.STL": ascii_stl(),
    "two solids.stl": ascii_stl(faces=FACES[:5]) + ascii_stl(faces=FACES[5:]),
    "plain.obj": obj("{0}"),
    "full.OBJ": obj(),
    "last.obj": obj("{1}//1"),
    "dos.obj": obj().replace(b"\n", b"\r\n"),
    "continued.obj": obj().replace(b"f ", b"f \\\n"),
    "plain.off": off(),
    "one line.off": b"# by hand\n" + off().replace(b"OFF\n", b"OFF "),
    "glued.off": off().replace(b"OFF\n", b"OFF"),
    "glued colored.off": off().replace(b"OFF\n", b"COFF").replace(b".0\n", b".0 255 0 0 255\n"),
    "normals.off": off().replace(b"OFF", b"STCNOFF").replace(b".0\n", b".0 0 0 1 255 0 0 255 0.5 0.5\n"),
    "homogeneous.off": off().replace(b"OFF", b"4OFF").replace(b"1.0", b"2.0").replace(b".0\n", b".0 2.0\n"),
    "words.off": off().replace(b"\n", b" "),
    "columns.off": off().replace(b" ", b"\n"),
    "marked.obj": b"\xef\xbb\xbf" + obj()[obj().index(b"v ") :],  # a byte order mark
    "marked.off": b"\xef\xbb\xbf" + off(),
    "end of file.stl": ascii_stl() + b"\x1a",
    "old.obj": obj().replace(b"f ", b"fo "),
    "strips.ply": ply_strips(),
    "strips in rows.ply": ply_strips("binary_little_endian", [*STRIPS, STRIPS[0][:0]]),
    "strips in one row.ply": ply_strips("binary_big_endian", [(*STRIPS[0], 0, 4, *STRIPS[1], -1)]),
    "colored.off": off().replace(b"OFF", b"COFF").replace(b".0\n", b".0 255 0 0 255\n"),
    **{f"{form}.ply": ply_mesh(form) for form in FORMATS},
    **{f"{form} face first.ply": ply_mesh(form, "vertex_index", FACES.tolist(), -1) for form in FORMATS},
    **{f"{form} mixed.ply": ply_mesh(form, polygons=[*QUADS[:5], (1, 5, 7), (1, 7, 3)]) for form in FORMATS},
    **{f"{form} float.ply": ply_mesh(form, types="int float") for form in FORMATS},
}
