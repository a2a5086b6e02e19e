"""E57 files written with libE57Format, which pye57 wraps, and their checksums computed without it."""

import tempfile
from pathlib import Path

import numpy as np

XYZ = ("cartesianX", "cartesianY", "cartesianZ")
RAE = ("sphericalRange", "sphericalAzimuth", "sphericalElevation")
_PAGE, _PAYLOAD = 1024, 1020


def write(path, scans, crs=""):
    """Write scans, given as dictionaries of columns; `pose` is a quaternion (w, x, y, z) and a translation.

    A scan without columns has no points.
    """
    from pye57 import libe57

    file = libe57.ImageFile(str(path), "w")
    file.extensionsAdd("", libe57.E57_V1_0_URI)
    file.extensionsAdd("nor", "http://www.libe57.org/E57_NOR_surface_normals.txt")
    root = file.root()
    for name, value in (("formatName", "ASTM E57 3D Imaging Data File"), ("guid", "{0}"), ("coordinateMetadata", crs)):
        root.set(name, libe57.StringNode(file, value))
    root.set("versionMajor", libe57.IntegerNode(file, 1))
    root.set("versionMinor", libe57.IntegerNode(file, 0))
    data = libe57.VectorNode(file, True)
    root.set("data3D", data)
    for number, scan in enumerate(scans):
        data.append(_scan(libe57, file, number, scan))
        if scan:
            _fill(libe57, file, data[number], {name: v for name, v in scan.items() if name not in ("pose", "limits")})
    file.close()
    return path


def _scan(libe57, file, number, scan):
    node = libe57.StructureNode(file)
    node.set("guid", libe57.StringNode(file, f"{{{number}}}"))
    if "pose" in scan:
        quaternion, translation = scan["pose"]
        pose = libe57.StructureNode(file)
        for name, axes, values in (("rotation", "wxyz", quaternion), ("translation", "xyz", translation)):
            component = libe57.StructureNode(file)
            for axis, value in zip(axes, values, strict=True):
                component.set(axis, libe57.FloatNode(file, float(value)))
            pose.set(name, component)
        node.set("pose", pose)
    if "limits" in scan:
        limits = libe57.StructureNode(file)
        for name in ("colorRed", "colorGreen", "colorBlue"):
            for end, value in zip(("Minimum", "Maximum"), scan["limits"], strict=True):
                limits.set(name + end, libe57.IntegerNode(file, value))
        node.set("colorLimits", limits)
    prototype = libe57.StructureNode(file)
    for name, values in scan.items():
        if name not in ("pose", "limits"):
            is_integer = np.issubdtype(np.asarray(values).dtype, np.integer)
            prototype.set(name, libe57.IntegerNode(file, 0, 0, 65535) if is_integer else libe57.FloatNode(file, 0.0))
    if scan:
        node.set("points", libe57.CompressedVectorNode(file, prototype, libe57.VectorNode(file, True)))
    return node


def _fill(libe57, file, node, columns):
    buffers, arrays = libe57.VectorSourceDestBuffer(), []
    for name, values in columns.items():
        arrays.append(np.ascontiguousarray(values, dtype=np.float64))
        buffers.append(libe57.SourceDestBuffer(file, name, arrays[-1], len(values), True, True))
    writer = node["points"].writer(buffers)
    writer.write(len(arrays[0]))
    writer.close()


def corpus():
    """Return two small files, as bytes."""
    rng = np.random.default_rng(3)
    points = rng.uniform(-1, 1, (50, 3))
    points_only = dict(zip(XYZ, points.T, strict=True))
    all_fields = points_only | {
        "intensity": rng.uniform(0, 1, 50),
        "colorRed": np.arange(50),
        "colorGreen": np.arange(50),
    }
    all_fields |= {
        "colorBlue": np.arange(50),
        "cartesianInvalidState": np.arange(50) % 2,
        "pose": ((1, 0, 0, 0), (1, 2, 3)),
    }
    spherical = dict(zip(RAE, np.abs(points).T, strict=True))
    with tempfile.TemporaryDirectory() as folder:
        files = {"full": [all_fields, points_only], "spherical": [spherical]}
        return {name: write(Path(folder) / f"{name}.e57", scans).read_bytes() for name, scans in files.items()}


def add_checksums(data):
    """Recompute the checksum of each complete page: CRC-32C of 1,020 bytes, big-endian."""
    pages = [data[start : start + _PAGE] for start in range(0, len(data), _PAGE)]
    checked_pages = [p[:_PAYLOAD] + _crc32c(p[:_PAYLOAD]).to_bytes(4, "big") if len(p) == _PAGE else p for p in pages]
    return b"".join(checked_pages)


def _crc32c(data):
    crc = 0xFFFFFFFF
    for byte in data:
        crc = _TABLE[(crc ^ byte) & 0xFF] ^ (crc >> 8)
    return crc ^ 0xFFFFFFFF


def _row(value):
    for _ in range(8):
        value = (value >> 1) ^ (0x82F63B78 if value & 1 else 0)
    return value


_TABLE = [_row(value) for value in range(256)]
