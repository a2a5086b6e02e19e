"""The output folder of a study: recognised by later runs, locked by one run at a time, written atomically.

A study of many runs takes hours. All studies therefore work in the same way:

1. `check_folder` rejects a folder that holds something else before any work starts. `study_folder` locks the folder for
   one run and marks it with `study.json`, which also holds the settings of the last run.
2. Slow results are saved for later runs: as a folder by `pcbench.plugins.stages.stage`, or as a JSON file by
   `write_record`, which `read_record` returns for the same inputs only. A failure that may be temporary (a full disk, a
   missing library) is raised and never saved.
3. `write_results` writes the results for other programs, before anything that may fail is drawn from them.
4. Pictures are drawn, by `draw_if_possible` in a child process or by `draw_here` in this one.
5. `write_report` writes the Markdown file and the page from one article (`pcbench.report.article`).
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pcbench.errors import InputError, PcbenchError, describe_damage, record_error
from pcbench.io.files import atomic_write, read_json, read_json_object
from pcbench.report import to_json
from pcbench.report.article import Article, markdown
from pcbench.report.figures import Figures
from pcbench.report.html import PAGE, Origin, article_page, write_page
from pcbench.report.plot import Drawn, Picture
from pcbench.report.plot.panels import drawing_style, save
from pcbench.scratch import lock_output

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

MARK = "study.json"
FIGURES = "figures"
SCHEMA = "pcbench.study/1"
_KEY = "key"  # in a record: the inputs that its values depend on
_VALUES_DIGEST = "values_sha256"  # in a record: SHA-256 of its other values


@dataclass(frozen=True)
class StudyKind:
    """How to recognise the folders of one kind of study.

    Attributes:
        name: name of the study's command.
        document: file name of its results.
        schema: schema name in that file.
        markdown: file name of its article as Markdown; empty if there is none.
        former_marks: file names that together mark a folder of an earlier version, which wrote no `study.json`.
    """

    name: str
    document: str
    schema: str
    markdown: str = ""
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
        write_files(out, {MARK: json.dumps(mark, indent=1, default=str) + "\n"})
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
        raise InputError(f"{path}: the file is damaged: {describe_damage(error)}: run the study again") from error


def read_record(path: Path, key: Mapping[str, Any]) -> dict[str, Any] | None:
    """Return the values that `write_record` saved for the same inputs, or None if there are none or they changed."""
    try:
        values = read_json(path)
    except (FileNotFoundError, InputError):
        return None
    if not isinstance(values, dict) or values.pop(_KEY, None) != json.loads(json.dumps(key)):
        return None
    return values if values.pop(_VALUES_DIGEST, None) == _values_digest(values) else None


def write_record(path: Path, key: Mapping[str, Any], values: Mapping[str, Any]) -> None:
    """Save values for later runs with the same inputs.

    Args:
        path: JSON file to write.
        key: all inputs that the values depend on, as JSON values.
        values: values to save.

    Raises:
        OSError: the file cannot be written.
    """
    digest = _values_digest(json.loads(to_json(dict(values))))
    write_files(path.parent, {path.name: to_json({_KEY: key, _VALUES_DIGEST: digest, **values})})


def _values_digest(values: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()


def write_files(out: Path, texts: Mapping[str, str]) -> None:
    """Write files by name, each of them atomically. Parts of file names that are not valid Unicode are escaped.

    Raises:
        OSError: a file cannot be written.
    """
    for name, text in texts.items():
        with atomic_write(out / name) as file:
            file.write(text.encode(errors="backslashreplace"))


def write_results(out: Path, kind: StudyKind, texts: Mapping[str, str]) -> None:
    """Write the results of a study as files by name. The page and the Markdown file of earlier ones are deleted first.

    Raises:
        OSError: a file cannot be written or deleted.
    """
    for name in filter(None, (kind.markdown, PAGE)):
        (out / name).unlink(missing_ok=True)
    write_files(out, texts)


def write_report(
    out: Path,
    kind: StudyKind,
    make: Callable[[], Article],
    provenance: Mapping[str, Any] | None,
    inputs: Sequence[tuple[str, str, str]] = (),
) -> str | None:
    """Write the Markdown file and `report.html` of a study, and return why one is missing, or None.

    Args:
        out: folder of the study, with the pictures of the article.
        kind: kind of study.
        make: returns the results of the study as an article.
        provenance: how they were made, see `pcbench.report.document.provenance`.
        inputs: role, path and SHA-256 of each input file.

    Raises:
        OSError: a file cannot be written.
    """
    origin, article = Origin(provenance, inputs=inputs), cache(make)
    pages = {kind.markdown: lambda: markdown(article()), PAGE: lambda: article_page(article(), origin, out)}
    problems = [write_page(out / name, page) for name, page in pages.items() if name]
    return "; ".join(filter(None, problems)) or None


def draw_here(draw: Callable[[], list[Path]]) -> Drawn:
    """Draw pictures in this process; the results do not depend on them.

    Args:
        draw: writes the pictures and returns their files.
    """
    try:
        return Drawn(draw())
    except PcbenchError as error:
        return Drawn([], record_error(error))
    except Exception as error:
        return Drawn([], f"no pictures: drawing failed ({type(error).__name__}: {record_error(error)})")


def save_charts(out: Path, charts: Iterable[tuple[str, Any]]) -> list[Path]:
    """Save matplotlib figures by name as PNG files in `figures/` of a study's folder, and return the files.

    Raises:
        OSError: a file cannot be written.
    """
    figures = out / FIGURES
    figures.mkdir(exist_ok=True)
    files = []
    for name, figure in charts:
        files.append(figures / f"{name}.png")
        with atomic_write(files[-1]) as file:
            figure.savefig(file, format="png")
    return files


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


def delete_former_charts(out: Path, files: Iterable[Path]) -> None:
    """Delete the PNG files in `figures/` of a study's folder that are not among `files`.

    Raises:
        OSError: a file cannot be deleted.
    """
    for former in set((out / FIGURES).glob("*.png")) - set(files):
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
