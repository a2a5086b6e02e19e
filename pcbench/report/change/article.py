"""A measured change as an article: the answer, then pictures, tables and how far the numbers can be trusted."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import PurePath

from pcbench.report.article import (
    Article,
    ArticleSection,
    Block,
    Bullets,
    DataTable,
    Figure,
    Heading,
    Link,
    Links,
    Paragraph,
)
from pcbench.report.change.document import ChangeDocument
from pcbench.report.change.tables import MOST_PARTS, epoch_rows, error_rows, series_rows, volume_rows
from pcbench.report.change.words import (
    answer,
    epoch_text,
    error_sentences,
    extent_sentences,
    system_sentence,
    uncertainty_sentence,
)

SHEETS = "change.pdf"


def article(document: ChangeDocument, figures: Sequence[str] = ()) -> Article:
    """Return a change as an article; `figures` are the files of its pictures, relative to its folder."""
    drawn = {PurePath(file).stem: file for file in figures}
    first, last = epoch_text(document.epochs[0]), epoch_text(document.epochs[-1])
    sections = [ArticleSection("Volumes", list(_volumes(document, drawn)))]
    if profiles := list(_profiles(document, drawn)):
        sections.append(ArticleSection("Profiles", profiles))
    if series := list(_series(document, drawn)):
        sections.append(ArticleSection("Change against time", series))
    sections += [
        ArticleSection("How far the numbers can be trusted", list(_trust(document, drawn))),
        ArticleSection("Epochs and cells", [DataTable("Epochs", epoch_rows(document), 3), *_cells(document)]),
    ]
    return Article(
        kind="Change between epochs",
        title=f"Change from {first} to {last}",
        answer=list(answer(document)),
        warnings=document.warnings,
        setup=[system_sentence(document)],
        sections=sections,
    )


def _volumes(document: ChangeDocument, drawn: dict[str, str]) -> Iterator[Block]:
    for change in document.changes:
        if len(document.changes) > 1:
            yield Heading(f"Since {document.epochs[0].name} until {change.epoch}")
        if picture := drawn.get(f"plan_{change.epoch}"):
            yield Figure(
                picture,
                "Change of height; grey: below the level of detection. Outlines: changed parts with their numbers.",
            )
        yield DataTable(f"Volumes until {change.epoch}", volume_rows(document, change))
        if picture := drawn.get(f"volumes_{change.epoch}"):
            yield Figure(picture, "Volumes with 95 % intervals")
    yield Paragraph(_legend(document))
    files = ["volumes.csv", "parts.geojson", "change.gpkg", *([SHEETS] if PurePath(SHEETS).stem in drawn else [])]
    yield Links([Link(file, file) for file in files])


def _legend(document: ChangeDocument) -> str:
    text = (
        "Fill is the volume of the raised cells, cut that of the lowered ones, net their difference, each with its"
        " 95 % interval. Each changed part counts by the sign of its sum, and so does the rest of an area, because"
        " sums by the sign of each cell would add up its errors. LoD: level of detection."
    )
    if any(change.part_count > MOST_PARTS for change in document.changes):
        text += f" The table has the {MOST_PARTS} largest parts; volumes.csv lists more."
    return text


def _profiles(document: ChangeDocument, drawn: dict[str, str]) -> Iterator[Block]:
    for number, profile in enumerate(document.profiles, 1):
        if picture := drawn.get(f"profile_{number}"):
            ends = ",".join(f"{value:.10g}" for value in profile.line)
            yield Figure(picture, f"Profile {number} along {ends}; grey band: level of detection about the first epoch")


def _series(document: ChangeDocument, drawn: dict[str, str]) -> Iterator[Block]:
    if len(document.changes) < 2 and not document.places:
        return
    if picture := drawn.get("series"):
        yield Figure(picture, "Volumes and chosen places against time, with 95 % intervals")
    yield DataTable("Volumes and places against time", series_rows(document))
    if document.trend is not None:
        if picture := drawn.get("trend"):
            yield Figure(picture, "Trend of each cell; grey: below 1.96 standard errors")
        yield Links([Link("maps/trend.tif", "maps/trend.tif")])


def _trust(document: ChangeDocument, drawn: dict[str, str]) -> Iterator[Block]:
    yield Paragraph(uncertainty_sentence(document))
    for change in document.changes:
        yield Bullets(list(error_sentences(document, change)))
        if picture := drawn.get(f"sigma_{change.epoch}"):
            yield Figure(picture, "Standard deviation of the change of height of each cell, from all errors")
        if change.errors is not None and (change.errors.by_slope or change.errors.by_count):
            yield DataTable(f"Spread of stable cells, {change.epoch}", error_rows(document, change))


def _cells(document: ChangeDocument) -> Iterator[Block]:
    yield Bullets(list(extent_sentences(document)))
    yield Links([Link(f"maps/{change.epoch}.tif", f"maps/{change.epoch}.tif") for change in document.changes])
