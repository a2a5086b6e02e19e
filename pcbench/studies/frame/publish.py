"""Write what a study found: results for other programs first, then pictures, then the page."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Generic

from pcbench.errors import PcbenchError, record_error
from pcbench.io.json_values import to_json
from pcbench.report.article import Article, markdown
from pcbench.report.html import PAGE, InputRow, Origin, article_page, write_page
from pcbench.report.plot import Drawn
from pcbench.studies.frame.folder import Study, StudyKind, write_files


@dataclass(frozen=True, eq=False)
class StudyOutcome(Generic[Study]):
    """A study whose files are written, and why requested pictures or the page are missing, or None."""

    study: Study
    without_figures: str | None = None
    without_page: str | None = None


def publish(
    out: Path,
    kind: StudyKind[Study],
    study: Study,
    texts: Mapping[str, str],
    draw: Callable[[], Drawn] | None,
    article: Callable[[Sequence[str]], Article],
    provenance: Mapping[str, Any] | None,
    inputs: Sequence[InputRow] = (),
) -> StudyOutcome[Study]:
    """Write the document of a study, its other files, its pictures, its Markdown file and its page.

    Args:
        out: folder of the study.
        kind: kind of study.
        study: its results.
        texts: its other files by name, such as its CSV.
        draw: draws its pictures; None: none are wanted.
        article: returns the study as an article, with the files of its pictures, relative to the folder.
        provenance: how the results were made, see `pcbench.report.document.provenance`.
        inputs: the input files.

    Raises:
        OSError: a file cannot be written.
    """
    write_results(out, kind, {**texts, kind.document: to_json(kind.values(study))})
    drawn = Drawn([]) if draw is None else draw()
    without_page = write_report(out, kind, lambda: article(drawn.relative_to(out)), provenance, inputs)
    return StudyOutcome(study, drawn.problem, without_page)


def write_results(out: Path, kind: StudyKind[Any], texts: Mapping[str, str]) -> None:
    """Write the results of a study as files by name. The page and the Markdown file of earlier ones are deleted first.

    Raises:
        OSError: a file cannot be written or deleted.
    """
    for name in filter(None, (kind.markdown, PAGE)):
        (out / name).unlink(missing_ok=True)
    write_files(out, texts)


def write_report(
    out: Path,
    kind: StudyKind[Any],
    make: Callable[[], Article],
    provenance: Mapping[str, Any] | None,
    inputs: Sequence[InputRow] = (),
) -> str | None:
    """Write the Markdown file and `report.html` of a study, and return why one is missing, or None.

    Args:
        out: folder of the study, with the pictures of the article.
        kind: kind of study.
        make: returns the results of the study as an article.
        provenance: how they were made, see `pcbench.report.document.provenance`.
        inputs: the input files.

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
