"""Names and scalings of the fields of points: one table for all readers, and the names that a format can store.

Programs write the same field under many names (Red, r, diffuse_red) and scales (0 to 1, 255 or 65535). Readers rename
their columns with `standard_names`, and turn them into the fields of a cloud with `take_points` and `take_fields`.
Writers rename attributes with `stored_attributes`.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcbench.errors import InputError
from pcbench.geometry.arrays import FloatArray
from pcbench.io.files import Warn

Columns = dict[str, NDArray[Any]]

XYZ = ("x", "y", "z")
NORMALS = ("nx", "ny", "nz")
COLORS = ("red", "green", "blue")
PACKED_COLORS = ("rgb", "rgba")  # alpha, red, green and blue in the four bytes of a number, as in PCD

# Other names, in lower case. Coordinates may have names of different kinds.
_COORDINATES = {
    "x": ("easting", "east", "e", "point_x", "x_coord", "coord_x", "x_coordinate", "rechtswert", "ostwert"),
    "y": ("northing", "north", "n", "point_y", "y_coord", "coord_y", "y_coordinate", "hochwert", "nordwert"),
    "z": ("elevation", "height", "altitude", "elev", "alt", "h", "point_z", "z_coord", "coord_z", "z_coordinate"),
}
_COORDINATES["z"] += ("höhe", "hoehe", "höjd", "hojd")
_COORDINATES = {
    axis: (
        *names,
        f"cartesian{axis}",
        f"position_{axis}",
        f"pos_{axis}",
        f"{axis}coord",
        f"points_{k}",
    )  # E57, ParaView
    for k, (axis, names) in enumerate(_COORDINATES.items())
}
# Normals and colours need three names of one kind: a lone "r" may be a range.
_NORMAL_NAMES = (
    NORMALS,
    ("normal_x", "normal_y", "normal_z"),  # PCL
    ("normalx", "normaly", "normalz"),  # PDAL, Meshroom
    ("nor_normalx", "nor_normaly", "nor_normalz"),  # E57
    ("normal[0]", "normal[1]", "normal[2]"),
    ("n_x", "n_y", "n_z"),
    ("normals_0", "normals_1", "normals_2"),  # ParaView
)
_COLOR_NAMES = (
    COLORS,
    ("r", "g", "b"),
    ("diffuse_red", "diffuse_green", "diffuse_blue"),  # MeshLab
    ("colorred", "colorgreen", "colorblue"),  # E57
    ("color_red", "color_green", "color_blue"),
    ("rf", "gf", "bf"),  # CloudCompare, from 0 to 1
)
_ATTRIBUTES = {
    "intensity": (),
    "classification": ("class",),
    "return_number": ("returnnumber",),
    "number_of_returns": ("numberofreturns",),
    "gps_time": ("gpstime",),
    "point_source_id": ("pointsourceid",),
}
_SCALAR_PREFIX = "scalar_"  # of attributes in the PLY files of CloudCompare
_ATTRIBUTE_NAMES = {alias: name for name, others in _ATTRIBUTES.items() for alias in (name, *others)}
_ATTRIBUTE_NAMES |= {_SCALAR_PREFIX + alias: name for alias, name in _ATTRIBUTE_NAMES.items()}

_MIN_16_BIT_COLOR = 1 << 12  # lower maxima of a type of more than 16 bits are no colours of 16 bits
_MAX_OVERSHOOT = 0.1  # of colours from 0 to 1
_MAX_NORMAL_LENGTH_ERROR = 0.02  # since normals are often written with two digits


def standard_names(names: Sequence[str], taken: Collection[str] = ()) -> list[str]:
    """Return the names of columns with those of coordinates, normals, colours and LAS attributes made standard.

    Upper and lower case are equal. A standard name in `names` keeps its column: of "z" and "height", the second is an
    attribute. The names must be unique, and the returned ones are.

    Args:
        names: names of the columns, in order.
        taken: standard names that no column gets, since the file stores these fields elsewhere.
    """
    present = {*names, *taken}
    plain = [name.lower().replace(" ", "_").replace(":", "_") for name in names]
    renamed: dict[int, str] = {}

    def rename(column: int, name: str) -> None:
        if name == names[column] or name not in (*present, *renamed.values()):
            renamed.setdefault(column, name)

    for name, others in _COORDINATES.items():
        if columns := [plain.index(alias) for alias in (name, *others) if alias in plain]:
            rename(columns[0], name)
    for standard, kinds in ((NORMALS, _NORMAL_NAMES), (COLORS, _COLOR_NAMES)):
        for kind in kinds:
            if not set(kind) <= set(plain):
                continue
            of_kind = [plain.index(alias) for alias in kind]
            if not set(standard) & (present - {names[column] for column in of_kind}):
                renamed |= dict(zip(of_kind, standard, strict=True))
                break
    for column, alias in enumerate(plain):
        if alias in PACKED_COLORS:
            rename(column, alias)
        elif alias in _ATTRIBUTE_NAMES:
            rename(column, _ATTRIBUTE_NAMES[alias])
    return [renamed.get(column, name) for column, name in enumerate(names)]


def repeated_name(names: Iterable[str]) -> str | None:
    """Return the first name that occurs again; None if there is none."""
    return next((name for name, count in Counter(names).items() if count > 1), None)


def other_coordinates(names: Sequence[str]) -> list[str]:
    """Return the columns that could also be x, y and z, beside those that `standard_names` chooses; [] unless all are.

    Args:
        names: names of the columns, which are unique and have x, y and z among them.
    """
    standard = standard_names(names)
    plain = [name.lower().replace(" ", "_").replace(":", "_") for name in names]
    others = [
        next((names[k] for k, alias in enumerate(plain) if alias in (axis, *aliases) and standard[k] != axis), None)
        for axis, aliases in _COORDINATES.items()
    ]
    triple = [name for name in others if name is not None]
    return triple if len(triple) == len(XYZ) else []


class PointFields(NamedTuple):
    """Normals (N, 3), colours (N, 3) and attributes (N,) of points; None if there are none."""

    normals: NDArray[Any] | None
    colors: NDArray[np.uint8] | None
    attributes: Columns


def take_points(columns: Columns) -> FloatArray:
    """Remove the columns x, y, z and return them as float64 (N, 3)."""
    return _take(columns, XYZ, np.float64)


def take_fields(columns: Columns, warn: Warn) -> PointFields:
    """Return the normals, colours and attributes in columns (N,) with standard names, and remove the first two.

    Colours that do not fit a scale of `scale_colors` remain attributes, with a warning.
    """
    return PointFields(take_normals(columns), _take_colors(columns, warn), columns)


def take_normals(columns: Columns) -> FloatArray | None:
    """Remove the columns nx, ny, nz and return them as float64 (N, 3); None if one is missing."""
    return _take(columns, NORMALS, np.float64) if columns.keys() >= set(NORMALS) else None


def scale_colors(channels: Sequence[NDArray[Any]]) -> NDArray[np.uint8] | None:
    """Return red, green and blue (N,) as 8-bit colours (N, 3), or None if they fit no scale.

    Numbers up to 255 are 8-bit colours, and fractions are rounded. Floats that are all from 0 to 1 are multiplied by
    255; some may lie up to a tenth beyond, as interpolated colours do, and are clipped. Larger whole numbers up to
    65535 lose their lower byte, as in LAS.
    """
    low, high = (float(best([best(channel) for channel in channels])) for best in (np.min, np.max))
    dtypes = {channel.dtype for channel in channels}
    is_float = any(dtype.kind == "f" for dtype in dtypes)
    if is_float and (low < 0 or high > 1) and low >= -_MAX_OVERSHOOT and high <= 1 + _MAX_OVERSHOOT:
        channels = [channel.clip(0, 1) for channel in channels]
        low, high = 0, 1
    if not (low >= 0 and high <= 65535):  # NaN too
        return None
    colors = np.empty((len(channels[0]), 3), np.uint8)
    if high <= 255:
        for color, channel in zip(colors.T, channels, strict=True):
            color[:] = np.rint(channel * (255.0 if high <= 1 else 1.0)) if is_float else channel
        return colors
    is_short = all(dtype.kind == "u" and dtype.itemsize == 2 for dtype in dtypes)
    if not is_short and (high < _MIN_16_BIT_COLOR or any((channel != np.floor(channel)).any() for channel in channels)):
        return None
    for color, channel in zip(colors.T, channels, strict=True):
        color[:] = channel.astype(np.uint16) >> 8
    return colors


def unnamed_columns(table: FloatArray, first: int = 1) -> list[str] | None:
    """Return the names of the columns of a table (N, M) that has none: x, y, z, and normals and colours if found.

    Three adjacent columns are normals if all have unit length, and colours if they are whole numbers from 0 to 255 and
    not all 0 or 1. A column after them that is 255 throughout is alpha. Other columns are "column_4", "column_5" ...
    None: there are two places where colours may be.

    Args:
        table: values of the columns, x, y and z first.
        first: number of the first column in the file.
    """
    width = table.shape[1]
    names = [*XYZ, *(f"column_{k}" for k in range(first + 3, first + width))]
    starts = range(3, width - 2)
    with np.errstate(over="ignore", invalid="ignore"):
        normals = [k for k in starts if _are_unit(table[:, k : k + 3])]
    if len(normals) == 1:
        names[normals[0] : normals[0] + 3] = NORMALS
    free = [k for k in starts if not set(names[k : k + 3]) & set(NORMALS)]
    colors = [k for k in free if _are_8_bit(table[:, k : k + 3])]
    if len(colors) == 2 and colors[1] == colors[0] + 1 and (table[:, colors[1] + 2] == 255).all():
        names[colors.pop() + 2] = "alpha"  # trimesh writes opaque points
    if len(colors) > 1:
        return None
    for k in colors:
        names[k : k + 3] = COLORS
    return names


def are_colors(values: FloatArray) -> bool:
    """Return whether three columns (N, 3) are colours rather than normals.

    They are if most have no unit length, and all are whole numbers or from 0 to 1 and fit a scale of `scale_colors`.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        unit = np.abs(np.linalg.norm(values, axis=1) - 1) < _MAX_NORMAL_LENGTH_ERROR
        is_possible = values.max() <= 1 or (values == np.floor(values)).all()
    is_unit = 2 * np.count_nonzero(unit) >= len(unit)
    return bool(is_possible and not is_unit and values.any()) and scale_colors(list(values.T)) is not None


