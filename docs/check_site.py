"""Check a built site: it loads nothing from other hosts, and each link in it ends at a page: `check_site.py site`."""

import re
import sys
from functools import cache
from html import unescape
from pathlib import Path
from urllib.parse import unquote, urlsplit

_LOADING_TAG = re.compile(r"<(?:script|link|img|iframe|source)\b[^>]*?\b(?:src|href)=[\"']?((?:https?:)?//[^\"'> ]+)")
_CSS_URL = re.compile(r"(?:url\(\s*|@import\s+)[\"']?((?:https?:)?//[^\"') ]+)")
_ADDRESS = re.compile(r"<(?:a|link|img|script|source)\b[^>]*?\s(?:href|src)=[\"']?([^\"'\s>]+)")
_PLACE = re.compile(r"<[a-z][^>]*?\s(?:id|name)=[\"']?([^\"'\s>]+)")


def external_resources(text: str) -> list[str]:
    """Return addresses on other hosts that a browser loads for a page or style sheet; links do not count."""
    return _LOADING_TAG.findall(text) + _CSS_URL.findall(text)


def broken_links(page: Path) -> list[str]:
    """Return the relative addresses of a page that end at no file, or at no place of that name on the page."""
    return [address for address in _addresses(page) if not _is_found(page, address)]


def _addresses(page: Path) -> list[str]:
    return [unescape(address) for address in dict.fromkeys(_ADDRESS.findall(page.read_text()))]


@cache
def _places(page: Path) -> set[str]:
    return {unescape(place) for place in _PLACE.findall(page.read_text())}


def _is_found(page: Path, address: str) -> bool:
    parts = urlsplit(address)
    if parts.scheme or parts.netloc or parts.path.startswith("/"):  # only the page of the error 404 starts at the root
        return True
    target = page.parent / unquote(parts.path) if parts.path else page
    if target.is_dir():
        target /= "index.html"
    if not target.is_file():
        return False
    return not parts.fragment or target.suffix != ".html" or unquote(parts.fragment) in _places(target)


def main() -> None:
    """Exit with an error if the site is empty, loads anything from another host, or has links that end nowhere."""
    site = Path(sys.argv[1])
    pages = sorted(site.rglob("*.html"))
    if not pages:
        sys.exit(f"{site}: no pages")
    styled = [*pages, *sorted(site.rglob("*.css"))]
    found = [f"{page}: fetches {address}" for page in styled for address in external_resources(page.read_text())]
    found += [f"{page}: {address} ends nowhere" for page in pages for address in broken_links(page)]
    if found:
        sys.exit("\n".join(found))


if __name__ == "__main__":
    main()
