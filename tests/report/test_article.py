"""Articles of studies: Markdown and page from the same content, pictures inside the page, links, hostile texts."""

import base64
import io
import sys
from urllib.parse import quote

import numpy as np
import pytest
from html_pages import HOSTILE, PROVENANCE, Page, check_page_of_study
from optional import import_or_skip

from pcbench.report.article import (
    Article,
    ArticleSection,
    Bullets,
    DataTable,
    Figure,
    Heading,
    Link,
    Links,
    Paragraph,
    TableCell,
    markdown,
)
from pcbench.report.colors import SEQUENTIAL
from pcbench.report.html import Origin, article_page, write_page
from pcbench.report.html.embedding import embed
from pcbench.report.words import one_line

ROWS = [
    ["", "time", TableCell("score")],
    ["one", "1", TableCell("0.5", "best")],
    ["two", "22", TableCell("0.25", "second")],
]


def article(*blocks, **changes):
    values = {"kind": "A study", "title": "A title", "answer": ["It is so.", "And so."], "warnings": ["Not this."]}
    return Article(**{**values, "setup": ["Two runs."], "sections": [ArticleSection("Results", blocks)], **changes})


def page(made, folder="."):
    return article_page(made, Origin(PROVENANCE), folder)


def picture(path, size=(640, 400), seed=None):
    """Write a white picture, or one of noise, which hardly compresses."""
    image = import_or_skip("PIL.Image")
    shape = (size[1], size[0], 3)
    pixels = np.full(shape, 255) if seed is None else np.random.default_rng(seed).integers(0, 256, shape)
    path.parent.mkdir(exist_ok=True)
    image.fromarray(pixels.astype(np.uint8)).save(path)
    return path.read_bytes()


def test_markdown_has_the_answer_first_then_warnings_and_sections():
    made = article(
        Paragraph("Words."), Heading("Part"), Bullets(["a", "b"]), DataTable("t", ROWS), Figure("f.png", "A.")
    )
    assert markdown(made) == (
        "# A title\n\n- It is so.\n- And so.\n\n## What not to trust\n\n- Not this.\n\nTwo runs.\n\n## Results\n\n"
        "Words.\n\n### Part\n\n- a\n- b\n\n|  | time | score |\n| --- | ---: | ---: |\n| one | 1 | **0.5** |\n"
        "| two | 22 | _0.25_ |\n\n![A.](./f.png)\n"
    )
    assert "What not to trust" not in markdown(article(warnings=[]))


def test_the_page_has_the_same_content(tmp_path):
    content = picture(tmp_path / "figures" / "f.png")
    blocks = (
        Paragraph("Words."),
        Heading("Part"),
        Bullets(["a", "b"]),
        DataTable("t", ROWS),
        Figure("figures/f.png", "A."),
    )
    parsed = check_page_of_study(page(article(*blocks), tmp_path))
    words = "".join(parsed.words)
    for text in ("A study", "A title", "It is so.", "And so.", "Not this.", "Two runs.", "Results", "Words.", "Part"):
        assert text in words
    assert parsed.tables == [
        [[str(cell.text if isinstance(cell, TableCell) else cell) for cell in row] for row in ROWS]
    ]
    assert base64.b64decode(parsed.values("src")[0].partition(",")[2]) == content
    assert (parsed.values("width"), parsed.values("height"), parsed.values("alt")) == ((["640"]), ["400"], ["A."])


def test_a_row_with_a_title_alone_starts_a_group():
    rows = [["", "n"], ["city", ""], ["a", "1"], ["b", "2"], ["town", ""], ["a", "3"], ["desert", ""]]
    text = page(article(DataTable("t", rows)))
    parsed = check_page_of_study(text)
    assert text.count('<th scope="rowgroup" colspan="2" class="group">') == text.count("<tbody>") == 3
    assert parsed.tables[0] == [["", "n"], ["city"], ["a", "1"], ["b", "2"], ["town"], ["a", "3"], ["desert"]]


def test_links_are_relative_and_only_to_files_that_exist(tmp_path):
    names = ["a b/report.html", "javascript:alert(1)/report.html", "missing/report.html", "\udcff?#/report.html"]
    for name in names[:2] + names[3:]:
        (tmp_path / name).parent.mkdir()
        (tmp_path / name).touch()
    links = Links([Link(f"to {name}", name) for name in names])
    parsed = check_page_of_study(page(article(links), tmp_path))
    expected = ["./a%20b/report.html", "./javascript%3Aalert%281%29/report.html", "./%FF%3F%23/report.html"]
    assert parsed.values("href") == expected
    assert "<a" not in page(article(Links([Link("x", "missing.html")])), tmp_path)


def test_hostile_texts_stay_text(tmp_path):
    bad = HOSTILE + "\n\u202e"
    picture(tmp_path / "figures" / "f.png")

    def made(text):
        rows = [[text, text], [text, TableCell(text, "best")], [text, ""]]
        blocks = Paragraph(text), Heading(text), Bullets([text]), DataTable(text, rows), Figure("figures/f.png", text)
        return Article(text, text, [text, text], [text], [text], [ArticleSection(text, blocks)])

    text = page(made(bad), tmp_path)
    parsed, plain = check_page_of_study(text), check_page_of_study(page(made("x"), tmp_path))
    assert parsed.tags == plain.tags
    assert "\u202e" not in text and "49" not in "".join(parsed.words)


