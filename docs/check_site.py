"""Check that a built site loads nothing from other hosts: `python docs/check_site.py site`."""

import re
import sys
from pathlib import Path

_LOADING_TAG = re.compile(r"<(?:script|link|img|iframe|source)\b[^>]*?\b(?:src|href)=[\"']?((?:https?:)?//[^\"'> ]+)")
_CSS_URL = re.compile(r"(?:url\(\s*|@import\s+)[\"']?((?:https?:)?//[^\"') ]+)")


def external_resources(text: str) -> list[str]:
    """Return addresses on other hosts that a browser loads for a page or style sheet; links do not count."""
    return _LOADING_TAG.findall(text) + _CSS_URL.findall(text)


def main() -> None:
    """Exit with an error if the site is empty or loads anything from another host."""
    site = Path(sys.argv[1])
    pages = [page for ending in ("*.html", "*.css") for page in sorted(site.rglob(ending))]
    if not pages:
        sys.exit(f"{site}: no pages")
    found = [f"{page}: fetches {address}" for page in pages for address in external_resources(page.read_text())]
    if found:
        sys.exit("\n".join(found))


if __name__ == "__main__":
    main()
