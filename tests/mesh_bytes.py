"""Hand-made mesh files of a cube in all formats. Does not import pcbench."""

import json
import struct

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
        "buffers": [{"byteLength": len(positions + indices)}],
    }
    text, body = json.dumps(document).encode(), positions + indices
    text, body = text + b" " * (-len(text) % 4), body + bytes(-len(body) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(body), b"BIN\0") + body
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def off():
    rows = ["OFF", f"{len(VERTICES)} {len(FACES)} 0", *(f"{x} {y} {z}" for x, y, z in VERTICES)]
    return "\n".join([*rows, *(f"3 {a} {b} {c}" for a, b, c in FACES), ""]).encode()


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
    "colored.off": off().replace(b"OFF", b"COFF").replace(b".0\n", b".0 255 0 0 255\n"),
    **{f"{form}.ply": ply_mesh(form) for form in FORMATS},
    **{f"{form} face first.ply": ply_mesh(form, "vertex_index", FACES.tolist(), -1) for form in FORMATS},
    **{f"{form} mixed.ply": ply_mesh(form, polygons=[*QUADS[:5], (1, 5, 7), (1, 7, 3)]) for form in FORMATS},
    **{f"{form} float.ply": ply_mesh(form, types="int float") for form in FORMATS},
}
