"""Results of a study in words, tables and pictures, from which its Markdown file and its page are written.

A study hands over an `Article`: the answer first, then what not to trust, then sections. Both outputs have the same
sentences and numbers. `pcbench.report.html.article` writes the page.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

from pcbench.report.markup import markdown_table

Mark = Literal["", "best", "second"]


class TableCell(NamedTuple):
    """A cell of a table: its text, and whether it is the best or the second-best value of its column."""

    text: str
    mark: Mark = ""


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
    """

    name: str
    rows: Sequence[Sequence[str | TableCell]]
    labels: int = 1


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


def markdown(article: Article) -> str:
    """Return an article as Markdown."""
    parts = [f"# {article.title}", _bullets(article.answer)]
    if article.warnings:
        parts += ["## What not to trust", _bullets(article.warnings)]
    parts += article.setup
    for section in article.sections:
        parts += [f"## {section.title}", *_blocks(section.blocks)]
    return "\n\n".join(filter(None, parts)) + "\n"


def _blocks(blocks: Iterable[Block]) -> Iterator[str]:
    for block in blocks:
        match block:
            case Paragraph(text):
                yield text
            case Heading(text):
                yield f"### {text}"
            case Bullets(sentences):
                yield _bullets(sentences)
            case DataTable(_, rows, labels):
                yield markdown_table(([_cell(cell) for cell in row] for row in rows), labels)
            case Figure(file, caption):
                yield f"![{caption}]({file})"
            case Links(links):
                yield _bullets([f"[{link.text}]({link.file})" for link in links])


def _bullets(sentences: Iterable[str]) -> str:
    return "\n".join(f"- {sentence}" for sentence in sentences)


def _cell(cell: str | TableCell) -> str:
    if isinstance(cell, str):
        return cell
    around = {"": "", "best": "**", "second": "_"}[cell.mark]
    return f"{around}{cell.text}{around}"
