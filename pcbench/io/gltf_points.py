"""Read the points of glTF files (.glb and .gltf): point clouds, and the vertices of meshes, with colours and normals.

Why not trimesh, which reads the meshes: it trusts the counts in a file, so that it runs in a child process, which takes
a third of a second. Khronos, glTF 2.0, sections 3.5 to 3.7.
"""

from __future__ import annotations

import base64
import binascii
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import unquote_to_bytes

import numpy as np
from numpy.typing import NDArray

from pcbench.errors import InputError
from pcbench.geometry.arrays import FloatArray
from pcbench.io.files import Fields, Look, Warn, errors_named
from pcbench.io.gltf import COMPRESSED, INSTANCED, Document, entries, local_file, read_document
from pcbench.io.polygons import left_out_surface
from pcbench.regular_files import read_bytes

_POINTS, _LINES, _TRIANGLES = 0, (1, 2, 3), (4, 5, 6)  # modes of primitives
_TYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
_SPLATS = "KHR_gaussian_splatting"
_MAX_BUFFER_BYTES = 1 << 34
# Bound of all points: nodes may repeat a mesh this many times, or these bytes.
_MAX_GROWTH, _MAX_FREE_GROWTH_BYTES = 64, 64 << 20


class _GltfPart(NamedTuple):
    """Points of a primitive in world coordinates; colours from 0 to 255 and normals if it has them."""

    points: FloatArray
    colors: FloatArray | None
    normals: FloatArray | None


def look_at_gltf(path: Path) -> Look:
    """Look whether a file has a surface, or points alone.

    Raises:
        InputError: the file is no glTF.
        OSError: the file cannot be read.
    """
    modes = _modes(read_document(path, lambda _: None).content)
    return Look(holds_mesh=_POINTS not in modes or bool(set(_TRIANGLES) & set(modes)))


def read_gltf_points(path: Path, warn: Warn) -> Fields:
    """Read the points of a file, or with a warning the vertices of its mesh."""
    fields = read_gltf_vertices(path, warn)
    modes = _modes(read_document(path, lambda _: None).content)
    if surfaces := sum(mode in _TRIANGLES for mode in modes):
        warn(left_out_surface(len(fields["points"]), f"{surfaces} part{'s' * (surfaces > 1)}"))
    return fields


def read_gltf_vertices(path: Path, warn: Warn) -> Fields:
    """Read the points, or the vertices of a mesh without those that repeat another one; y is up, the unit is the metre.

    Colours are as stored, without conversion from linear values. They and normals are kept if all parts have them.

    Raises:
        InputError: the file is damaged, or stores its points in a way that is not supported.
        OSError: the file cannot be read.
    """
    document = read_document(path, warn)
    content = document.content
    _check_support(content)
    modes = set(_modes(content))
    wanted = set(_TRIANGLES) & modes or {_POINTS} & modes
    if not wanted:
        kind = "lines" if modes else "nothing"
        raise InputError(f"expected points or triangles, got {kind}: export it with points or a mesh")
    buffers = _buffers(path, document)
    parts: list[_GltfPart] = []
    left = _MAX_FREE_GROWTH_BYTES + _MAX_GROWTH * sum({id(buffer): len(buffer) for buffer in buffers}.values())
    for number, matrix in _meshes_of_scene(content):
        for primitive in entries(_entry(content, "meshes", number), "primitives"):
            if isinstance(primitive, dict) and _mode(primitive) in wanted:
                with np.errstate(over="ignore", invalid="ignore"):
                    parts.append(_part(content, buffers, primitive, matrix))
                left -= parts[-1].points.nbytes
                if left < 0:
                    raise InputError(
                        "expected fewer repeated parts, got more points than the file can hold: export it again"
                    )
    if not parts:
        raise InputError("expected points or a mesh in the scene, got none: export what the scene shows")
    if (others := len(_modes(content)) - sum(mode in wanted for mode in _modes(content))) and _POINTS in wanted:
        warn(f"left out {others} parts, which are lines")
    return _joined(parts, warn, is_mesh=_POINTS not in wanted)


def _joined(parts: list[_GltfPart], warn: Warn, *, is_mesh: bool) -> Fields:
    colored, with_normals = (
        sum(values is not None for values in column) for column in list(zip(*parts, strict=True))[1:]
    )
    if 0 < colored < len(parts):
        warn(f"left out colours, which only {colored} of {len(parts)} parts have")
    points = np.concatenate([part.points for part in parts])
    colors = normals = None
    if colored == len(parts):
        stacked = np.concatenate([part.colors for part in parts if part.colors is not None])
        colors = np.rint(np.nan_to_num(stacked).clip(0, 255)).astype(np.uint8)
    if with_normals == len(parts) and not is_mesh:  # those of a mesh differ at its edges
        normals = np.concatenate([part.normals for part in parts if part.normals is not None])
    if is_mesh:
        rows = points if colors is None else np.column_stack([points, colors])
        first = np.unique(rows, axis=0, return_index=True)[1]
        points, colors = points[first], None if colors is None else colors[first]
    return Fields(points=points, colors=colors, normals=normals, unit="m")


