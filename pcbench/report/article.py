"""Results of a study in words, tables and pictures, from which its Markdown file and its page are written.

A study hands over an `Article`: the answer first, then what not to trust, then sections. Both outputs have the same
sentences and numbers. `pcbench.report.html.article` writes the page.

Texts may contain names of files and messages of other programs. Both writers put each text on one line, and escape what
would be markup.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple
from urllib.parse import quote

from pcbench.report.markup import markdown_table
from pcbench.report.words import one_line

# In Markdown: the start of HTML, the address of a link, an entity, a backslash that would escape the next character.
_MARKDOWN = re.compile(r"<(?=[A-Za-z/!?])|(?<=\])\(|&(?=#?\w+;)|\\(?=[!-/:-@\[-`{-~])")
_BRACKETS = re.compile(r"[\[\]]")

Mark = Literal["", "best", "second"]


class TableCell(NamedTuple):
    """A cell of a table.

    Attributes:
        text: its text.
        mark: whether it is the best or the second-best value of its column or row.
        file: path of the page that it links to, relative to the study's folder; empty for none.
    """

    text: str
    mark: Mark = ""
    file: str = ""


class Link(NamedTuple):
    """A link to another page: its text, and the path of the page relative to the study's folder."""

    text: str
    file: str


@dataclass(frozen=True)
class Paragraph:
    """A paragraph of text."""

    text: str


@dataclass(frozen=True)
class Heading:
    """A heading inside a section."""

    text: str


@dataclass(frozen=True)
class Bullets:
    """A list of sentences."""

    sentences: Sequence[str]


@dataclass(frozen=True)
class DataTable:
    """A table.

    Attributes:
        name: what the table shows, for readers who do not see it.
        rows: the header and the other rows, all with the same number of cells; a row with only a first cell is the
            title of the rows below it.
        labels: number of leading columns with text, which is aligned to the left; numbers are aligned to the right.
        sortable: whether a click on the head of a column of the page sorts the rows that have no title.
    """

    name: str
    rows: Sequence[Sequence[str | TableCell]]
    labels: int = 1
    sortable: bool = False


@dataclass(frozen=True)
class Figure:
    """A picture.

    Attributes:
        file: path of a PNG file, relative to the study's folder.
        caption: what it shows.
    """

    file: str
    caption: str


@dataclass(frozen=True)
class Links:
    """Links to other pages. Those whose file does not exist are left out of the page."""

    links: Sequence[Link]


Block = Paragraph | Heading | Bullets | DataTable | Figure | Links


@dataclass(frozen=True)
class ArticleSection:
    """A section.

    Attributes:
        title: its title.
        blocks: its content.
        summary: text under which a page hides the content until a click; empty to show it.
    """

    title: str
    blocks: Sequence[Block]
    summary: str = ""


@dataclass(frozen=True)
class Article:
    """The results of a study.

    Attributes:
        kind: kind of the study, such as "Stress test".
        title: heading of the page.
        answer: the conclusions, the most important one first.
        warnings: what not to trust: failures, and limits of the results.
        setup: what was run, one or more paragraphs.
        sections: tables, pictures and details.
    """

    kind: str
    title: str
    answer: Sequence[str]
    warnings: Sequence[str]
    setup: Sequence[str]
    sections: Sequence[ArticleSection]


def address(file: str) -> str:
    """Return the relative address of a file; without `./`, a name with a colon would begin with a protocol."""
    return "./" + quote(Path(file).as_posix(), errors="surrogateescape")


def markdown(article: Article) -> str:
    """Return an article as Markdown."""
    parts = [f"# {_text(article.title)}", _bullets(article.answer)]
    if article.warnings:
        parts += ["## What not to trust", _bullets(article.warnings)]
    parts += map(_text, article.setup)
    for section in article.sections:
        parts += [f"## {_text(section.title)}", *_blocks(section.blocks)]
    return "\n\n".join(filter(None, parts)) + "\n"


def _blocks(blocks: Iterable[Block]) -> Iterator[str]:
    for block in blocks:
        match block:
            case Paragraph(text):
                yield _text(text)
            case Heading(text):
                yield f"### {_text(text)}"
            case Bullets(sentences):
                yield _bullets(sentences)
            case DataTable(_, rows, labels, _):
                yield markdown_table(([_cell(cell) for cell in row] for row in rows), labels)
            case Figure(file, caption):
                yield f"!{_link(caption, file)}"
            case Links(links):
                yield "\n".join(f"- {_link(link.text, link.file)}" for link in links)


def _bullets(sentences: Iterable[str]) -> str:
    return "\n".join(f"- {_text(sentence)}" for sentence in sentences)


def _cell(cell: str | TableCell) -> str:
    if isinstance(cell, str):
        return _text(cell)
    emphasis = {"": "", "best": "**", "second": "_"}[cell.mark]
    text = _link(cell.text, cell.file) if cell.file else _text(cell.text)
    return f"{emphasis}{text}{emphasis}"


def _link(text: str, file: str) -> str:
    return f"[{_BRACKETS.sub(_escaped, _text(text))}]({address(file)})"


def _text(text: str) -> str:
    return _MARKDOWN.sub(_escaped, one_line(text))


def _escaped(match: re.Match[str]) -> str:
    return f"\\{match[0]}"
