"""Hand-made files of Gaussian splats, packed with struct, and those of other programs. Does not import pcbench."""

import gzip
import struct

from repository import TESTS

FOREIGN = TESTS / "foreign" / "splats"
SPLAT_ROW = struct.pack("<6f8B", 1, -2, 3, 0.5, 0.25, 1, 255, 0, 128, 51, 255, 128, 128, 128)
SPZ_MAGIC = 0x5053474E


def spz(version, count=2, degree=0, bits=12, flags=0, magic=SPZ_MAGIC, extra=b"", **parts):
    """Return the unpacked bytes of a .spz file of version 1 to 3; splats are at (1, 2, 3) and (-1, -2, -3) in it."""
    fixed = [1, 2, 3, -1, -2, -3]
    columns = {
        "positions": struct.pack("<6e", *fixed)
        if version == 1
        else b"".join((value << bits & 0xFFFFFF).to_bytes(3, "little") for value in fixed),
        "opacities": bytes([255, 51]),
        "colors": bytes([128, 0, 255, 10, 20, 30]),
        "scales": bytes([160, 144, 128, 0, 255, 1]),
        # No rotation, and half a turn about y: x, y, z as bytes, or the largest of x, y, z, w and three zeros.
        "rotations": struct.pack("<2I", 3 << 30, 1 << 30) if version >= 3 else bytes([128, 128, 128, 128, 255, 128]),
        "harmonics": bytes((100 + k) % 256 for k in range(6 * degree * (degree + 2))),
    }
    header = struct.pack("<IIIBBBB", magic, version, count, degree, bits, flags, 0)
    return header + b"".join((columns | parts).values()) + extra


def packed_spz(*args, **parts):
    return gzip.compress(spz(*args, **parts), mtime=0)


def ksplat(level, splats=None, changes=None):
    """Return a file of another program with numbers of 32 bits replaced, by their offset.

    With a number of splats, the first splat at level 0 without harmonics is repeated.
    """
    data = bytearray((FOREIGN / f"mkkellogg_{level}.ksplat").read_bytes())
    if splats is not None:
        row = data[5120 : 5120 + 44]
        changes = {16: splats, 4096: splats, 4100: splats, 4136: 0}
        data[5120:] = row * splats
    for offset, number in (changes or {}).items():
        data[offset : offset + 4] = struct.pack("<I", number)
    return bytes(data)


def spz_corpus():
    return {f"{version} {degree}": packed_spz(version, degree=degree) for version in (1, 2, 3) for degree in (0, 1, 3)}


def splat_corpus():
    return {"one": SPLAT_ROW, "many": SPLAT_ROW * 20, "ply2splat": (FOREIGN / "ply2splat.splat").read_bytes()}


def ksplat_corpus():
    return {str(level): (FOREIGN / f"mkkellogg_{level}.ksplat").read_bytes() for level in range(3)}


def packed_ply_corpus():
    return {"packed splats": (FOREIGN / "playcanvas.compressed.ply").read_bytes()}
