"""The site that `make docs` builds: complete, and nothing in it is fetched from another host when it is read."""

import os
import re
import subprocess
import sys

import pytest
from repository import ROOT

import pcbench

BELOW = {"cli", "native", "children"}  # what no program imports


def test_every_name_of_the_package_is_in_the_reference():
    page = (ROOT / "docs" / "reference" / "index.md").read_text()
    listed = re.findall(r"^        - (\w+)$", page, re.MULTILINE)
    assert sorted(listed) == sorted(set(pcbench.__all__) - {"__version__"})


def test_every_room_has_a_page_in_the_reference():
    rooms = {folder.parent.name for folder in (ROOT / "pcbench").glob("*/__init__.py")} - BELOW
    pages = {page.stem for page in (ROOT / "docs" / "reference").glob("*.md")}
    assert rooms <= pages


def check(site):
    command = [sys.executable, str(ROOT / "docs" / "check_site.py"), str(site)]
    return subprocess.run(command, capture_output=True, text=True)


@pytest.mark.parametrize(
    "text, address",
    [
        ('<p><script src="https://unpkg.com/a.js"></script>', "https://unpkg.com/a.js"),
        ("<link rel=stylesheet href=//fonts.example/b.css>", "//fonts.example/b.css"),
        ('<img alt="c" src="http://c.example/c.png">', "http://c.example/c.png"),
        ("<style>body { background: url('https://d.example/d.png') }</style>", "https://d.example/d.png"),
        ('<a href="https://e.example/">a link to follow</a> <img src="f.png">', None),
    ],
)
def test_what_is_fetched_from_another_host_is_found(tmp_path, text, address):
    (tmp_path / "page.html").write_text(text)
    done = check(tmp_path)
    assert done.returncode == (0 if address is None else 1)
    assert address is None or f"page.html: fetches {address}" in done.stderr


def test_a_site_that_was_not_built_is_none(tmp_path):
    assert "no pages" in check(tmp_path).stderr


@pytest.mark.slow
def test_the_site_asks_no_other_host(tmp_path):
    """As `make docs` does. Strictly built: a link between pages or to a name of the API that leads nowhere fails."""
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--quiet", "--site-dir", str(tmp_path)],
        cwd=ROOT,
        env={**os.environ, "NO_MKDOCS_2_WARNING": "1", "NO_COLOR": "1"},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert len(list(tmp_path.rglob("*.html"))) > 20
    assert check(tmp_path).returncode == 0
