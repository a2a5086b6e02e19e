"""Stages: steps of a reconstruction whose results are kept, so that a run that was killed goes on where it stopped."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Mapping
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

_KEY = "stage.json"
_LIBRARIES = ("pcbench", "numpy", "pycolmap", "torch", "open3d", "pyvista")


def stage(workspace: Path, name: str, inputs: Mapping[str, Any], make: Callable[[Path], None]) -> Path:
    """The folder `workspace/name` as `make` fills it; `make` is called only if it was not yet, or for other inputs.

    Args:
        workspace: an existing folder.
        name: of the stage.
        inputs: all that its result depends on, as JSON holds it: settings, versions, `Scene.fingerprint()`, and
            `stage_key` of the stages before it. A result is never used again for other inputs.
        make: fills the empty folder that it is given. It becomes `workspace/name` once it has returned: a stage that
            was killed half-way is made again from the beginning.

    Returns:
        The folder.
    """
    folder, temporary = workspace / name, workspace / f".{name}.partial"
    key = json.dumps(dict(inputs), sort_keys=True, indent=1)
    if stage_key(folder) == key:
        return folder
    for old in (folder, temporary):
        if old.exists():
            shutil.rmtree(old)
    temporary.mkdir()
    make(temporary)
    (temporary / _KEY).write_text(key, encoding="utf-8")
    temporary.replace(folder)
    return folder


def library_versions() -> dict[str, str]:
    """Of all that decides what reconstructors do: an input of every stage."""
    found = {}
    for library in _LIBRARIES:
        try:
            found[library] = version(library)
        except PackageNotFoundError:
            continue
    return found


def stage_key(folder: Path) -> str | None:
    """The inputs that a stage's folder was made of, as text; None where there is no complete one."""
    try:
        return (folder / _KEY).read_text(encoding="utf-8")
    except FileNotFoundError:
        return None