# ---- scene --------------------------------------------------------------------------------------------------------


def _modes(content: Any) -> list[int]:
    primitives = [p for mesh in entries(content, "meshes") for p in entries(mesh, "primitives")]
    return [_mode(primitive) for primitive in primitives if isinstance(primitive, dict)]


def _mode(primitive: dict[str, Any]) -> int:
    mode = primitive.get("mode", _TRIANGLES[0])
    return mode if isinstance(mode, int) else -1


def _check_support(content: Any) -> None:
    required, used = (entries(content, name) for name in ("extensionsRequired", "extensionsUsed"))
    unsupported = [name for name in required if str(name).startswith(COMPRESSED)]
    unsupported += [name for name in used if name == INSTANCED or str(name).startswith(_SPLATS)]
    if unsupported:
        got = str(unsupported[0])[:60]
        remedy = "export the splats as .ply or .spz" if got.startswith(_SPLATS) else "export it without this extension"
        raise InputError(f"expected plain points or triangles, got {got}: {remedy}")


def _meshes_of_scene(content: Any) -> Iterator[tuple[int, FloatArray]]:
    """Yield the index and the matrix (4, 4) of each mesh in the scene; of all meshes if there are no nodes."""
    nodes = entries(content, "nodes")
    if not nodes:
        yield from ((number, np.eye(4)) for number in range(len(entries(content, "meshes"))))
        return
    if scenes := entries(content, "scenes"):
        number = content.get("scene", 0)
        roots = entries(_entry(content, "scenes", number if len(scenes) > 1 else 0), "nodes")
    else:
        children = {child for node in nodes for child in entries(node, "children") if isinstance(child, int)}
        roots = [number for number in range(len(nodes)) if number not in children]
    stack = [(root, np.eye(4)) for root in reversed(roots)]
    visited: set[int] = set()
    while stack:
        number, parent = stack.pop()
        node = _entry(content, "nodes", number)
        if number in visited:
            raise InputError(f"expected each node once, got node {number} twice: export the file again")
        visited.add(number)
        with errors_named(f"node {number}"):
            matrix = parent @ _matrix(node)
        if "mesh" in node:
            yield node["mesh"], matrix
        stack += [(child, matrix) for child in reversed(entries(node, "children"))]


