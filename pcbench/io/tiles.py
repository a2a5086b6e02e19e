"""One cloud from several files: their common coordinate system, and their points one after the other."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcbench.errors import InputError
from pcbench.geometry.crs import crs_name, same_crs
from pcbench.io.files import Fields, Warn

_ATTRIBUTE = "attribute "  # before names of attributes, which may be any text


class Frame(NamedTuple):
    """Coordinate reference system and unit that one file states; None if it states none."""

    path: Path
    crs: str | None
    unit: str | None


def common_frame(frames: Sequence[Frame], warn: Warn) -> tuple[str | None, str | None]:
    """Return the coordinate reference system and the unit of all files that state one.

    Args:
        frames: what each file states.
        warn: callback for warnings, without a path.

    Raises:
        InputError: two files state different ones.
    """
    crs = next((frame for frame in frames if frame.crs is not None), None)
    unit = next((frame for frame in frames if frame.unit is not None), None)
    different = set[str]()  # texts that have been compared
    for frame in frames:
        if crs and frame.crs and crs.crs and frame.crs != crs.crs and frame.crs not in different:
            if not same_crs(crs.crs, frame.crs):
                raise InputError(
                    f"expected files in one coordinate reference system, got {crs_name(crs.crs)} in {crs.path} and"
                    f" {crs_name(frame.crs)} in {frame.path}: convert one of them"
                )
            different.add(frame.crs)
        if unit and frame.unit and frame.unit != unit.unit:
            raise InputError(
                f"expected files in one unit, got {unit.unit} in {unit.path} and {frame.unit} in {frame.path}:"
                " convert one of them"
            )
    for found, name in ((crs, "crs"), (unit, "unit")):
        silent = [frame for frame in frames if getattr(frame, name) is None]
        if found is not None and silent:
            what = "coordinate reference system" if name == "crs" else "unit"
            text = crs_name(found.crs or "") if name == "crs" else f"in {found.unit}"
            warn(
                f"{len(silent)} of {len(frames)} files state no {what}, such as {silent[0].path.name}: their"
                f" coordinates are taken as {text}"
            )
    return crs and crs.crs, unit and unit.unit


def concatenate(parts: Sequence[Fields], warn: Warn) -> Fields:
    """Concatenate the points of several files; normals, colours and attributes are kept if all files have them.

    Args:
        parts: fields of each file. The coordinate system is left out, see `common_frame`.
        warn: callback for warnings, without a path.
    """
    columns = [_columns(part) for part in parts]
    everywhere = [name for name in columns[0] if all(name in others for others in columns)]
    if with_normals := sum("normals" in names for names in columns if "normals" not in everywhere):
        warn(normals_warning(with_normals, len(parts)))
    if partial := sorted({name for names in columns for name in names} - {*everywhere, "normals"}):
        listed = ", ".join(name.removeprefix(_ATTRIBUTE) for name in partial)
        warn(f"left out what only some of {len(parts)} files have: {listed}")
    joined = {name: np.concatenate([others[name] for others in columns]) for name in everywhere}
    points, normals, colors = joined.pop("points"), joined.pop("normals", None), joined.pop("colors", None)
    attributes = {name.removeprefix(_ATTRIBUTE): column for name, column in joined.items()}
    return Fields(points=points, normals=normals, colors=colors, attributes=attributes)


def normals_warning(count: int, files: int) -> str:
    """Return the warning that only `count` of the files have normals."""
    return f"left out normals, which only {count} of {files} files have"


def _columns(part: Fields) -> dict[str, NDArray[Any]]:
    columns = {"points": part["points"]}
    columns |= {name: array for name in ("normals", "colors") if (array := part.get(name)) is not None}  # type: ignore[misc]
    return columns | {_ATTRIBUTE + name: array for name, array in part.get("attributes", {}).items()}
