"""The site that `make docs` builds is complete and loads nothing from other hosts."""

import os
import re
import subprocess
import sys

import pytest
from repository import ROOT

import pcbench

INTERNAL = {"cli", "native", "children"}  # packages that programs do not import


def test_every_exported_name_is_in_the_reference():
    page = (ROOT / "docs" / "reference" / "index.md").read_text()
    documented = re.findall(r"^        - (\w+)$", page, re.MULTILINE)
    assert sorted(documented) == sorted(set(pcbench.__all__) - {"__version__"})


def test_every_package_has_a_reference_page():
    packages = {folder.parent.name for folder in (ROOT / "pcbench").glob("*/__init__.py")} - INTERNAL
    pages = {page.stem for page in (ROOT / "docs" / "reference").glob("*.md")}
    assert packages <= pages


def check_site(site):
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
def test_resources_of_other_hosts_are_found(tmp_path, text, address):
    (tmp_path / "page.html").write_text(text)
    process = check_site(tmp_path)
    assert process.returncode == (0 if address is None else 1)
    assert address is None or f"page.html: fetches {address}" in process.stderr


def test_empty_site_is_an_error(tmp_path):
    assert "no pages" in check_site(tmp_path).stderr


@pytest.mark.slow
def test_site_loads_nothing_from_other_hosts(tmp_path):
    """Build the site as `make docs` does. The strict build fails on links to pages or objects that do not exist."""
    process = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--quiet", "--site-dir", str(tmp_path)],
        cwd=ROOT,
        env={**os.environ, "NO_MKDOCS_2_WARNING": "1", "NO_COLOR": "1"},
        capture_output=True,
        text=True,
    )
    assert process.returncode == 0, process.stdout + process.stderr
    assert len(list(tmp_path.rglob("*.html"))) > 20
    assert check_site(tmp_path).returncode == 0
