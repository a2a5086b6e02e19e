"""The folder of a study: known again by the next run, kept to one run at a time, its pages written whole.

A study of many runs takes hours, so that all of them work in the same way:

1. `check_folder` refuses a folder of something else before any work, and `study_folder` claims it for one run. It marks
   the folder by `study.json`, which also holds the settings of the last run.
2. What takes long is kept for the next run: as a folder by `pcbench.plugins.stages.stage`, or as a JSON file by
   `write_record`, which `read_record` returns for the same inputs only. A failure that may pass (a full disk, a library
   that is not installed) is raised and never kept.
3. `write_pages` writes the results, the document that others read last.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pcbench.errors import InputError
from pcbench.io.files import atomic_write, json_object, read_json
from pcbench.report import to_json
from pcbench.scratch import claim

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

MARK = "study.json"
SCHEMA = "pcbench.study/1"
_KEY = "key"  # of a record: the inputs that its values depend on


@dataclass(frozen=True)
class StudyKind:
    """What tells the folders of one study from those of others.

    Attributes:
        name: of the study, as its command has it.
        document: the file with its results; schema: what that file says of itself.
        former_marks: names by which earlier versions, which wrote no `study.json`, knew the folder; all of them.
    """

    name: str
    document: str
    schema: str
    former_marks: tuple[str, ...] = ()


def check_folder(out: Path, kind: StudyKind) -> None:
    """Raises:
    InputError: `out` is a file, or a folder that holds something other than this study.
    """
    if out.exists() and not out.is_dir():
        raise InputError(f"{out}: expected a folder for `{kind.name}`, got a file")
    if out.is_dir() and any(out.iterdir()) and not _is_study_folder(out, kind):
        raise InputError(
            f"{out}: the folder is not empty and holds no results of `{kind.name}`: choose another one, or empty it"
        )


@contextmanager
def study_folder(out: Path, kind: StudyKind, settings: DataclassInstance) -> Iterator[None]:
    """Make the folder of a study and keep it to this run.

    Args:
        settings: of the run; `study.json` holds its fields.

    Raises:
        InputError: `out` is something else, or another run is writing there.
        OSError: the folder cannot be written.
    """
    check_folder(out, kind)
    out.absolute().parent.mkdir(parents=True, exist_ok=True)
    with claim(out):
        out.mkdir(exist_ok=True)
        mark = {"schema": SCHEMA, "study": kind.name, "settings": asdict(settings)}
        write_pages(out, {MARK: json.dumps(mark, indent=1, default=str) + "\n"})
        yield


def read_record(path: Path, key: Mapping[str, Any]) -> dict[str, Any] | None:
    """The values that `write_record` wrote for the same inputs; None where there are none."""
    try:
        values = read_json(path)
    except (FileNotFoundError, InputError):
        return None
    if not isinstance(values, dict) or values.pop(_KEY, None) != json.loads(json.dumps(key)):
        return None
    return values


def write_record(path: Path, key: Mapping[str, Any], values: Mapping[str, Any]) -> None:
    """Keep values for the next run with the same inputs.

    Args:
        key: all inputs that the values depend on, as JSON holds them.

    Raises:
        OSError: the file cannot be written.
    """
    write_pages(path.parent, {path.name: to_json({_KEY: key, **values})})


def write_pages(out: Path, texts: Mapping[str, str]) -> None:
    """Write files by name, each of them whole or not at all. File names in their texts need not be Unicode.

    Raises:
        OSError: a file cannot be written.
    """
    for name, text in texts.items():
        with atomic_write(out / name) as file:
            file.write(text.encode(errors="backslashreplace"))


def folders_by_name(paths: Iterable[Path], reserved: Iterable[str] = ()) -> dict[str, Path]:
    """Paths by the names of their folders, numbered where several are alike or are taken already."""
    named: dict[str, Path] = {}
    for path in paths:
        named[unique_name(path.resolve().name or "scene", {*named, *reserved})] = path
    return named


def unique_name(stem: str, reserved: Iterable[str]) -> str:
    """The stem, or with the first number from 2 that makes it unlike all names that are taken."""
    known = set(reserved)
    name, number = stem, 1
    while name in known:
        number += 1
        name = f"{stem}_{number}"
    return name


def _is_study_folder(out: Path, kind: StudyKind) -> bool:
    mark = json_object(out / MARK)
    if mark.get("schema") == SCHEMA:
        return bool(mark.get("study") == kind.name)
    former = bool(kind.former_marks) and all((out / name).exists() for name in kind.former_marks)
    return former or json_object(out / kind.document).get("schema") == kind.schema
