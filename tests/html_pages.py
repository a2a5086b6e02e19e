"""Parsing of pages, and texts that try to break out of them."""

import json
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
    """The elements of a page, the text of scripts with an id, and the tags whose partner is missing."""

    def __init__(self, text):
        super().__init__(convert_charrefs=True)
        self.tags, self.attributes, self.by_id, self._inside, self.words = [], [], {}, None, []
        self.unbalanced, self._open = [], []
        self.feed(text)
        self.close()
        self.unbalanced += self._open

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.attributes += attrs
        self._inside = dict(attrs).get("id") if tag == "script" else None
        if tag not in _VOID:
            self._open.append(tag)

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
        if self._inside:
            self.by_id[self._inside] = self.by_id.get(self._inside, "") + data

    @property
    def view(self):
        return json.loads(self.by_id["view-data"])
