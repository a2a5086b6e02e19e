"""The page of a study: its article with the pictures inside."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

from pcbench.report.article import (
    Article,
    Block,
    Bullets,
    DataTable,
    Figure,
    Heading,
    Links,
    Paragraph,
    TableCell,
    address,
)
from pcbench.report.html.embedding import EmbeddedPicture, embed
from pcbench.report.html.template import Opening, Origin, one_line_each, render, source

_LONG_TEXT = 24  # letters from which the text of a cell is wrapped
_NUMBER = re.compile(r"[-−+]?[\d.,]+(e[-+]\d+)?( \[[^\]]*\])?( \S+)?")  # with its interval and unit


def article_page(article: Article, origin: Origin, folder: Path) -> str:
    """Return the page of a study.

    Args:
        article: results of the study.
        origin: how they were made.
        folder: folder of the study, with the pictures of the article and the pages that it links to.

    Raises:
        OSError: a picture cannot be read.
    """
    files = [block.file for section in article.sections for block in section.blocks if isinstance(block, Figure)]
    pictures = embed(folder, files)
    opening = Opening(article.kind, article.title, "", article.answer, article.warnings)
    tables = [block for section in article.sections for block in section.blocks if isinstance(block, DataTable)]
    sections = [
        {
            "title": section.title,
            "summary": section.summary,
            "blocks": [values for block in section.blocks for values in _block(block, folder, pictures)],
        }
        for section in article.sections
    ]
    return render(
        "article.html",
        opening,
        origin,
        script=source("sorting.js") if any(table.sortable for table in tables) else "",
        article_style=source("article.css"),
        setup=one_line_each(article.setup),
        sections=sections,
    )


def _block(block: Block, folder: Path, pictures: dict[str, EmbeddedPicture]) -> Iterator[dict[str, Any]]:
    """Yield the values of a block for the template; none for one without content."""
    match block:
        case Paragraph(text):
            yield {"kind": "paragraph", "text": text}
        case Heading(text):
            yield {"kind": "heading", "text": text}
        case Bullets(sentences):
            if sentences:
                yield {"kind": "bullets", "sentences": one_line_each(sentences)}
        case Figure(file, caption):
            yield {"kind": "picture", "caption": caption, **pictures[file]._asdict()}
        case Links(links):
            if there := [link for link in links if (folder / link.file).is_file()]:
                yield {"kind": "links", "links": [{"text": link.text, "address": address(link.file)} for link in there]}
        case DataTable():
            yield {"kind": "table", "name": block.name, "sortable": block.sortable, **_table(block)}


class _StyledCell(NamedTuple):
    text: str
    style: str
    address: str = ""


def _table(table: DataTable) -> dict[str, Any]:
    """Return the header of a table, and its rows in groups that have a title if a row is a title alone."""
    head, *rows = [[cell if isinstance(cell, TableCell) else TableCell(cell) for cell in row] for row in table.rows]
    groups: list[dict[str, Any]] = []
    for is_title, group in groupby(rows, key=lambda row: len(row) > 1 and not any(cell.text for cell in row[1:])):
        if is_title:
            groups += [{"title": row[0].text, "rows": []} for row in group]
        elif groups and not groups[-1]["rows"]:
            groups[-1]["rows"] = _styled(group, table.labels)
        else:
            groups.append({"title": "", "rows": _styled(group, table.labels)})
    heads = [_StyledCell(cell.text, "text" if k < table.labels else "") for k, cell in enumerate(head)]
    return {"head": heads, "groups": groups}


def _styled(rows: Iterator[Sequence[TableCell]], labels: int) -> list[list[_StyledCell]]:
    return [
        [
            _StyledCell(cell.text, _style(cell, k < labels), cell.file and address(cell.file))
            for k, cell in enumerate(row)
        ]
        for row in rows
    ]


def _style(cell: TableCell, is_label: bool) -> str:
    is_long = len(cell.text) > _LONG_TEXT and (is_label or not _NUMBER.fullmatch(cell.text))
    classes = ("text" if is_label else "", "long" if is_long else "", cell.mark)
    return " ".join(filter(None, classes))
