"""Parsing of pages and of Markdown tables, and texts that try to break out of pages."""

import json
import re
from html.parser import HTMLParser

PROVENANCE = {
    "version": "1.2",
    "commit": "abc",
    "machine": "a machine",
    "created": "2026-01-01T00:00:00+00:00",
    "command": "pcbench compare ref.ply a.ply --out report",
}
HOSTILE = "</script><img src=x onerror=alert(1)>\"'&\u2028{{ 7 * 7 }}]]>"
_VOID = {"meta", "link", "img", "input", "br", "hr", "col", "source", "wbr"}


class Page(HTMLParser):
    """The elements of a page, its tables, the text of scripts with an id, and the tags whose partner is missing."""

    def __init__(self, text):
        super().__init__(convert_charrefs=True)
        self.tags, self.attributes, self.by_id, self._inside, self.words = [], [], {}, None, []
        self.unbalanced, self._open = [], []
        self.tables = []  # of rows of texts of cells
        self.feed(text)
        self.close()
        self.unbalanced += self._open

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.attributes += attrs
        self._inside = dict(attrs).get("id") if tag == "script" else None
        if tag not in _VOID:
            self._open.append(tag)
        if tag == "table":
            self.tables.append([])
        elif tag == "tr":
            self.tables[-1].append([])
        elif tag in ("td", "th"):
            self.tables[-1][-1].append("")

    def handle_startendtag(self, tag, attrs):
        self.tags.append(tag)
        self.attributes += attrs

    def handle_endtag(self, tag):
        self._inside = None
        if self._open and self._open[-1] == tag:
            self._open.pop()
        else:
            self.unbalanced.append(f"/{tag}")

    def handle_data(self, data):
        self.words.append(data)
        if self._open and self._open[-1] in ("td", "th"):
            self.tables[-1][-1][-1] += data
        if self._inside:
            self.by_id[self._inside] = self.by_id.get(self._inside, "") + data

    @property
    def view(self):
        return json.loads(self.by_id["view-data"])

    def values(self, attribute):
        """Return the values of all attributes of this name."""
        return [value for name, value in self.attributes if name == attribute]


def check_page_of_study(text):
    """Parse the page of a study and check that it is complete, runs nothing and loads nothing; return it."""
    parsed = Page(text)
    assert text.startswith("<!DOCTYPE html>") and parsed.unbalanced == []
    assert not {"script", "link", "iframe", "object", "base", "form"} & set(parsed.tags)
    assert not any(name.startswith("on") or name in ("srcset", "action", "data") for name, _ in parsed.attributes)
    assert all(address.startswith("data:image/png;base64,") for address in parsed.values("src"))
    assert all(address.startswith("./") for address in parsed.values("href"))
    assert re.findall(r"url\(|@import", text) == []
    assert "default-src 'none'; style-src 'unsafe-inline'; img-src data:" in parsed.values("content")
    assert parsed.tags.count("h1") == parsed.tags.count("main") == 1
    ids = parsed.values("id")
    assert len(ids) == len(set(ids)) and set(parsed.values("aria-labelledby")) <= set(ids)
    return parsed


def markdown_tables(text):
    """Return the tables of a Markdown text, as rows of texts of cells without marks."""
    tables, last = [], None
    for number, line in enumerate(text.splitlines()):
        if not line.startswith("|"):
            continue
        cells = [cell.strip().replace("\\|", "|") for cell in re.split(r"(?<!\\)\|", line)[1:-1]]
        if last != number - 1:
            tables.append([])
        last = number
        if not all(re.fullmatch(":?-+:?", cell) for cell in cells):
            tables[-1].append([re.sub(r"^(\*\*|_)(.+)\1$", r"\2", cell) for cell in cells])
    return tables
