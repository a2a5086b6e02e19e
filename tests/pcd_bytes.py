"""Hand-made PCD files, with a small LZF compressor. Does not import pcbench."""

import struct


def pcd(data, fields, rows, viewpoint="0 0 0 1 0 0 0", **replaced):
    """Build a file. A field is "x F4" or "id U2 3"; a row is flat. `replaced` changes or (None) drops header lines."""
    parsed_fields = [(*field.split(), "1")[:3] for field in fields]
    entries = {
        "VERSION": "0.7",
        "FIELDS": " ".join(name for name, _, _ in parsed_fields),
        "SIZE": " ".join(kind[1] for _, kind, _ in parsed_fields),
        "TYPE": " ".join(kind[0] for _, kind, _ in parsed_fields),
        "COUNT": " ".join(count for _, _, count in parsed_fields),
        "WIDTH": len(rows),
        "HEIGHT": 1,
        "VIEWPOINT": viewpoint,
        "POINTS": len(rows),
        "DATA": data,
    } | replaced
    header = "# .PCD v0.7 - Point Cloud Data file format\n"
    header += "".join(f"{key} {value}\n" for key, value in entries.items() if value is not None)
    return header.encode() + _body(data, parsed_fields, rows)


def _body(data, parsed_fields, rows):
    if data == "ascii":
        return "".join(" ".join(map(repr, row)) + "\n" for row in rows).encode()
    codes = [_code(kind) for _, kind, count in parsed_fields for _ in range(int(count))]
    if data == "binary":
        return b"".join(struct.pack("<" + "".join(codes), *row) for row in rows)
    columns, first_column = b"", 0
    for _, kind, count in parsed_fields:  # all points of a field, then the next field
        width = int(count)
        for row in rows:
            columns += struct.pack(f"<{width}{_code(kind)}", *row[first_column : first_column + width])
        first_column += width
    packed = lzf(columns)
    return struct.pack("<II", len(packed), len(columns)) + packed


def _code(kind):
    return {"I": "bhiq", "U": "BHIQ", "F": "  fd"}[kind[0]][{"1": 0, "2": 1, "4": 2, "8": 3}[kind[1]]]


def lzf(data):
    """Compress greedily: refer to the last occurrence of the next three bytes, or copy bytes literally."""
    out, literals, last_positions, position = bytearray(), bytearray(), {}, 0

    def flush():
        for start in range(0, len(literals), 32):
            run = literals[start : start + 32]
            out.append(len(run) - 1)
            out.extend(run)
        literals.clear()

    while position < len(data):
        key = data[position : position + 3]
        previous = last_positions.get(key)
        last_positions[key] = position
        if previous is None or len(key) < 3 or position - previous > 8192:
            literals.append(data[position])
            position += 1
            continue
        length = 3
        while length < 264 and position + length < len(data) and data[previous + length] == data[position + length]:
            length += 1
        flush()
        distance = position - previous - 1
        if length < 9:
            out.append((length - 2) << 5 | distance >> 8)
        else:
            out.extend((7 << 5 | distance >> 8, length - 9))
        out.append(distance & 255)
        position += length
    flush()
    return bytes(out)


def points(count):
    return [(i * 0.25, -i * 0.5, i + 0.125) for i in range(count)]


XYZ = ["x F4", "y F4", "z F4"]


def corpus():
    """Return valid files of all variants, as name -> bytes."""
    all_fields = [
        "z F8",
        "rgb U4",
        "_ U1 3",
        "y F8",
        "x F8",
        "normal_x F4",
        "normal_y F4",
        "normal_z F4",
        "hist F4 4",
        "t U8",
    ]
    all_field_rows = [(z, 0xFF102030 + i, 0, 0, 0, y, x, 0.0, 0.0, 1.0, 1.0, 2.0, 3.0, i / 2, 2**60 + i)
            for i, (x, y, z) in enumerate(points(12))]  # fmt: skip
    return {
        f"{data} {name}": pcd(data, fields, rows)
        for data in ("ascii", "binary", "binary_compressed")
        for name, (fields, rows) in {"plain": (XYZ, points(20)), "full": (all_fields, all_field_rows)}.items()
    }
