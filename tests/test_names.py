"""Names of classes are unique across the packages, and names of values say what the value is."""

import ast
import re
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

import pytest
from repository import ROOT

VAGUE = {"found", "known", "at", "of"}  # they say how a value came about, or nothing
ROOMS = sorted(
    path.relative_to(ROOT).as_posix()
    for package in ("pcbench", "reconstructors")
    for path in (ROOT / package).iterdir()
    if path.name != "__pycache__" and (path.is_dir() or path.suffix == ".py")
)


def test_class_names_are_unique():
    locations = defaultdict(list)
    for package in ("pcbench", "reconstructors"):
        for path in sorted((ROOT / package).rglob("*.py")):
            for name in re.findall(r"^ *class (\w+)[(:]", path.read_text(encoding="utf-8"), re.MULTILINE):
                locations[name].append(str(path.relative_to(ROOT)))
    assert {name: paths for name, paths in locations.items() if len(paths) > 1} == {}
    assert len(locations) > 100  # the classes were found


@pytest.mark.parametrize("room", ROOMS)
def test_names_of_values_say_what_the_value_is(room):
    """Fields of results are not checked: they are read with the result's name before them, as in `changes.found`."""
    path = ROOT / room
    files = [path] if path.is_file() else sorted(path.rglob("*.py"))
    assert [name for file in files for name in vague_names(file)] == []


def vague_names(file: Path) -> Iterator[str]:
    nodes = list(ast.walk(ast.parse(file.read_text(encoding="utf-8"))))
    classes = (node for node in nodes if isinstance(node, ast.ClassDef))
    fields = {line.target for each in classes for line in each.body if isinstance(line, ast.AnnAssign)}
    for node in nodes:
        is_assigned = isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store) and node not in fields
        name = node.id if is_assigned else node.arg if isinstance(node, ast.arg) else ""
        if name in VAGUE:
            yield f"{file.relative_to(ROOT)}:{node.lineno}: {name}"
