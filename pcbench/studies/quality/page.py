"""The article of `pcbench quality`: the answer, all numbers, the maps, and the definitions."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from pcbench.geometry.crs import crs_label
from pcbench.measure.wording import pluralize
from pcbench.report.article import Article, ArticleSection, Block, Bullets, DataTable, Heading, Link, Links, Paragraph
from pcbench.report.words import join_words
from pcbench.studies.frame.pages import drawn_pictures
from pcbench.studies.quality.maps import KINDS, geotiff_name
from pcbench.studies.quality.results import CSV, MAPS, MeasuredCloud, QualityStudy
from pcbench.studies.quality.table import MOST_ROWS, definition_rows, number_rows, strip_rows, void_rows, wall_rows

_CAPTIONS = {
    "density": "Density in plan view; the colours range from the 2nd to the 98th percentile",
    "thickness": "Mean thickness of flat patches: the width along the normal that holds 90 % of their points",
    "voids": "Voids (orange, numbered by area where there is room) and voids at water (blue) on the density (grey)",
}
_COUNTS = {"voids": "void_count", "double_walls": "double_wall_count"}
_LIMITS = (
    "Without a reference, a cloud cannot show errors that are the same everywhere, such as a wrong scale, or drift"
    " where nothing was seen twice.",
    "Noise includes the roughness of the surface itself, such as grass and gravel.",
    "Two parallel sheets can be a real thin wall or board; where the file has normals, sheets that face opposite ways"
    " are not counted.",
    "Values in brackets are 95 % intervals from a bootstrap over blocks of space; counted values have none.",
)


def article(study: QualityStudy, figures: Sequence[str] = ()) -> Article:
    """Return the study as an article; `figures` are the files of its pictures, relative to its folder."""
    names = join_words([cloud.name for cloud in study.clouds])
    sections = [ArticleSection("All numbers", list(_numbers(study)))]
    for cloud in study.clouds:
        blocks = list(_maps(study, cloud, figures))
        if blocks:
            sections.append(ArticleSection("Maps" if study.other is None else f"Maps of {cloud.name}", blocks))
    sections += [
        ArticleSection("What the numbers cannot show", [Bullets(_LIMITS)]),
        ArticleSection(
            "Definitions",
            [DataTable("Definition and source of each number", definition_rows(study), 4)],
            summary="Definition and source of each number",
        ),
    ]
    return Article(
        kind="Quality of a cloud" if study.other is None else "Quality of two clouds",
        title=f"Quality of {names}",
        answer=study.sentences,
        warnings=study.warnings,
        setup=[_setup(cloud) for cloud in study.clouds],
        sections=sections,
    )


def _setup(cloud: MeasuredCloud) -> str:
    system = "an unnamed coordinate system" if cloud.crs is None else crs_label(cloud.crs)
    unit = "an unknown unit" if cloud.unit is None else cloud.unit
    reasons = [
        f"{what.replace('_', ' ')}: {why}"
        for what, why in cloud.reasons.items()
        if what not in _COUNTS or cloud.value(_COUNTS[what]) is None  # the answer says that there are none
    ]
    missing = f" Not measured: {'; '.join(reasons)}." if reasons else ""
    points = int(cloud.value("points") or 0)
    return f"{pluralize(points, 'point')} of {cloud.cloud}, in {system}; lengths in {unit}.{missing}"


def _numbers(study: QualityStudy) -> Iterator[Block]:
    yield DataTable("All numbers", number_rows(study))
    if study.other is not None:
        yield Paragraph("Bold: better, and more than the 95 % intervals explain. Both clouds have the same radius.")
    for cloud in study.clouds:
        title = "" if study.other is None else f" of {cloud.name}"
        for what, rows, count in (
            ("Double walls", wall_rows(cloud), len(cloud.double_walls)),
            ("Voids", void_rows(cloud), len(cloud.voids)),
            ("Overlapping strips", strip_rows(cloud), len(cloud.strips)),
        ):
            if count:
                yield Heading(f"{what}{title}" + (f", the first {MOST_ROWS}" if count > MOST_ROWS else ""))
                yield DataTable(f"{what}{title}", rows)
    yield Links([Link(CSV, CSV)])


def _maps(study: QualityStudy, cloud: MeasuredCloud, figures: Sequence[str]) -> Iterator[Block]:
    captions = {f"{kind}_{cloud.name}": text for kind, text in _CAPTIONS.items()}
    yield from drawn_pictures(figures, captions, *captions)
    files = [f"{MAPS}/{geotiff_name(cloud.name, kind)}" for kind in KINDS]
    if cloud.crs is not None:  # only of projected coordinates; a page leaves out links to missing files
        yield Links([Link(file, file) for file in files])
