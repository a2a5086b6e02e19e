"""One cloud from several files: their common coordinate system, and their points one after the other."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcbench.errors import InputError
from pcbench.geometry.cloud import Storage
from pcbench.geometry.crs import crs_argument, crs_name, same_crs
from pcbench.geometry.units import unit_key
from pcbench.io.files import Fields, Warn

_NUMBER = re.compile(r"\d[\d.,]*(e[+-]?\d+)?")
_ATTRIBUTE = "attribute "  # before names of attributes, which may be any text


class StatedCrs(NamedTuple):
    """Coordinate reference system and unit that one file states; None if it states none."""

    path: Path
    crs: str | None
    unit: str | None


def common_crs(stated: Sequence[StatedCrs], warn: Warn) -> tuple[str | None, str | None]:
    """Return the coordinate reference system and the unit of all files that state one.

    Args:
        stated: what each file states.
        warn: callback for warnings, without a path.

    Raises:
        InputError: two files state different ones.
    """
    crs = next((one for one in stated if one.crs is not None), StatedCrs(Path(), None, None))
    unit = next((one for one in stated if one.unit is not None), StatedCrs(Path(), None, None))
    same = {crs.crs, None}  # texts of the same system
    for one in stated:
        if one.crs not in same:
            assert crs.crs is not None and one.crs is not None
            if not same_crs(crs.crs, one.crs):
                raise InputError(
                    f"expected files in one coordinate reference system, got {crs_name(crs.crs)} in {crs.path} and"
                    f" {crs_name(one.crs)} in {one.path}: convert one with pcbench convert FILE OUT --to-crs"
                    f" {crs_argument(crs.crs)}"
                )
            same.add(one.crs)
        if one.unit is not None and unit.unit is not None and unit_key(one.unit) != unit_key(unit.unit):
            raise InputError(
                f"expected files in one unit, got {unit.unit} in {unit.path} and {one.unit} in {one.path}:"
                f" convert one with pcbench convert FILE OUT --to-unit {unit.unit}"
            )
    without = [one for one in stated if one.crs is None]
    if crs.crs is not None and without:
        warn(
            f"{len(without)} of {len(stated)} files state no coordinate reference system, such as"
            f" {without[0].path.name}: their coordinates are taken as {crs_name(crs.crs)}"
        )
    without = [one for one in stated if one.unit is None]
    if unit.unit is not None and without and crs.crs is None:
        warn(
            f"{len(without)} of {len(stated)} files state no unit, such as {without[0].path.name}: their coordinates"
            f" are taken as in {unit.unit}"
        )
    return crs.crs, unit.unit


def merge_warnings(warnings: Iterable[tuple[Path, str]]) -> list[str]:
    """Return warnings as lines that start with the path of a file; those that differ in numbers only become one line.

    Args:
        warnings: files and warnings without a path, in order.
    """
    kinds: dict[str, dict[Path, str]] = {}
    for path, line in warnings:
        kinds.setdefault(_NUMBER.sub("#", line), {}).setdefault(path, line)
    lines = []
    for files in kinds.values():
        path, line = next(iter(files.items()))
        rest = f"; likewise {len(files) - 1} other file{'s' * (len(files) > 2)}" if len(files) > 1 else ""
        lines.append(f"{path}: {line}{rest}")
    return lines


def concatenate(parts: Sequence[Fields], warn: Warn) -> Fields:
    """Concatenate the points of several files; normals, colours and attributes are kept if all files have them.

    Args:
        parts: fields of each file. The coordinate system is left out, see `common_crs`.
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
    return Fields(points=points, normals=normals, colors=colors, attributes=attributes, stored=_common_storage(parts))


def _common_storage(parts: Sequence[Fields]) -> Storage | None:
    """Return the storage of all files if they have equal steps, with the offsets of the first file."""
    storage, *others = (part.get("stored") for part in parts)
    same = storage is not None and all(other is not None and other.steps == storage.steps for other in others)
    return storage if same else None


def normals_warning(count: int, files: int) -> str:
    """Return the warning that only `count` of the files have normals."""
    return f"left out normals, which only {count} of {files} files have"


def _columns(part: Fields) -> dict[str, NDArray[Any]]:
    columns = {"points": part["points"]}
    columns |= {name: array for name in ("normals", "colors") if (array := part.get(name)) is not None}  # type: ignore[misc]
    return columns | {_ATTRIBUTE + name: array for name, array in part.get("attributes", {}).items()}
