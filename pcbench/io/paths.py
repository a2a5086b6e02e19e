"""Find the files of a cloud: one file, a folder of tiles, a pattern, a `.vpc` index, or the folder of a format."""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Collection
from glob import glob, has_magic
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import unquote, urlsplit

from pcbench.errors import InputError
from pcbench.regular_files import decode_text, read_bytes

VPC = ".vpc"
EPT = "ept.json"
_MAX_INDEX_BYTES = 1 << 30
# Beside tiles of other formats, these are usually reports, meshes, data of programs and orthophotos.
_SIDE_FILES = (".csv", ".txt", ".obj", ".glb", ".gltf", ".bin", ".tif", ".tiff")


class TileFiles(NamedTuple):
    """Files of a cloud in the natural order of their names, and warnings without a path."""

    paths: tuple[Path, ...]
    warnings: tuple[str, ...] = ()


def is_pattern(path: Path) -> bool:
    """Return whether a path is a pattern of file names, such as tiles/*.laz, and not the name of a file."""
    return has_magic(str(path)) and not path.exists()


def is_tiled(path: Path) -> bool:
    """Return whether a path names several files: a folder, a pattern, or a `.vpc` index."""
    return path.suffix.lower() == VPC or is_pattern(path) or path.is_dir()


def input_files(path: Path) -> list[Path]:
    """Return the files of a pattern or a `.vpc` index, including the index; a folder or file is returned itself.

    Raises:
        InputError: the index is damaged, or no file matches. The message starts with the path.
    """
    if path.is_dir() or not is_tiled(path):
        return [path]
    try:
        return [*([] if is_pattern(path) else [path]), *find_tiles(path, ()).paths]
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def find_tiles(path: Path, extensions: Collection[str]) -> TileFiles:
    """Return the files of a cloud in a folder, of a pattern, or of a `.vpc` index, in natural order of their names.

    Hidden files, and files of a folder with other extensions, are left out. So are tables, meshes, rasters and .bin
    files of a folder with clouds of other formats, with a warning. Files that differ only in their format give a
    warning.

    Args:
        path: a folder, a pattern or a `.vpc` file.
        extensions: extensions of files with clouds, in lower case.

    Raises:
        InputError: there are no such files, or the index is damaged. The message does not name the path.
        OSError: the folder or the index cannot be read.
    """
    if path.suffix.lower() == VPC and not is_pattern(path):
        return TileFiles(_sorted(_index_files(path)))
    if is_pattern(path):
        matches = _sorted([Path(match) for match in glob(str(path), recursive=True)])  # noqa: PTH207 (Path.glob takes no root)
        if not matches:
            raise InputError("no file matches this pattern: check the name and the folder")
        return TileFiles(matches, _copies_warning(matches))
    files = [file for file in path.iterdir() if file.suffix.lower() in extensions and not file.name.startswith(".")]
    others = [file for file in files if file.suffix.lower() in _SIDE_FILES]
    clouds = [file for file in files if file not in others] or files
    if not clouds:
        raise InputError(
            "expected a folder with point clouds, got none directly inside it: name a file, or a pattern such as"
            " '**/*.laz'"
        )
    copies = _copies_warning(_sorted(clouds))
    if len(clouds) == len(files):
        return TileFiles(_sorted(clouds), copies)
    *some, last = sorted({file.suffix.lower() for file in others})
    kinds = f"{', '.join(some)} and {last}" if some else last
    left_out = f"left out {len(others)} {kinds} files beside other clouds, such as {others[0].name}"
    return TileFiles(_sorted(clouds), (f"{left_out}: name them by a pattern if they are clouds", *copies))


def _copies_warning(paths: Collection[Path]) -> tuple[str, ...]:
    """Return a warning if files have one name in several formats, such as a.las, a.laz and a.copc.laz."""
    names: dict[Path, list[Path]] = {}
    for path in paths:
        names.setdefault(path.with_name(path.stem.removesuffix(".copc")), []).append(path)
    same = [files for files in names.values() if len(files) > 1]
    if not same:
        return ()
    return (
        f"{sum(map(len, same))} files have the name of another one in another format, such as {same[0][0].name} and"
        f" {same[0][1].name}: all are read; if they are copies, name one format by a pattern such as"
        f" '*{same[0][1].suffix}'",
    )


def _sorted(paths: Collection[Path]) -> tuple[Path, ...]:
    return tuple(sorted(paths, key=natural_key))


def natural_key(path: str | Path) -> tuple[list[tuple[int, str]], str]:
    """Return a key that sorts numbers in names by value, so that tile_2 comes before tile_10."""
    parts = re.split(r"(\d+)", str(path))
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in parts], str(path)


def _index_files(path: Path) -> list[Path]:
    """Return the files that a virtual point cloud (`.vpc`) names: a GeoJSON collection of STAC items with assets."""
    try:
        index = json.loads(decode_text(read_bytes(path, _MAX_INDEX_BYTES)))
        hrefs = [asset["href"] for item in index["features"] for asset in item["assets"].values() if _is_data(asset)]
    except InputError:
        raise
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        raise InputError("expected a .vpc file with features and assets, got something else: create it again") from None
    if not hrefs or not all(isinstance(href, str) and href for href in hrefs):
        raise InputError("expected a .vpc file that names point clouds, got none: create it again")
    files = [_local(path.parent, href) for href in hrefs]
    if repeated := [file for file, count in Counter(files).items() if count > 1]:
        raise InputError(f"expected each file once, got {repeated[0]} more than once: create the index again")
    return files


def _is_data(asset: Any) -> bool:
    roles = asset.get("roles") or ["data"]  # QGIS adds overviews, with the role "overview"
    return "data" in roles


def _local(folder: Path, href: str) -> Path:
    """Return the path of an asset, which is relative to the folder of its index."""
    parts = urlsplit(href)
    if parts.scheme == "file":
        return Path(unquote(parts.path))
    if len(parts.scheme) > 1:  # one letter is a drive
        raise InputError(f"expected files on this computer, got {href[:80]}: download them and create the index again")
    return folder / href
