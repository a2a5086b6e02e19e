"""Stages: steps of a reconstruction whose results are kept, so that a killed run resumes where it stopped."""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from typing import Any

from pcbench.extras import installed_versions
from pcbench.plugins.code import code_digest
from pcbench.regular_files import open_regular, read_json
from pcbench.scratch import attribute_errors_to

_RECORD_FILE = "stage.json"
# COLMAP increments these counters in the header of a database each time it opens it, even without changes.
_SQLITE, _SQLITE_COUNTERS = b"SQLite format 3\0", (slice(24, 28), slice(92, 96))
_LIBRARIES = ("pcbench", "numpy", "scipy", "pillow", "pycolmap", "torch", "open3d", "pyvista")


def stage(workspace: Path, name: str, inputs: Mapping[str, Any], make: Callable[[Path], None]) -> Path:
    """Return the folder `workspace/name`, filled by `make` if it is missing or outdated.

    A stage is outdated if its inputs or the code differ, or if a file was truncated, changed or removed: the folder
    records the sizes and digests of its files, which are compared at each use.

    Args:
        workspace: an existing folder.
        name: name of the stage.
        inputs: everything that the result depends on, as JSON values: settings, `Scene.fingerprint()`, and `stage_key`
            of earlier stages. `library_versions` is added.
        make: function that fills an empty folder. The folder becomes `workspace/name` when it returns, so a stage that
            was killed is made again from the start.

    Returns:
        The folder.
    """
    folder, temporary = workspace / name, workspace / f".{name}.partial"
    recorded = json.loads(json.dumps({**inputs, "versions": library_versions()}))
    if _is_complete(folder, recorded):
        return folder
    for old in (folder, temporary):
        if old.exists():
            shutil.rmtree(old)
    temporary.mkdir()
    with attribute_errors_to(folder, temporary):
        make(temporary)
        record = {"inputs": recorded, "files": _record_files(temporary)}
        (temporary / _RECORD_FILE).write_text(json.dumps(record, sort_keys=True, indent=1), encoding="utf-8")
    temporary.replace(folder)
    return folder


def library_versions() -> dict[str, str]:
    """Return the versions of libraries that influence results, and the digest of pcbench's and the plugin's code.

    They are inputs of each stage.
    """
    return {"code": code_digest(), **_library_versions()}


@cache
def _library_versions() -> dict[str, str]:
    return installed_versions(_LIBRARIES)


def stage_key(folder: Path) -> str | None:
    """Return the SHA-256 of a stage's inputs and files; None if there is no complete stage."""
    try:
        return hashlib.sha256((folder / _RECORD_FILE).read_bytes()).hexdigest()
    except FileNotFoundError:
        return None


def _is_complete(folder: Path, inputs: Mapping[str, Any]) -> bool:
    """Return whether a stage was made from these inputs and its files are unchanged."""
    try:
        record = read_json(folder / _RECORD_FILE)
        files = [(folder / name, size, digest) for name, (size, digest) in record["files"].items()]
        # Compared as text, in which NaN equals itself. Sizes come first because they are cheap and show truncation.
        return (
            json.dumps(record["inputs"], sort_keys=True) == json.dumps(inputs, sort_keys=True)
            and all(path.stat().st_size == size for path, size, _ in files)
            and all(_digest(path) == digest for path, _, digest in files)
        )
    except (OSError, ValueError, KeyError, TypeError, AttributeError):  # missing or damaged record
        return False


def _record_files(folder: Path) -> dict[str, tuple[int, str]]:
    """Return sizes and digests of a folder's files by name, without links, which point into other stages."""
    files = sorted(path for path in folder.rglob("*") if path.is_file() and not path.is_symlink())
    return {path.relative_to(folder).as_posix(): (path.stat().st_size, _digest(path)) for path in files}


def _digest(path: Path) -> str:
    """Return the SHA-256 of a file; of a database without its change counters."""
    with open_regular(path) as file:
        head = bytearray(file.read(_SQLITE_COUNTERS[-1].stop))
        if head.startswith(_SQLITE):
            for counter in _SQLITE_COUNTERS:
                head[counter] = bytes(len(head[counter]))
        total = hashlib.sha256(head)
        return hashlib.file_digest(file, lambda: total).hexdigest()
