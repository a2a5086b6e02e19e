"""Unpack the compressed PLY files of PlayCanvas (.compressed.ply): splats as four numbers of 32 bits, in chunks of 256.

A chunk has the ranges of its splats' positions, axes and, in newer files, colours, and the numbers are places within
these. Coefficients of higher harmonics are bytes of another element. PlayCanvas's SuperSplat and splat-transform (MIT)
write such files.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pcbench.errors import InputError
from pcbench.geometry.arrays import FloatArray
from pcbench.io.files import Fields
from pcbench.io.names import Columns
from pcbench.io.ply_header import Element, PlyHeader
from pcbench.io.splat_fields import SH_DC, splat_fields

ELEMENTS = ("chunk", "vertex", "sh")
"""Elements of which a file consists; the last is missing without higher harmonics."""

_CHUNK = 256  # splats
_PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
_AXES, _COLORS = ("x", "y", "z"), ("r", "g", "b")
_SCALES = tuple(f"scale_{axis}" for axis in _AXES)
_COEFFICIENTS = (9, 24, 45)  # of harmonics of degree 1 to 3, in all colours
_HARMONICS_RANGE = 8.0


def is_packed(header: PlyHeader) -> bool:
    """Return whether the vertices are packed splats."""
    vertex = header.element("vertex")
    return vertex is not None and any(prop.name == _PACKED[0] for prop in vertex.properties)


def check_packed(header: PlyHeader) -> None:
    """Raise InputError if the elements of packed splats, their properties or their counts are not as described."""
    chunk, vertex, harmonics = (header.element(name) or Element(name, 0) for name in ELEMENTS)
    ranges = [f"{end}_{name}" for end in ("min", "max") for name in (*_AXES, *_SCALES)]
    for element, names, kind in ((vertex, _PACKED, "u4"), (chunk, ranges, "f4")):
        types = {prop.name: prop.dtype.str[1:] for prop in element.scalars}
        if wrong := next((name for name in names if types.get(name) != kind), None):
            raise InputError(
                f"expected compressed Gaussian splats with {element.name!r} property {wrong!r} as"
                f" {'uint' if kind == 'u4' else 'float'}, got {types.get(wrong, 'none')}: export it again"
            )
    count = -(-vertex.count // _CHUNK)
    if not vertex.count or chunk.count != count:
        raise InputError(
            f"expected {count} chunks for {vertex.count} splats, one per {_CHUNK}, got {chunk.count}: export it again"
        )
    coefficients = len({prop.name for prop in harmonics.scalars})  # a damaged header may have a name twice
    if harmonics.properties and (harmonics.count != vertex.count or coefficients not in _COEFFICIENTS):
        raise InputError(
            f"expected 9, 24 or 45 harmonics for each of {vertex.count} splats, got {coefficients} for"
            f" {harmonics.count}: export it again"
        )


def unpack(chunk: Columns, vertex: Columns, harmonics: Columns) -> Fields:
    """Return the splats from the columns of the elements, which `check_packed` has checked."""
    count = len(vertex[_PACKED[0]])
    position, rotation, scale, color = (vertex[name].astype(np.uint32) for name in _PACKED)
    channels = np.stack([color >> shift & 255 for shift in (24, 16, 8, 0)], axis=1) / 255
    colors = channels[:, :3]
    if chunk.keys() >= {f"{end}_{name}" for end in ("min", "max") for name in _COLORS}:
        colors = _placed(colors, chunk, _COLORS)
    rest = None
    if harmonics:
        stored = np.stack([harmonics[name] for name in sorted(harmonics, key=_number)], axis=1)
        places = np.where(stored == 0, 0, np.where(stored == 255, 1, (stored + 0.5) / 256))
        rest = (places.reshape(count, 3, -1) - 0.5) * _HARMONICS_RANGE
    return splat_fields(
        _placed(_three(position), chunk, _AXES),
        (colors - 0.5) / SH_DC,
        channels[:, 3],
        _placed(_three(scale), chunk, _SCALES),
        _quaternions(rotation),
        rest,
    )


def _three(packed: NDArray[np.uint32]) -> FloatArray:
    """Return three numbers from 0 to 1 (N, 3) of 11, 10 and 11 bits."""
    return np.stack([(packed >> 21) / 2047, (packed >> 11 & 1023) / 1023, (packed & 2047) / 2047], axis=1)


def _placed(places: FloatArray, chunk: Columns, names: tuple[str, ...]) -> FloatArray:
    """Return values from their places from 0 to 1 (N, 3) within the ranges of their chunks."""
    low, high = (
        np.stack([chunk[f"{end}_{name}"].astype(np.float64) for name in names], axis=1) for end in ("min", "max")
    )
    owner = np.arange(len(places)) // _CHUNK
    values: FloatArray = low[owner] * (1 - places) + high[owner] * places
    return values


def _quaternions(packed: NDArray[np.uint32]) -> FloatArray:
    """Return quaternions (N, 4), w first: the index of the largest number in 2 bits, the others in 10 bits each."""
    largest = packed >> 30
    small = (np.stack([packed >> shift & 1023 for shift in (20, 10, 0)], axis=1) / 1023 - 0.5) * np.sqrt(2)
    rows, values = np.arange(len(packed)), np.empty((len(packed), 4))
    for k in range(3):
        values[rows, k + (k >= largest)] = small[:, k]
    values[rows, largest] = np.sqrt(np.maximum(0, 1 - np.square(small).sum(axis=1)))
    return values


def _number(name: str) -> int:
    digits = name.rpartition("_")[2]
    return int(digits) if digits.isdecimal() and len(digits) < 9 else -1