def _are_unit(vectors: FloatArray) -> bool:
    # The first ones suffice for most columns.
    return all(
        bool((np.abs(np.linalg.norm(part, axis=1) - 1) < _MAX_NORMAL_LENGTH_ERROR).all())
        for part in (vectors[:100], vectors)
    )


def _are_8_bit(values: FloatArray) -> bool:
    return bool(
        ((values[:100] >= 0) & (values[:100] <= 255)).all()
        and ((values >= 0) & (values <= 255) & (values == np.floor(values))).all()
        and values.max() > 1
    )


def _take(columns: Columns, names: Sequence[str], dtype: type[np.generic]) -> NDArray[Any]:
    """Remove three columns and return them as one array (N, 3), their only copy."""
    popped = [columns.pop(name) for name in names]
    stacked = np.empty((len(popped[0]), 3), dtype=dtype)
    for axis, column in enumerate(popped):
        stacked[:, axis] = column
    return stacked


def _take_colors(columns: Columns, warn: Warn) -> NDArray[np.uint8] | None:
    if columns.keys() >= set(COLORS):
        channels = [columns[name] for name in COLORS]
        colors = scale_colors(channels)
        if colors is None:
            low, high = min(c.min() for c in channels), max(c.max() for c in channels)
            got = "NaN" if np.isnan(low) else f"{low:g} to {high:g}"
            warn(f"red, green and blue are kept as attributes: expected colours from 0 to 1, 255 or 65535, got {got}")
            return None
        for name in COLORS:
            del columns[name]
        return colors
    packed = next((name for name in PACKED_COLORS if name in columns and _is_packed(columns[name].dtype)), None)
    if packed is None:
        return None
    bits = np.ascontiguousarray(columns.pop(packed))
    if _are_whole_colors(bits):
        warn(f"{packed} is declared as float, but its values are whole numbers: they are read as packed colours")
        bits = np.nan_to_num(bits).astype(np.uint32)
    bits = bits.astype(bits.dtype.newbyteorder("="), copy=False).view(np.uint32)
    return np.stack([bits >> 16 & 255, bits >> 8 & 255, bits & 255], axis=1).astype(np.uint8)


