"""Wavefront OBJ meshes.

Read here and not by trimesh. trimesh 5.2 takes vertex 0, which is none, for the last one; it ends other numbers that
lie with an IndexError that names no line, leaves out points and lines without a word, and refuses files of which only
some vertices have colours. And it would have to be installed.
"""

from __future__ import annotations

from array import array
from pathlib import Path

import numpy as np

from pcbench.errors import InputError
from pcbench.geometry.mesh import Mesh
from pcbench.io.files import Warn
from pcbench.io.polygons import triangulate_fans


def read_obj(path: Path, warn: Warn) -> Mesh:
    """Lines `v x y z` and `f a b c ...`; a corner `7/2/3` is vertex 7, and -1 is the last one so far.

    Raises:
        InputError: a line is not of that form, or names a vertex that there is not.
        OSError: the file cannot be read.
    """
    coordinates, lengths, corners = array("d"), array("q"), array("q")
    left_out = 0
    for number, line in enumerate(path.read_bytes().replace(b"\\\r\n", b" ").replace(b"\\\n", b" ").splitlines(), 1):
        words = line.split()
        if not words or words[0] not in (b"v", b"f", b"l", b"p"):
            continue
        try:
            if b"_" in line:  # Python reads 1_000 as a number; OBJ does not
                raise ValueError
            if words[0] == b"v":
                x, y, z = words[1:4]
                coordinates.extend((float(x), float(y), float(z)))
            elif words[0] == b"f":
                known = len(coordinates) // 3
                for word in words[1:]:
                    corner = int(word.partition(b"/")[0])
                    if not -known <= corner or not corner:  # too high a number may name a vertex still to come
                        raise ValueError
                    corners.append(corner - 1 if corner > 0 else known + corner)
                lengths.append(len(words) - 1)
            else:
                left_out += 1
        except (ValueError, OverflowError):
            expected = "'v x y z'" if words[0] == b"v" else f"'f a b c' with vertices 1 to {len(coordinates) // 3}"
            excerpt = repr(line.strip()[:60])[1:]
            raise InputError(f"line {number}: expected {expected}, got {excerpt}") from None
    if left_out:
        warn(f"left out {left_out} points and lines")
    vertices = np.frombuffer(coordinates, dtype=np.float64).reshape(-1, 3)
    faces = triangulate_fans(np.frombuffer(lengths, dtype=np.int64), np.frombuffer(corners, dtype=np.int64), warn)
    return Mesh(vertices, faces)
