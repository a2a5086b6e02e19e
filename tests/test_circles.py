"""No circle of imports inside a room: files of one folder can be read, and tested, one after the other."""

import ast
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest
from repository import ROOT

ROOMS = sorted(
    folder.relative_to(ROOT).as_posix()
    for package in ("pcbench", "reconstructors")
    for folder in (ROOT / package).iterdir()
    if any(folder.glob("*.py"))
)


def imports(source: Path) -> set[Path]:
    """The files of the repository that a file imports, inside functions and for types alone too."""
    found = set()
    for node in ast.walk(ast.parse(source.read_text())):
        if isinstance(node, ast.Import):
            found |= {file_of(alias.name) for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{source}: imports are absolute"
            found |= {file_of(f"{node.module}.{alias.name}") or file_of(node.module) for alias in node.names}
    return found - {None, source}


def file_of(module: str) -> Path | None:
    path = ROOT.joinpath(*module.split("."))
    return next((file for file in (path.with_suffix(".py"), path / "__init__.py") if file.is_file()), None)


def circle(graph: dict[Path, set[Path]]) -> list[str]:
    """The files of a circle, each imported by the next; none if there is none."""
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        return [file.relative_to(ROOT).as_posix() for file in error.args[1]]
    return []


@pytest.mark.parametrize("room", ROOMS)
def test_no_room_imports_in_a_circle(room):
    files = set((ROOT / room).rglob("*.py"))
    graph = {file: imports(file) & files for file in files}
    assert not circle(graph)
