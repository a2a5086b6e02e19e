"""Fields of clouds as data arrays of pyvista: normals, colours, attributes, coordinate system and unit."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pcbench.errors import InputError
from pcbench.geometry.arrays import FloatArray

_NORMALS, _COLORS = "Normals", "RGB"  # the names that VTK's readers and ParaView use
_COLOR_NAMES = (_COLORS, "RGBA", "rgb", "rgba", "Colors", "colors")
_FRAME = ("crs", "unit")


def add(
    data: Any,
    normals: FloatArray | None,
    colors: NDArray[np.uint8] | None,
    attributes: Mapping[str, NDArray[Any]],
    *,
    crs: str | None,
    unit: str | None,
) -> None:
    """Add the fields of a cloud to a `pyvista.PolyData` of its points.

    Raises:
        InputError: an attribute has the name of the normals or the colours.
    """
    if taken := [name for name in attributes if name in (_NORMALS, _COLORS)]:
        raise InputError(f"expected attributes with other names than {_NORMALS} and {_COLORS}, got {taken[0]!r}")
    for name, values in attributes.items():
        # VTK has no half-precision numbers.
        data.point_data.set_array(np.array(values, np.float32 if values.dtype == np.float16 else None), name)
    if normals is not None:
        data.point_data.active_normals = normals.copy()
    if colors is not None:
        data.point_data.set_scalars(colors.copy(), _COLORS)
    add_frame(data, crs=crs, unit=unit)


def add_frame(data: Any, *, crs: str | None, unit: str | None) -> None:
    """Add the coordinate system and the unit as field data."""
    for name, text in zip(_FRAME, (crs, unit), strict=True):
        if text is not None and text.isascii():  # VTK's field data hold no other text
            data.field_data[name] = [text]


def fields(data: Any) -> dict[str, Any]:
    """Return points, normals, colours, attributes, coordinate system and unit as arguments of `Cloud`.

    Colours are an array RGB or RGBA (or Colors), or the active scalars if they are bytes (N, 3) or (N, 4); numbers from
    0 to 1 become integers from 0 to 255. Other arrays with one number per point become attributes.

    Raises:
        InputError: the data have no points.
    """
    if not hasattr(data, "points") or not hasattr(data, "point_data"):
        raise InputError(f"expected a pyvista data set with points, got {type(data).__name__}")
    arrays = {name: np.array(values) for name, values in data.point_data.items()}
    normals = arrays.pop(data.point_data.active_normals_name or _NORMALS, None)
    named = [name for name in (*_COLOR_NAMES, data.point_data.active_scalars_name) if _holds_colors(arrays, name)]
    colors = arrays.pop(named[0])[:, :3] if named else None
    if colors is not None and colors.dtype.kind == "f":
        colors = np.round(255 * colors)
    return {
        "points": np.array(data.points, np.float64),
        "normals": normals,
        "colors": colors,
        "attributes": {name: values for name, values in arrays.items() if name and values.ndim == 1},
        **frame(data),
    }


def frame(data: Any) -> dict[str, str]:
    """Return the coordinate system and the unit, as far as they are in the field data."""
    return {name: str(data.field_data[name][0]) for name in _FRAME if len(data.field_data.get(name, ()))}


def _holds_colors(arrays: Mapping[str, NDArray[Any]], name: str | None) -> bool:
    array = arrays.get(name or "")
    if array is None or array.ndim != 2 or array.shape[1] not in (3, 4):
        return False
    return array.dtype == np.uint8 or (array.dtype.kind == "f" and name in _COLOR_NAMES)
