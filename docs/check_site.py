"""Look through a built site for what a browser would fetch from another host: `python docs/check_site.py site`."""

import re
import sys
from pathlib import Path

_FETCHING = re.compile(r"<(?:script|link|img|iframe|source)\b[^>]*?\b(?:src|href)=[\"']?((?:https?:)?//[^\"'> ]+)")
_STYLED = re.compile(r"(?:url\(\s*|@import\s+)[\"']?((?:https?:)?//[^\"') ]+)")


def fetched(text: str) -> list[str]:
    """Addresses of other hosts that a page or a style sheet makes a browser fetch; links to follow are none."""
    return _FETCHING.findall(text) + _STYLED.findall(text)


def main() -> None:
    site = Path(sys.argv[1])
    pages = [page for ending in ("*.html", "*.css") for page in sorted(site.rglob(ending))]
    if not pages:
        sys.exit(f"{site}: no pages")
    found = [f"{page}: fetches {address}" for page in pages for address in fetched(page.read_text())]
    if found:
        sys.exit("\n".join(found))


if __name__ == "__main__":
    main()