def _are_whole_colors(values: NDArray[Any]) -> bool:
    """Return whether floats are packed colours by their value, as some programs write, not by their four bytes.

    The bytes of 24-bit colours are floats below 1e-37. NaN is black.
    """
    if values.dtype.kind != "f" or not (stated := values[~np.isnan(values)]).size:
        return False
    return bool(((stated >= 0) & (stated < 1 << 24) & (stated == np.floor(stated))).all() and stated.max() >= 1)


def _is_packed(dtype: np.dtype[Any]) -> bool:
    return dtype.itemsize == 4 and dtype.kind in "fui"


# ---- writing ------------------------------------------------------------------------------------------------------


def stored_attributes(
    attributes: Mapping[str, NDArray[Any]],
    form: str,
    warn: Warn,
    *,
    reserved: Collection[str],
    forbidden: str = r"[^!-~]",
    most_bytes: int = 1000,
) -> Columns:
    """Return attributes under names that a format can store; one warning lists those with other names.

    Args:
        attributes: attributes of a cloud.
        form: name of the format.
        warn: callback for the warning.
        reserved: names that attributes must not have, in lower case.
        forbidden: pattern of characters that names must not have; by default all but visible ASCII.
        most_bytes: length of the longest name in bytes.

    Raises:
        InputError: an attribute does not consist of numbers.
    """
    columns: Columns = {}
    renamed = []
    for name, values in attributes.items():
        if values.dtype.kind not in "biuf":
            raise InputError(f"expected attribute {name!r} as numbers, got {values.dtype}: convert or remove it")
        stored = next(
            candidate
            for candidate in _candidates(re.sub(forbidden, "_", name) or "attribute", most_bytes)
            if candidate.lower() not in reserved and candidate not in columns
        )
        if stored != name:
            renamed.append(f"{name[:40]!r} as {stored[:40]!r}")
        columns[stored] = values
    if renamed:
        listed = ", ".join(renamed[:3]) + (f" and {len(renamed) - 3} more" if len(renamed) > 3 else "")
        warn(f"stored under other names what {form} cannot hold under these: {listed}")
    return columns


def left_out_warning(form: str, present: Mapping[str, object]) -> str | None:
    """Return the warning that a format cannot store the fields of a cloud that are given by name and not None."""
    lost = [name[:40] for name, value in present.items() if value is not None]
    listed = ", ".join(lost[:6]) + (f" and {len(lost) - 6} more" if len(lost) > 6 else "")
    return f"left out what {form} cannot store: {listed}" if lost else None


def _candidates(name: str, most_bytes: int) -> Iterator[str]:
    """Yield a name, and then the name with one, two ... underscores; each of at most `most_bytes` bytes."""
    for count in range(most_bytes):
        yield name.encode()[: most_bytes - count].decode(errors="ignore") + "_" * count
