"""The site that `make docs` builds is complete and loads nothing from other hosts."""

import os
import re
import subprocess
import sys

import pytest
from optional import import_or_skip
from repository import ROOT

import pcbench

INTERNAL = {"cli", "native", "children"}  # packages that programs do not import


def test_every_exported_name_is_in_the_reference():
    pages = (ROOT / "docs" / "reference").glob("pcbench-*.md")
    entry = re.compile(r"^::: pcbench\.(\w+)$|`pcbench\.(\w+)` is the module", re.MULTILINE)
    documented = [name or module for page in pages for name, module in entry.findall(page.read_text())]
    assert sorted(documented) == sorted(set(pcbench.__all__) - {"__version__"})


def test_every_module_is_on_one_reference_page():
    """A page names a module or its package; `mkdocs.yml` hides modules that run in child processes."""
    pages = (ROOT / "docs" / "reference").glob("*.md")
    entries = [entry for page in pages for entry in page.read_text().split("\n::: ")[1:]]
    listed = [entry.split()[0] for entry in entries if "show_submodules: false" not in entry]
    for file in sorted((ROOT / "pcbench").rglob("*.py")):
        module = ".".join(file.relative_to(ROOT).with_suffix("").parts)
        package = module.split(".")[1]
        if file.stem.startswith("_") or package in INTERNAL or re.search("(_child|worker)$", file.stem):
            continue
        levels = [module.rsplit(".", depth)[0] for depth in range(module.count(".") - 1)]  # without pcbench.PACKAGE
        if (ROOT / "pcbench" / package).is_dir():
            assert sum(map(listed.count, levels or [module])) == 1, module


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
        ('<a href="https://e.example/">a link to follow</a> <img src="page.html">', None),
    ],
)
def test_resources_of_other_hosts_are_found(tmp_path, text, address):
    (tmp_path / "page.html").write_text(text)
    process = check_site(tmp_path)
    assert process.returncode == (0 if address is None else 1)
    assert address is None or f"page.html: fetches {address}" in process.stderr


def test_links_that_end_nowhere_are_found(tmp_path):
    (tmp_path / "page").mkdir()
    (tmp_path / "index.html").write_text('<h2 id="a">A</h2> <a href="page/#b">b</a> <a href="https://e.example/">e</a>')
    page = tmp_path / "page" / "index.html"
    page.write_text('<h2 id="b">B</h2> <a href="../#a">a</a> <a href="#b">b</a> <a href=..>home</a>')
    assert check_site(tmp_path).returncode == 0
    page.write_text('<a href="../#b">b</a> <a href="docs/architecture.md">c</a> <img src="d.png">')
    found = [line.rpartition(": ")[2] for line in check_site(tmp_path).stderr.splitlines()]
    addresses = ["page/#b", "../#b", "docs/architecture.md", "d.png"]  # without its heading, the page lacks #b too
    assert found == [f"{address} ends nowhere" for address in addresses]


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
    for page in sorted((tmp_path / "reference").rglob("*.html")):
        article = re.search("<article.*?</article>", page.read_text(), re.DOTALL)[0]
        assert len(re.sub("<[^>]+>", " ", article).split()) <= 5000, f"{page.parent.name}: split docs/reference"


def test_descriptions_of_attributes_move_to_them(monkeypatch):
    import_or_skip("griffe")
    monkeypatch.syspath_prepend(ROOT / "docs")
    from reference_extension import moved_entries, split_entries

    names = {"width", "height", "steps", "poses"}
    docstring = "A.\n\nArgs:\n    width, height: size\n        in pixels.\n    other: kept.\n\nRaises:\n    Bad: no."
    text, entries = moved_entries(split_entries(docstring), names)
    assert text == "A.\n\nArgs:\n    other: kept.\n\nRaises:\n    Bad: no."
    assert entries == {"width": "size in pixels.", "height": "size in pixels."}
    assert moved_entries("A.\n\nAttributes:\n    steps: many.\n\nMore.", names)[0].split() == ["A.", "More."]
    text, entries = moved_entries("Train.\n\nposes: `given` or\nsolved.\nsteps: many.\n\nIt ends.", names)
    assert (text.split("\n\n")[0], text.split("\n\n")[-1].strip()) == ("Train.", "It ends.")
    assert entries == {"poses": "`given` or solved.", "steps": "many."}


def test_sentences_of_answers_are_joined_and_rows_are_whole(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "docs")
    import site_hooks

    sentence = "distance " * 14 + "floor"  # 131 columns
    lines = [
        sentence,
        "ends here.",
        "The next one.",
        "name    value",
        "name    " + "explanation " * 12,
        "a  " + "1  " * 60,
        "$ pcbench " + "word " * 24,
        "reference.ply: 10 points",
        '<a id="1"></a><span class="gp"># </span>shift: <span class="m">0.6</span> m',
        "0.5 -1.2e-05 1",
    ]
    html = '<div class="language-console highlight"><pre><code>' + "\n".join(lines) + "</code></pre></div>"
    shown = site_hooks.on_page_content(html + '<img alt="a map" src="map.png">')
    assert shown.splitlines()[0].endswith("floor ends here.")
    assert shown.splitlines()[1:3] == ["The next one.", '<span class="row">name    value</span>']
    assert shown.count('class="row"') == 3 and '<span class="row">a  1' in shown
    assert shown.splitlines()[-4:-1] == [
        "$ pcbench " + "word " * 24,
        "reference.ply: 10 points",
        '<span class="go"><a id="1"></a># shift: 0.6 m</span>',
    ]
    assert site_hooks.on_page_content("<code>--crop a</code>") == '<code><span class="option">--crop</span> a</code>'
    assert shown.endswith('<a href="map.png"><img alt="a map" src="map.png"></a>')
