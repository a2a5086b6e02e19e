"""The manifest of a report folder, and the replacement of a report by a new one.

`manifest.json` lists the files that pcbench wrote. The next report replaces or removes only these; other files belong
to the user. A new report is built in a temporary folder, and one rename moves that into the folder of the old report.
From then on the new report is valid. Its files are moved last; after an interruption the next reader or run moves them.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path, PurePosixPath
from typing import Any

from pcbench.errors import InputError
from pcbench.regular_files import read_json_object
from pcbench.scratch import atomic_write

MANIFEST = "manifest.json"
SCHEMA = "pcbench.manifest/1"
FIGURES = "figures"
MAPS = "maps"  # folder of rasters of the distances, and of all points of a comparison in tiles
_PENDING = ".pcbench-replacement"  # a complete new report whose files are still to be moved


def is_report(folder: Path) -> bool:
    """Return whether the folder has a report."""
    return _listed_files(folder / MANIFEST) is not None


def check_figures_folder(folder: Path) -> None:
    """Check that pictures and map files can be written into the folders `figures` and `maps` of a report.

    Raises:
        InputError: one of them is a link or a file, or `maps` has a link.
    """
    for inner, content in ((folder / FIGURES, "pictures"), (folder / MAPS, "maps")):
        if inner.is_symlink():
            raise InputError(f"{inner}: expected a folder, got a link: remove it, or choose another report folder")
        if inner.exists() and not inner.is_dir():
            raise InputError(
                f"{inner}: expected a folder for {content}, got a file: rename it, or choose another folder"
            )
    for path in (folder / MAPS).glob("*"):
        if path.is_symlink():
            raise InputError(f"{path}: expected no link among the maps: remove it, or choose another report folder")


def replace_report(scratch: Path, out: Path) -> None:
    """Replace the report in `out` by the complete report in `scratch`, a folder beside it.

    Raises:
        InputError: a file that no report wrote has the name of a new one; nothing was changed.
        OSError: a file cannot be moved. If the new report is in `out` already, `complete_replacement` continues.
    """
    new = {path.relative_to(scratch).as_posix() for path in scratch.rglob("*") if path.is_file()}
    _write(scratch / MANIFEST, new)
    if not out.exists():
        scratch.rename(out)
        return
    _check_free(out, new | {MANIFEST}, _listed_files(out / MANIFEST) or set())
    scratch.rename(out / _PENDING)
    complete_replacement(out)


def complete_replacement(folder: Path) -> None:
    """Move the files of a new report into its folder, if the run that wrote it could not finish this.

    Raises:
        InputError: a file that no report wrote has the name of one of them.
        OSError: a file cannot be moved.
    """
    pending = folder / _PENDING
    if not pending.is_dir():
        return
    new, own = _listed_files(pending / MANIFEST), _listed_files(folder / MANIFEST) or set()
    if new is not None:
        remaining = {name for name in new if (pending / name).is_file()}
        try:
            _check_free(folder, remaining, own)
        except InputError:
            if remaining == {name for name in new if (pending / name).is_file()}:
                raise
            return complete_replacement(folder)  # another process is moving them
        for name in sorted(own - new):
            if not (folder / name).is_dir():
                (folder / name).unlink(missing_ok=True)
        for name in [*sorted(remaining), MANIFEST]:  # the manifest last: until then the old one lists the old files
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            with suppress(FileNotFoundError):  # another process has completed it
                (pending / name).replace(folder / name)
    inner = {parent for name in own | (new or set()) for parent in PurePosixPath(name).parents if parent.name}
    deepest_first = sorted({PurePosixPath(FIGURES), *inner}, key=lambda path: -len(path.parts))
    for empty in (*(pending / path for path in deepest_first), pending, *(folder / path for path in deepest_first)):
        with suppress(OSError):
            empty.rmdir()


def record_files(folder: Path, names: Iterable[str]) -> None:
    """Add files to the manifest of a report, if it has one."""
    listed = _listed_files(folder / MANIFEST)
    if listed is not None and not (added := set(names)) <= listed:
        _write(folder / MANIFEST, listed | added)


def _check_free(folder: Path, names: Iterable[str], own: set[str]) -> None:
    check_figures_folder(folder)
    for name in sorted(names):
        path = folder / name
        if os.path.lexists(path) and (path.is_dir() or name not in own | {MANIFEST}):
            raise InputError(
                f"{path}: the new report has a file with this name: rename yours, or choose another folder"
            )
    if os.path.lexists(folder / MANIFEST) and _listed_files(folder / MANIFEST) is None:
        raise InputError(
            f"{folder / MANIFEST}: expected the manifest of a report: rename this file, or choose another folder"
        )


def _listed_files(manifest: Path) -> set[str] | None:
    """Return the files in a manifest; None if it is missing or invalid."""
    values = read_json_object(manifest)
    files = values.get("files")
    if values.get("schema") != SCHEMA or not isinstance(files, list):
        return None
    return {name for name in files if _is_inside(name)}


def _is_inside(name: Any) -> bool:
    """Return whether a name is that of a file in a report folder, its `figures` or `maps`; a manifest may be forged."""
    if not isinstance(name, str) or "\0" in name:
        return False
    parts = PurePosixPath(name).parts
    if not parts or name != "/".join(parts) or ".." in parts or parts[0] == "/":
        return False
    depth = {FIGURES: 2, MAPS: 3}.get(parts[0], 1)
    return len(parts) <= depth


def _write(manifest: Path, names: Iterable[str]) -> None:
    with atomic_write(manifest) as file:
        file.write((json.dumps({"schema": SCHEMA, "files": sorted(names)}, indent=1) + "\n").encode())
