"""Stages: steps of a reconstruction whose results are kept, so that a run that was killed goes on where it stopped."""

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
from pcbench.scratch import naming

_KEY = "stage.json"
# COLMAP adds one to these counters in the header of a database whenever it opens it, though it changes nothing.
_SQLITE, _SQLITE_COUNTERS = b"SQLite format 3\0", (slice(24, 28), slice(92, 96))
_LIBRARIES = ("pcbench", "numpy", "scipy", "pillow", "pycolmap", "torch", "open3d", "pyvista")


def stage(workspace: Path, name: str, inputs: Mapping[str, Any], make: Callable[[Path], None]) -> Path:
    """The folder `workspace/name` as `make` fills it; `make` is called only if it was not yet, for other inputs or by
    other code, or if the files are no longer as it left them.

    The sizes and digests of the files are kept in the folder and compared whenever it is used again: a file that was
    cut short, changed or removed makes the stage anew.

    Args:
        workspace: an existing folder.
        name: of the stage.
        inputs: all that its result depends on, as JSON holds it: settings, `Scene.fingerprint()`, and `stage_key` of
            the stages before it; `library_versions` is always one of them. A result is never used again for other
            inputs.
        make: fills the empty folder that it is given. It becomes `workspace/name` once it has returned: a stage that
            was killed half-way is made again from the beginning.

    Returns:
        The folder.
    """
    folder, temporary = workspace / name, workspace / f".{name}.partial"
    recorded = json.loads(json.dumps({**inputs, "versions": library_versions()}))
    if _is_whole(folder, recorded):
        return folder
    for old in (folder, temporary):
        if old.exists():
            shutil.rmtree(old)
    temporary.mkdir()
    with naming(folder, temporary):
        make(temporary)
        record = {"inputs": recorded, "files": _files(temporary)}
        (temporary / _KEY).write_text(json.dumps(record, sort_keys=True, indent=1), encoding="utf-8")
    temporary.replace(folder)
    return folder


def library_versions() -> dict[str, str]:
    """Versions of the libraries that decide what reconstructors do, and the digest of our own code and the plugin's:
    an input of every stage.
    """
    return {"code": code_digest(), **_installed()}


@cache
def _installed() -> dict[str, str]:
    return installed_versions(_LIBRARIES)


def stage_key(folder: Path) -> str | None:
    """SHA-256 of a stage's inputs and files; None where there is no complete stage."""
    try:
        return hashlib.sha256((folder / _KEY).read_bytes()).hexdigest()
    except FileNotFoundError:
        return None


def _is_whole(folder: Path, inputs: Mapping[str, Any]) -> bool:
    """Whether a stage's folder was made of the inputs and holds the files that were made then."""
    try:
        record = json.loads((folder / _KEY).read_text(encoding="utf-8"))
        files = [(folder / name, size, known) for name, (size, known) in record["files"].items()]
        # As text, in which NaN equals itself. Sizes cost nothing and give away a file that was cut short.
        return (
            json.dumps(record["inputs"], sort_keys=True) == json.dumps(inputs, sort_keys=True)
            and all(path.stat().st_size == size for path, size, _ in files)
            and all(_digest(path) == known for path, _, known in files)
        )
    except (OSError, ValueError, KeyError, TypeError, AttributeError):  # no stage, or what is left of one
        return False


def _files(folder: Path) -> dict[str, tuple[int, str]]:
    """Sizes and digests of a folder's files by name; a link's file belongs to another stage."""
    files = sorted(path for path in folder.rglob("*") if path.is_file() and not path.is_symlink())
    return {path.relative_to(folder).as_posix(): (path.stat().st_size, _digest(path)) for path in files}


def _digest(path: Path) -> str:
    """SHA-256 of a file; of a database as if nobody had opened it."""
    with path.open("rb") as file:
        head = bytearray(file.read(_SQLITE_COUNTERS[-1].stop))
        if head.startswith(_SQLITE):
            for counter in _SQLITE_COUNTERS:
                head[counter] = bytes(len(head[counter]))
        whole = hashlib.sha256(head)
        return hashlib.file_digest(file, lambda: whole).hexdigest()
