"""Hand-made PLY files, packed with struct, and ways to damage them. Does not import pcbench."""

import random
import re
import struct

FORMATS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
# The struct code of each type, which has two names.
TYPES = {
    "char": "b",
    "uchar": "B",
    "short": "h",
    "ushort": "H",
    "int": "i",
    "uint": "I",
    "float": "f",
    "double": "d",
    "int8": "b",
    "uint8": "B",
    "int16": "h",
    "uint16": "H",
    "int32": "i",
    "uint32": "I",
    "float32": "f",
    "float64": "d",
}
XYZ = ["float x", "float y", "float z"]


def ply(form, *elements, comments=(), newline="\n"):
    """Build a file: an element is (name, properties, rows); a property "float x" or "list uchar int i"."""
    lines = ["ply", f"format {form} 1.0", *comments]
    for name, properties, rows in elements:
        lines += [f"element {name} {len(rows)}", *(f"property {prop}" for prop in properties)]
    header = newline.join([*lines, "end_header", ""]).encode()
    return header + b"".join(
        _row(form, properties, row, newline) for _, properties, rows in elements for row in rows if properties
    )


def _row(form, properties, row, newline):
    values = []  # (struct code, value)
    for prop, value in zip(properties, row, strict=True):
        words = prop.split()
        if words[0] == "list":
            values += [(TYPES[words[1]], len(value)), *((TYPES[words[2]], item) for item in value)]
        else:
            values.append((TYPES[words[0]], value))
    if form == "ascii":
        return (" ".join(repr(value) for _, value in values) + newline).encode()
    return b"".join(struct.pack(FORMATS[form] + code, value) for code, value in values)


def points(count):
    """Return rows of coordinates that float32 represents exactly."""
    return [(i * 0.25, -i * 0.5, i + 0.125) for i in range(count)]


def corpus():
    """Return valid files of all variants, as name -> bytes."""
    faces = ("face", ["list uchar int vertex_indices"], [(0, 1, 2), (2, 1, 0), (1, 2, 3)])
    mixed_faces = (
        "face",
        ["list uchar int vertex_indices", "uchar flag"],
        [((0, 1, 2), 1), ((0, 1, 2, 3), 2), ((), 3)],
    )
    views = (
        "vertex",
        [*XYZ, "list uchar uint view_indices"],
        [(*p, tuple(range(i % 4))) for i, p in enumerate(points(9))],
    )
    full_properties = [
        "double z",
        "uchar red",
        "uchar green",
        "uchar blue",
        "double y",
        "double x",
        "float nx",
        "float ny",
        "float nz",
    ]
    full_rows = [(z, 1, 2, i, y, x, 0.0, 0.0, 1.0) for i, (x, y, z) in enumerate(points(12))]
    splat = [*XYZ, "float nx", "float ny", "float nz", "float f_dc_0", "float opacity", "float scale_0", "float rot_0"]
    camera = ("camera", ["float fx", "list int double k", "short id"], [(1.0, (0.5, 0.25), 7)])
    files = {}
    for form in FORMATS:
        files |= {
            f"{form} plain": ply(form, ("vertex", XYZ, points(20))),
            f"{form} full": ply(
                form, ("vertex", full_properties, full_rows), comments=["comment crs EPSG:32617", "comment unit m"]
            ),
            f"{form} mesh": ply(form, ("vertex", XYZ, points(8)), ("face", faces[1], [(f,) for f in faces[2]])),
            f"{form} face first": ply(form, mixed_faces, camera, ("vertex", XYZ, points(8))),
            f"{form} views": ply(form, views, comments=["comment", "obj_info made by hand"]),
            f"{form} splat": ply(form, ("vertex", splat, [(*p, 0.0, 0.0, 0.0, 1.5, 2.5, 3.5, 4.5) for p in points(6)])),
            f"{form} crlf": ply(form, ("vertex", XYZ, points(5)), newline="\r\n"),
        }
    return files


def damage(data, rng: random.Random):
    """Apply one to three kinds of damage: flipped bits, bytes inserted or deleted, truncation, changed header words."""
    for _ in range(rng.choice([1, 1, 2, 3])):
        data = rng.choice([_flip, _insert, _delete, _cut, _number, _word, _swap])(bytearray(data), rng)
    return bytes(data)


def _flip(data, rng):
    for _ in range(rng.randint(1, 8)):
        if data:
            data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
    return data


def _insert(data, rng):
    position = rng.randint(0, len(data))
    data[position:position] = rng.choice([rng.randbytes(rng.randint(1, 40)), b"\n", b"\0", b" ", b"nan ", b"\r"])
    return data


def _delete(data, rng):
    position = rng.randint(0, len(data))
    del data[position : position + rng.randint(1, 40)]
    return data


def _cut(data, rng):
    return data[: rng.randint(0, len(data))]


def _number(data, rng):
    numbers = list(re.finditer(rb"\d+", data[:2000]))
    if numbers:
        extremes = [0, 1, -1, 255, 2**31 - 1, 2**31, 2**32, 10**17, 10**18 - 1, 2**63 - 1, 2**63, 2**64, 10**40]
        match = rng.choice(numbers)
        data[match.start() : match.end()] = str(rng.choice([*extremes, rng.randint(0, 300)])).encode()
    return data


def _word(data, rng):
    words = list(re.finditer(rb"[a-z_]+", data[:2000]))
    if words:
        keywords = [
            *TYPES,
            *FORMATS,
            "list",
            "element",
            "property",
            "vertex",
            "face",
            "x",
            "red",
            "nx",
            "comment",
            "end_header",
        ]
        match = rng.choice(words)
        data[match.start() : match.end()] = rng.choice(keywords).encode()
    return data


def _swap(data, rng):
    """Move or duplicate a header line."""
    lines = bytes(data).split(b"\n")
    line = rng.choice(lines[:20])
    if rng.random() < 0.5:
        lines.remove(line)
    lines.insert(rng.randint(0, min(20, len(lines))), line)
    return bytearray(b"\n".join(lines))
