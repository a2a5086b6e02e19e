"""The output folder of a study: recognised by later runs, locked by one run at a time, written atomically."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from pcbench.errors import InputError, describe_damage
from pcbench.io.json_values import from_json, json_values
from pcbench.regular_files import read_json, read_json_object
from pcbench.scratch import atomic_write, lock_output

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

Study = TypeVar("Study")

MARK = "study.json"
SCHEMA = "pcbench.study/1"


@dataclass(frozen=True)
class StudyKind(Generic[Study]):
    """One kind of study: how its folders are recognised, and its document.

    Attributes:
        name: name of the study's command.
        document: file name of its results.
        schema: schema name in that file.
        results: type of its results, whose fields are the keys of the document.
        markdown: file name of its article as Markdown; empty if there is none.
    """

    name: str
    document: str
    schema: str
    results: type[Study]
    markdown: str = ""

    def values(self, study: Study) -> dict[str, Any]:
        """Return a study as JSON values, the content of its document."""
        return {"schema": self.schema, **json_values(study)}

    def read(self, folder: Path) -> Study:
        """Read the study of a folder.

        Raises:
            InputError: the document has another schema or is damaged.
            OSError: it cannot be read.
        """
        values = self.read_values(folder)
        try:
            return from_json(self.results, values)
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            damage = describe_damage(error)
            raise InputError(f"{folder / self.document}: the file is damaged: {damage}: run the study again") from error

    def read_values(self, folder: Path) -> dict[str, Any]:
        """Read the document of a folder as JSON values.

        Raises:
            InputError: it has another schema.
            OSError: it cannot be read.
        """
        values = read_json(folder / self.document)
        if not isinstance(values, dict) or values.get("schema") != self.schema:
            raise InputError(f"{folder / self.document}: expected the schema {self.schema}")
        return values

    def fits(self, folder: Path) -> bool:
        """Return whether a folder holds a study of this kind."""
        mark = read_json_object(folder / MARK)
        return (mark.get("schema"), mark.get("study")) == (SCHEMA, self.name)


def check_folder(out: Path, kind: StudyKind[Any]) -> None:
    """Check that a study of this kind may write to a folder.

    Raises:
        InputError: `out` is a file, or a folder that holds something other than this study.
    """
    if out.exists() and not out.is_dir():
        raise InputError(f"{out}: expected a folder for `{kind.name}`, got a file")
    if out.is_dir() and any(out.iterdir()) and not kind.fits(out):
        raise InputError(
            f"{out}: the folder is not empty and holds no results of `{kind.name}`; choose another folder, or empty it"
        )


@contextmanager
def study_folder(out: Path, kind: StudyKind[Any], settings: DataclassInstance) -> Iterator[None]:
    """Create the folder of a study and lock it for this run.

    Args:
        out: output folder, created if it does not exist.
        kind: kind of study.
        settings: settings of the run, whose fields are written to `study.json`.

    Raises:
        InputError: `out` holds something else, or another run is writing there.
        OSError: the folder cannot be written.
    """
    check_folder(out, kind)
    out.absolute().parent.mkdir(parents=True, exist_ok=True)
    with lock_output(out):
        out.mkdir(exist_ok=True)
        mark = {"schema": SCHEMA, "study": kind.name, "settings": asdict(settings)}
        write_files(out, {MARK: json.dumps(mark, indent=1, default=str) + "\n"})
        yield


def write_files(out: Path, texts: Mapping[str, str]) -> None:
    """Write files by name, each of them atomically. Parts of file names that are not valid Unicode are escaped.

    Raises:
        OSError: a file cannot be written.
    """
    for name, text in texts.items():
        with atomic_write(out / name) as file:
            file.write(text.encode(errors="backslashreplace"))


def folders_by_name(paths: Iterable[Path], reserved: Iterable[str] = ()) -> dict[str, Path]:
    """Return paths by the names of their folders; a number is appended to names that are repeated or reserved."""
    named: dict[str, Path] = {}
    for path in paths:
        named[unique_name(path.resolve().name or "scene", {*named, *reserved})] = path
    return named


def unique_name(stem: str, reserved: Iterable[str]) -> str:
    """Return the stem, or if it is reserved, the stem with the smallest free number from 2 appended."""
    taken = set(reserved)
    name, number = stem, 1
    while name in taken:
        number += 1
        name = f"{stem}_{number}"
    return name
