"""The site that `make docs` builds: complete, and nothing in it is fetched from another host when it is read."""

import os
import re
import subprocess
import sys

import pytest
from repository import ROOT

import pcbench


def test_every_name_of_the_package_is_in_the_reference():
    page = (ROOT / "docs" / "reference" / "index.md").read_text()
    listed = re.findall(r"^        - (\w+)$", page, re.MULTILINE)
    assert sorted(listed) == sorted(set(pcbench.__all__) - {"__version__"})


def test_every_room_has_a_page_in_the_reference():
    rooms = {folder.parent.name for folder in (ROOT / "pcbench").glob("*/__init__.py")} - {"cli", "native"}
    pages = {page.stem for page in (ROOT / "docs" / "reference").glob("*.md")}
    assert rooms <= pages


def test_the_site_asks_no_other_host(tmp_path):
    """Strictly built: a link between pages or to a name of the API that leads nowhere fails."""
    pytest.importorskip("mkdocstrings_handlers.python")
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--quiet", "--strict", "--site-dir", str(tmp_path)],
        cwd=ROOT,
        env={**os.environ, "NO_MKDOCS_2_WARNING": "1", "NO_COLOR": "1"},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    pages = list(tmp_path.rglob("*.html"))
    assert len(pages) > 20
    for page in pages:
        fetched = re.findall(
            r"<(?:script|link|img|iframe|source)\b[^>]*?(?:src|href)=[\"']?((?:https?:)?//[^\"'> ]+)", page.read_text()
        )
        assert not fetched, f"{page.relative_to(tmp_path)} fetches {fetched[0]}"
    for style in tmp_path.rglob("*.css"):
        assert not re.search(r"url\([\"']?(?:https?:)?//", style.read_text()), style.name