def test_markdown_of_hostile_texts_has_the_same_elements():
    parser = import_or_skip("markdown_it").MarkdownIt("commonmark").enable("table")

    def tags(text, file):
        rows = [[text, "n"], [text, TableCell(text, "best")]]
        blocks = [Paragraph(text), Heading(text), Bullets([text]), DataTable("t", rows), Figure(file, text)]
        section = ArticleSection(text, [*blocks, Links([Link(text, file)])])
        html = parser.render(markdown(Article("k", text, [text], [text], [text], [section])))
        parsed = Page(html)
        assert parsed.values("src") == parsed.values("href") == [f"./{quote(file)}"]
        return parsed.tags, " ".join(parsed.words)

    plain, _ = tags("x", "f.png")
    for text in (HOSTILE, "a\n\n# b\n- c\u202e", "a](https://example.org) [b](c", "a | b\\<i>", "&lt;b&gt; &#60;"):
        found, words = tags(f"x {text}", "figures/my (1) [s]#?.png")
        assert found == plain
        assert one_line(text) in words


def test_a_section_with_a_summary_is_folded(tmp_path):
    sections = [ArticleSection("Shown", [Paragraph("a")]), ArticleSection("Folded", [Paragraph("b")], "12 lines")]
    made = article(sections=sections)
    parsed = check_page_of_study(page(made))
    assert parsed.tags.count("details") == parsed.tags.count("summary") == 1
    words = [word for word in parsed.words if word.strip()]
    assert words.index("Folded") + 1 == words.index("12 lines") == words.index("b") - 1
    assert "## Folded\n\nb\n" in markdown(made)


def test_empty_parts_leave_nothing_behind():
    parsed = check_page_of_study(page(article(Bullets([]), Links([]), answer=["Only this."], warnings=[], setup=[])))
    assert "ul" not in parsed.tags and "What not to trust" not in "".join(parsed.words)


def test_large_pictures_are_reduced_and_the_caption_names_the_file(tmp_path):
    image = import_or_skip("PIL.Image")
    small = picture(tmp_path / "figures/small.png")
    large = picture(tmp_path / "figures/large.png", (900, 700), seed=1)
    limit = 500_000
    assert len(small) < limit < len(large)
    found = embed(tmp_path, ["figures/large.png", "figures/small.png"], limit)
    assert base64.b64decode(found["figures/small.png"].data.partition(",")[2]) == small
    assert found["figures/small.png"].note == ""
    reduced = base64.b64decode(found["figures/large.png"].data.partition(",")[2])
    assert len(reduced) + len(small) <= limit
    assert found["figures/large.png"].note == "Reduced for this page; as drawn: figures/large.png."
    assert found["figures/large.png"][1:3] == (900, 700)
    with image.open(io.BytesIO(reduced)) as opened:
        assert opened.format == "PNG" and opened.width <= 900
        assert opened.width / opened.height == pytest.approx(9 / 7, rel=0.01)


def test_a_reduced_picture_keeps_the_colors_of_its_color_bar(tmp_path):
    image = import_or_skip("PIL.Image")
    pixels = np.random.default_rng(0).integers(0, 60, (400, 600, 3)).astype(np.uint8)
    pixels[:200, :8] = SEQUENTIAL[np.arange(200) * len(SEQUENTIAL) // 200][:, None]
    image.fromarray(pixels).save(tmp_path / "f.png")
    found = embed(tmp_path, ["f.png"], (tmp_path / "f.png").stat().st_size // 2)["f.png"]
    with image.open(io.BytesIO(base64.b64decode(found.data.partition(",")[2]))) as opened:
        assert opened.size == (600, 400)
        shown = np.asarray(opened.convert("RGB")).astype(int)
    assert np.abs(shown[:200, :8] - pixels[:200, :8]).max() < 25


@pytest.mark.parametrize("is_installed", [True, False])
def test_a_picture_that_stays_too_large_is_named(tmp_path, monkeypatch, is_installed):
    picture(tmp_path / "figures/large.png", (900, 700), seed=1)
    if not is_installed:
        monkeypatch.setitem(sys.modules, "PIL.Image", None)
    found = embed(tmp_path, ["figures/large.png"], 1000)["figures/large.png"]
    assert (found.data, found.note) == ("", "Too large for this page: see the file figures/large.png.")


def test_an_earlier_page_is_replaced_and_does_not_outlive_a_failure(tmp_path):
    path = tmp_path / "report.html"
    assert write_page(path, lambda: "first") is None
    assert write_page(path, lambda: "second\udcff") is None
    assert path.read_bytes() == rb"second\udcff"

    def fail():
        raise KeyError("title")

    assert write_page(path, fail) == "report.html was not written: KeyError: 'title'"
    assert not path.exists()


def test_only_long_words_are_wrapped_and_numbers_keep_their_column():
    cells = {"0.00271 [0.00228, 0.00321] units": False, "-1,234.5 [-1,300, -1,100] m²": False, "no file " * 4: True}
    rows = [["", "value"], *([f"row {k}", text] for k, text in enumerate(cells))]
    made = page(article(DataTable("t", rows)))
    for text, is_long in cells.items():
        assert (f'<td class="long">{text}' in made) == is_long and f">{text}<" in made
