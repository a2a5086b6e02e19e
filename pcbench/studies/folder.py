"""The output folder of a study: recognised by later runs, locked by one run at a time, written atomically.

A study of many runs takes hours. All studies therefore work in the same way:

1. `check_folder` rejects a folder that holds something else before any work starts. `study_folder` locks the folder for
   one run and marks it with `study.json`, which also holds the settings of the last run.
2. Slow results are saved for later runs: as a folder by `pcbench.plugins.stages.stage`, or as a JSON file by
   `write_record`, which `read_record` returns for the same inputs only. A failure that may be temporary (a full disk, a
   missing library) is raised and never saved.
3. `save_charts` and `write_results` write the results. The document that other programs read is written last.
4. `write_report` writes the page, which shows the same article as the Markdown file (`pcbench.report.article`).
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pcbench.errors import InputError, MissingExtra, record_error
from pcbench.io.files import atomic_write, read_json, read_json_object
from pcbench.report import to_json
from pcbench.report.article import Article
from pcbench.report.figures import Figures
from pcbench.report.html import PAGE, Origin, article_page, write_page
from pcbench.report.plot import Picture
from pcbench.report.plot.panels import drawing_style, save
from pcbench.scratch import lock_output

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

MARK = "study.json"
FIGURES = "figures"
SCHEMA = "pcbench.study/1"
_KEY = "key"  # in a record: the inputs that its values depend on


@dataclass(frozen=True)
class StudyKind:
    """How to recognise the folders of one kind of study.

    Attributes:
        name: name of the study's command.
        document: file name of its results.
        schema: schema name in that file.
        former_marks: file names that together mark a folder of an earlier version, which wrote no `study.json`.
    """

    name: str
    document: str
    schema: str
    former_marks: tuple[str, ...] = ()


def check_folder(out: Path, kind: StudyKind) -> None:
    """Check that a study of this kind may write to a folder.

    Raises:
        InputError: `out` is a file, or a folder that holds something other than this study.
    """
    if out.exists() and not out.is_dir():
        raise InputError(f"{out}: expected a folder for `{kind.name}`, got a file")
    if out.is_dir() and any(out.iterdir()) and not _is_study_folder(out, kind):
        raise InputError(
            f"{out}: the folder is not empty and holds no results of `{kind.name}`; choose another folder, or empty it"
        )


@contextmanager
def study_folder(out: Path, kind: StudyKind, settings: DataclassInstance) -> Iterator[None]:
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
        write_pages(out, {MARK: json.dumps(mark, indent=1, default=str) + "\n"})
        yield


@contextmanager
def study_document(path: Path, schema: str) -> Iterator[dict[str, Any]]:
    """Read the document of a study; errors of the block that interprets its values mean that the file is damaged.

    Raises:
        InputError: the file has another schema or is damaged.
        OSError: the file cannot be read.
    """
    values = read_json(path)
    if not isinstance(values, dict) or values.get("schema") != schema:
        raise InputError(f"{path}: expected the schema {schema}")
    try:
        yield values
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise InputError(f"{path}: the file is damaged: {type(error).__name__}: {error}") from error


def read_record(path: Path, key: Mapping[str, Any]) -> dict[str, Any] | None:
    """Return the values that `write_record` saved for the same inputs, or None."""
    try:
        values = read_json(path)
    except (FileNotFoundError, InputError):
        return None
    if not isinstance(values, dict) or values.pop(_KEY, None) != json.loads(json.dumps(key)):
        return None
    return values


def write_record(path: Path, key: Mapping[str, Any], values: Mapping[str, Any]) -> None:
    """Save values for later runs with the same inputs.

    Args:
        path: JSON file to write.
        key: all inputs that the values depend on, as JSON values.
        values: values to save.

    Raises:
        OSError: the file cannot be written.
    """
    write_pages(path.parent, {path.name: to_json({_KEY: key, **values})})


def write_pages(out: Path, texts: Mapping[str, str]) -> None:
    """Write files by name, each of them atomically. Parts of file names that are not valid Unicode are escaped.

    Raises:
        OSError: a file cannot be written.
    """
    for name, text in texts.items():
        with atomic_write(out / name) as file:
            file.write(text.encode(errors="backslashreplace"))


def write_results(out: Path, texts: Mapping[str, str]) -> None:
    """Write the results of a study as files by name. The page of earlier results is deleted first.

    Raises:
        OSError: a file cannot be written or deleted.
    """
    (out / PAGE).unlink(missing_ok=True)
    write_pages(out, texts)


def write_report(
    out: Path, article: Article, provenance: Mapping[str, Any] | None, inputs: Sequence[tuple[str, str, str]] = ()
) -> str | None:
    """Write `report.html` of a study, and return the reason if that fails; all other files do not depend on it.

    Args:
        out: folder of the study, with the pictures of the article.
        article: results of the study.
        provenance: how they were made, see `pcbench.report.document.provenance`.
        inputs: role, path and SHA-256 of each input file.

    Raises:
        OSError: the file cannot be written.
    """
    origin = Origin(provenance, inputs=inputs)
    return write_page(out / PAGE, lambda: article_page(article, origin, out))


def draw_if_installed(draw: Callable[[], list[str]]) -> tuple[list[str], str | None]:
    """Draw charts; return their file names, and if a library for them is not installed, the error, else None."""
    try:
        return draw(), None
    except MissingExtra as error:
        return [], record_error(error)


def save_charts(out: Path, charts: Iterable[tuple[str, Any]]) -> list[str]:
    """Save matplotlib figures by name as PNG files in `figures/` of a study's folder, and return their file names.

    Raises:
        OSError: a file cannot be written.
    """
    figures = out / FIGURES
    figures.mkdir(exist_ok=True)
    names = []
    for name, figure in charts:
        with atomic_write(figures / f"{name}.png") as file:
            figure.savefig(file, format="png")
        names.append(f"{name}.png")
    return names


def chart_pictures(charts: Callable[[], Iterable[tuple[str, Any]]], look: Figures) -> dict[str, Picture]:
    """Return matplotlib figures by name as pictures for `pcbench plot`.

    Args:
        charts: function that creates the figures, in the appearance `look`.
        look: appearance of the pictures.
    """

    def picture(figure: Any) -> Picture:
        def draw(path: Path) -> bool:
            save(figure, path)
            return True

        return Picture(draw)

    with drawing_style(look):
        return {name: picture(figure) for name, figure in charts()}


def delete_former_charts(out: Path, names: Iterable[str]) -> None:
    """Delete the PNG files in `figures/` of a study's folder whose names are not among `names`.

    Raises:
        OSError: a file cannot be deleted.
    """
    current = set(names)
    for former in (out / FIGURES).glob("*.png"):
        if former.name not in current:
            former.unlink()


def folders_by_name(paths: Iterable[Path], reserved: Iterable[str] = ()) -> dict[str, Path]:
    """Return paths by the names of their folders; a number is appended to names that are repeated or reserved."""
    named: dict[str, Path] = {}
    for path in paths:
        named[unique_name(path.resolve().name or "scene", {*named, *reserved})] = path
    return named


def unique_name(stem: str, reserved: Iterable[str]) -> str:
    """Return the stem, or if it is reserved, the stem with the smallest free number from 2 appended."""
    known = set(reserved)
    name, number = stem, 1
    while name in known:
        number += 1
        name = f"{stem}_{number}"
    return name


def _is_study_folder(out: Path, kind: StudyKind) -> bool:
    mark = read_json_object(out / MARK)
    if mark.get("schema") == SCHEMA:
        return bool(mark.get("study") == kind.name)
    former = bool(kind.former_marks) and all((out / name).exists() for name in kind.former_marks)
    return former or read_json_object(out / kind.document).get("schema") == kind.schema
