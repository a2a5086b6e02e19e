"""Read Object File Format (OFF) meshes.

Why not trimesh: trimesh 5.2 silently reads a file with fewer faces than its header states, or with lines after the last
face. It loses a truncated face, and fails on a face of five corners. It would also be a dependency.
"""

from __future__ import annotations

import re
from array import array
from pathlib import Path

import numpy as np

from pcbench.errors import InputError
from pcbench.geometry.mesh import Mesh
from pcbench.io.columns import excerpt
from pcbench.io.files import MAX_PADDING, Warn, check_end
from pcbench.io.polygons import triangulate

# ST, C, N: texture, colour and normal after the coordinates (NC in MeshLab); 4: a homogeneous coordinate; n: other
# dimensions. Many files lack the space before the counts.
_HEADER = re.compile(rb"(?:ST)?(?:C?N?|NC)(4?)(n?)OFF(\d*)")


def read_off(path: Path, warn: Warn) -> Mesh:
    """Read the word OFF, three counts, one line `x y z ...` per vertex and `3 a b c ...` per face; # starts a comment.

    Vertices of 4OFF have a fourth coordinate, by which the others are divided. The numbers of a plain OFF file may be
    on any lines.

    Raises:
        InputError: the file is truncated, or its counts and lines do not match.
        OSError: the file cannot be read.
    """
    data = path.read_bytes().removeprefix(b"\xef\xbb\xbf")  # a byte order mark
    lines = [line.partition(b"#")[0].split() for line in data.splitlines()]
    lines = [words for words in lines if words]
    header = _HEADER.fullmatch(lines[0][0]) if lines else None
    if header is None:
        raise InputError(f"expected an OFF file that starts with 'OFF', got {b' '.join(lines[0])[:20]!r}" if lines
                         else "expected an OFF file, got an empty one")  # fmt: skip
    if header[2] or b"BINARY" in lines[0][1:]:
        what = "vertices of other dimensions (nOFF)" if header[2] else "a binary one"
        raise InputError(f"expected an ascii OFF file of three-dimensional vertices, got {what}: export it as PLY")
    lines[0][:1] = [header[0][: header.start(3)], *filter(None, [header[3]])]
    if lines[0][0] == b"OFF":
        lines = _arranged(lines)
    counts = lines[0][1:] or (lines[1] if len(lines) > 1 else [])
    if len(counts) not in (2, 3) or not all(word.isdigit() and len(word) < 19 for word in counts):
        raise InputError(
            f"expected counts of vertices, faces and edges, got {b' '.join(counts)[:40]!r}: export it again"
        )
    vertex_count, face_count = int(counts[0]), int(counts[1])
    if not face_count:
        raise InputError("expected a mesh with at least one face, got none: export it as a mesh, or points as PLY")
    body = lines[1 if lines[0][1:] else 2 :]
    if len(body) < vertex_count + face_count:
        what = f"{len(body)} of {vertex_count} vertices"
        if len(body) >= vertex_count:
            what = f"{len(body) - vertex_count} of {face_count} faces"
        raise InputError(f"truncated: got {what}: copy or export the file again")
    rest = b"\n".join(b" ".join(words) for words in body[vertex_count + face_count :])
    check_end(rest[:MAX_PADDING], len(rest), len(b"3 0 1 2"), "the last face", warn)
    vertices = np.empty((vertex_count, 3))
    lengths, corners = array("q"), array("q")
    for number, words in enumerate(body[: vertex_count + face_count]):
        try:
            if number < vertex_count:
                vertices[number] = [float(word) for word in words[:3]]
                if header[1]:
                    vertices[number] /= float(words[3])
            else:
                length = int(words[0])
                corners.extend([int(word) for word in words[1 : 1 + length]])
                lengths.append(length)
                if not 0 <= length < len(words):
                    raise ValueError
        except (ValueError, OverflowError, IndexError):
            what = f"vertex {number}" if number < vertex_count else f"face {number - vertex_count}"
            got = excerpt(b" ".join(words))
            expected = f"x y z{' w' * bool(header[1])}" if number < vertex_count else "a count and that many vertices"
            raise InputError(f"{what}: expected {expected}, got {got}: export it again") from None
    faces = triangulate(vertices, np.frombuffer(lengths, dtype=np.int64), np.frombuffer(corners, dtype=np.int64), warn)
    return Mesh(vertices, faces)


def _arranged(lines: list[list[bytes]]) -> list[list[bytes]]:
    """Return the words of a plain OFF file with the counts, and each vertex and face, on separate lines.

    They stay where they are if there are enough lines, or words are missing or no numbers.
    """
    words = [word for line in lines for word in line]
    counts = words[1:4]
    if len(counts) < 3 or not all(word.isdigit() and len(word) < 19 for word in counts):
        return lines
    vertex_count, face_count, _ = map(int, counts)
    own_line = len(lines[0][1:] or lines[1])
    are_lines = own_line == 3 and len(lines) > vertex_count + face_count
    if are_lines or own_line == 2 or len(words) < 4 + 3 * vertex_count + face_count:
        return lines
    arranged, start = [words[:4]], 4
    for number in range(vertex_count + face_count):
        if number >= vertex_count and not (start < len(words) and words[start].isdigit()):
            return lines
        length = 3 if number < vertex_count else 1 + int(words[start][:18])
        arranged.append(words[start : start + length])
        start += length
    return [*arranged, *([words[start:]] if start < len(words) else [])]
