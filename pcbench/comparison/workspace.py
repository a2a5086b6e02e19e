"""The workspace of a tiled comparison: a folder with sorted copies and finished tiles, from which a run continues."""

from __future__ import annotations

import json
import shutil
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from pcbench.errors import InputError
from pcbench.regular_files import read_json_object
from pcbench.scratch import OutputInUse, atomic_write, lock_output, make_parents, remove_empty
from pcbench.systems import is_owned_by_user

SCHEMA = "pcbench.workspace/1"
_MAX_EQUAL_RUNS = 100
_MARKER = "workspace.json"


def default_workspaces(out: Path | None, key: str) -> list[Path]:
    """Return the possible workspaces of a comparison without `--workspace`, those with finished parts first.

    Args:
        out: the report folder; the workspace is a hidden folder beside it. None: one in the system's temporary folder,
            of which there are several, because equal comparisons may run at the same time.
        key: identifies the inputs and settings, in hexadecimal.
    """
    if out is not None:
        target = out.resolve()
        return [target.with_name(f".{target.name}.pcbench-tiles")]
    first = Path(tempfile.gettempdir()) / f"pcbench-tiles-{key[:16]}"
    every = [first, *(first.with_name(f"{first.name}-{number}") for number in range(2, _MAX_EQUAL_RUNS + 1))]
    return sorted(every, key=lambda folder: not folder.exists())


@contextmanager
def first_free_workspace(folders: Sequence[Path], key: str, on_notice: Callable[[str], None]) -> Iterator[Path]:
    """Yield the first of several workspaces that no other run uses; see `locked_workspace`."""
    with ExitStack() as stack:
        for folder in folders:
            try:
                workspace = stack.enter_context(locked_workspace(folder, key, on_notice))
                break
            except OutputInUse:
                if folder == folders[-1]:
                    raise
        yield workspace


@contextmanager
def locked_workspace(folder: Path, key: str, on_notice: Callable[[str], None]) -> Iterator[Path]:
    """Lock a workspace and yield it; remove it after success, and keep it if the run fails or is killed.

    The files of a comparison with other inputs or settings are removed first. A folder that existed and was empty
    stays.

    Args:
        folder: the workspace; missing parents are created, and removed again if nothing is kept.
        key: identifies the inputs and settings.
        on_notice: called with one line if files of another comparison are removed, and if a run fails.

    Raises:
        InputError: the folder has other files, belongs to another user, or another run uses it.
        OSError: the folder cannot be written.
    """
    if folder.is_symlink() or (folder.exists() and not folder.is_dir()):
        raise InputError(f"{folder}: expected a folder for the workspace, got a file or a link")
    created = make_parents(folder.absolute().parent)
    try:
        with lock_output(folder):
            yield from _prepared(folder, key, on_notice)
    finally:
        remove_empty(created)


def _prepared(folder: Path, key: str, on_notice: Callable[[str], None]) -> Iterator[Path]:
    """Yield the workspace, marked as that of a comparison, and remove or keep it at the end."""
    keep_folder = folder.is_dir() and not any(folder.iterdir())
    if folder.is_dir():
        _check(folder, key, on_notice)
    else:
        folder.mkdir(0o700)
    with atomic_write(folder / _MARKER) as file:
        file.write(json.dumps({"schema": SCHEMA, "comparison": key}).encode())
    try:
        yield folder
    except BaseException:
        if any(path.is_file() and path.name != _MARKER for path in folder.rglob("*")):
            on_notice(f"the finished parts are kept in {folder}: the same command continues; remove it to start again")
        else:
            _remove(folder, keep_folder)
        raise
    _remove(folder, keep_folder)


def _check(folder: Path, key: str, on_notice: Callable[[str], None]) -> None:
    """Check an existing folder, and empty it if it belongs to another comparison."""
    if not is_owned_by_user(folder.stat()):
        raise InputError(f"{folder}: the workspace belongs to another user: name another one with --workspace")
    marker = read_json_object(folder / _MARKER)
    if marker.get("schema") != SCHEMA:
        if any(folder.iterdir()):
            raise InputError(
                f"{folder}: expected an empty folder or the workspace of an earlier run, got other files: choose"
                " another folder"
            )
    elif marker.get("comparison") != key:
        on_notice(f"{folder} has the parts of a comparison with other inputs or settings: removed them")
        _empty(folder)
    else:
        on_notice(f"continuing with the finished parts in {folder}")


def _remove(folder: Path, keep_folder: bool) -> None:
    if keep_folder:
        _empty(folder)
    else:
        with suppress(OSError):
            _empty(folder)
            folder.rmdir()


def _empty(folder: Path) -> None:
    # The marker is removed last: what an interrupted removal leaves is still known as a workspace.
    for path in sorted(folder.iterdir(), key=lambda path: path.name == _MARKER):
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        else:
            path.unlink()
