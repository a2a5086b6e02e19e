"""The page on the architecture names existing folders, files and objects."""

import re

from docs_blocks import blocks
from repository import ROOT

PAGE = ROOT / "docs" / "architecture.md"


def test_the_tree_is_the_one_on_disk():
    """The tree lists every folder of the packages, and nothing that does not exist."""
    (tree,) = (block.text for block in blocks(PAGE) if block.mark and block.mark[0] == "checked by")
    documented, parents = set(), []
    for line in tree.splitlines():
        depth = (len(line) - len(line.lstrip())) // 2
        parents = [*parents[:depth], line.split()[0]]
        documented.add("".join(parents))
    for path in documented:
        assert (ROOT / path).is_dir() if path.endswith("/") else (ROOT / path).is_file(), path
    for package in ("pcbench", "reconstructors"):
        folders = {source.parent for kind in ("*.py", "*.h") for source in (ROOT / package).rglob(kind)}
        missing = {f"{folder.relative_to(ROOT)}/" for folder in folders} - documented
        assert not missing, f"not in the tree of {PAGE.name}: {missing}"


def test_named_files_exist():
    """Names in capitals such as METHOD.py are placeholders."""
    for page in (PAGE, ROOT / "CONTRIBUTING.md"):
        for path in re.findall(r"`((?:pcbench|tests|benchmarks|reconstructors|docs)/[\w/.]*)`", page.read_text()):
            assert re.search(r"[A-Z]{3,}\.py", path) or (ROOT / path).exists(), f"{page.name}: {path}"


def test_named_objects_exist():
    """The places where contributors add an entry exist."""
    for path, name in (
        ("pcbench/io/formats.py", "CLOUDS"),
        ("pcbench/io/formats.py", "MESHES"),
        ("pcbench/measure/directions.py", "MEAN_METRICS"),
        ("pcbench/measure/quantities.py", "_PARTS"),
        ("pcbench/report/layout.py", "LABELS"),
        ("pcbench/report/layout.py", "HEADLINES"),
        ("pcbench/measure/library_presets.py", "LIBRARY_PRESETS"),
        ("pcbench/registration/methods.py", "def parse_method("),
        ("pyproject.toml", '[project.entry-points."pcbench.reconstructors"]'),
    ):
        assert name in (ROOT / path).read_text(), f"{path}: {name}"