def _matrix(node: dict[str, Any]) -> FloatArray:
    """Return the matrix of a node, which is stored column by column, or as translation, rotation and scale."""
    if "matrix" in node:
        return _vector(node, "matrix", [0.0] * 16).reshape(4, 4).T
    x, y, z, w = _vector(node, "rotation", [0.0, 0.0, 0.0, 1.0])
    matrix = np.eye(4)
    matrix[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    matrix[:3, :3] *= _vector(node, "scale", [1.0, 1.0, 1.0])
    matrix[:3, 3] = _vector(node, "translation", [0.0, 0.0, 0.0])
    return matrix


def _vector(node: dict[str, Any], name: str, default: list[float]) -> FloatArray:
    values = node.get(name, default)
    if not isinstance(values, list) or len(values) != len(default) or not all(map(_is_number, values)):
        raise InputError(f"expected {name} as {len(default)} numbers, got {str(values)[:60]}: export the file again")
    return np.array(values, dtype=np.float64)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e100


def _entry(content: Any, name: str, number: Any) -> dict[str, Any]:
    """Return an object of a list in the document."""
    values = entries(content, name)
    if not isinstance(number, int) or not 0 <= number < len(values) or not isinstance(values[number], dict):
        raise InputError(f"expected an index into {len(values)} {name}, got {str(number)[:40]}: export the file again")
    entry: dict[str, Any] = values[number]
    return entry


# ---- arrays -------------------------------------------------------------------------------------------------------


def _part(content: Any, buffers: list[bytes], primitive: dict[str, Any], matrix: FloatArray) -> _GltfPart:
    attributes = primitive.get("attributes")
    if not isinstance(attributes, dict) or "POSITION" not in attributes:
        raise InputError("expected parts with POSITION, got one without: export the file again")
    points: FloatArray = _array(content, buffers, attributes["POSITION"], (3,))
    colors, normals = (
        _array(content, buffers, attributes[name], widths) if name in attributes else None
        for name, widths in (("COLOR_0", (3, 4)), ("NORMAL", (3,)))
    )
    if any(values is not None and len(values) != len(points) for values in (colors, normals)):
        raise InputError(f"expected a colour and a normal for each of {len(points)} points: export the file again")
    if "indices" in primitive and _mode(primitive) == _POINTS:
        which = _array(content, buffers, primitive["indices"], (1,))[:, 0]
        if not ((which >= 0) & (which < len(points))).all():
            raise InputError(f"expected indices below {len(points)}, got {which.max():g}: export the file again")
        chosen = which.astype(np.int64)
        points = points[chosen]
        colors, normals = (values if values is None else values[chosen] for values in (colors, normals))
    linear = matrix[:3, :3]
    if normals is not None:
        normals = normals @ np.linalg.inv(linear) if abs(np.linalg.det(linear)) > 0 else None
    return _GltfPart(points @ linear.T + matrix[:3, 3], None if colors is None else 255 * colors[:, :3], normals)


def _array(content: Any, buffers: list[bytes], number: Any, widths: tuple[int, ...]) -> FloatArray:
    """Return the values (N, width) of an accessor; normalised integers are from -1 to 1.

    Raises:
        InputError: the accessor has another type, or does not lie within its buffer.
    """
    accessor = _entry(content, "accessors", number)
    if "sparse" in accessor or "bufferView" not in accessor:
        raise InputError("expected plain arrays, got sparse accessors: export the file without them")
    view = _entry(content, "bufferViews", accessor["bufferView"])
    buffer = buffers[_whole(view, "buffer", len(buffers))]
    dtype, width = _TYPES.get(_whole(accessor, "componentType")), _WIDTHS.get(str(accessor.get("type")))
    if dtype is None or width not in widths:
        got = f"{accessor.get('type')} of {accessor.get('componentType')}"[:60]
        raise InputError(
            f"expected arrays of vectors with {' or '.join(map(str, widths))} numbers, got {got}: export it again"
        )
    assert width is not None
    row = np.dtype((dtype, (width,)))
    count, stride = _whole(accessor, "count"), _whole(view, "byteStride", default=0) or row.itemsize
    start, size = _whole(view, "byteOffset", default=0), _whole(view, "byteLength")
    offset = _whole(accessor, "byteOffset", default=0)
    needed = offset + (count - 1) * stride + row.itemsize if count else 0
    if stride < row.itemsize or needed > size or start + size > len(buffer):
        raise InputError(
            f"truncated: an array of {count} x {width} values needs bytes {start} to {start + needed}, got {size} in a"
            f" buffer of {len(buffer)}: copy or export the file again"
        )
    if not count:
        raise InputError("expected at least one point in each part, got none: export the file again")
    values: NDArray[Any] = np.ndarray((count, width), dtype, buffer, start + offset, (stride, np.dtype(dtype).itemsize))
    numbers = values.astype(np.float64)
    if accessor.get("normalized") is True and values.dtype.kind in "iu":
        numbers = np.maximum(numbers / np.iinfo(values.dtype).max, -1)
    return numbers


def _whole(values: dict[str, Any], name: str, limit: int = 1 << 53, default: int | None = None) -> int:
    value = values.get(name, default)
    if isinstance(value, float) and value.is_integer():
        value = int(value)
    if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value < limit:
        raise InputError(f"expected {name} as a whole number below {limit}, got {str(value)[:40]}: export it again")
    return value


def _buffers(path: Path, document: Document) -> list[bytes]:
    buffers: list[bytes] = []
    files: dict[Path, bytes] = {}  # a small document may name a file many times
    for number, values in enumerate(entries(document.content, "buffers")):
        uri = values.get("uri") if isinstance(values, dict) else None
        if uri is None and number == 0 and document.body is not None:
            buffers.append(document.body)
        elif not isinstance(uri, str):
            raise InputError(f"buffer {number}: expected a uri, got none: export the file again")
        elif uri.startswith("data:"):
            buffers.append(_decoded(uri, number))
        else:
            with errors_named(f"referenced file {uri[:80]}"):
                file = local_file(path, uri)
                if (key := file.resolve()) not in files:
                    files[key] = read_bytes(file, _MAX_BUFFER_BYTES)
                buffers.append(files[key])
    return buffers


def _decoded(uri: str, number: int) -> bytes:
    head, _, data = uri.partition(",")
    try:
        return base64.b64decode(data, validate=True) if head.endswith(";base64") else unquote_to_bytes(data)
    except (binascii.Error, ValueError):
        raise InputError(f"buffer {number}: expected base64, got other text: export the file again") from None
