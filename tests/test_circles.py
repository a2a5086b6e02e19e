"""No circular imports inside a subpackage, so that its files can be read and tested in order."""

import ast
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest
from repository import ROOT

SUBPACKAGES = sorted(
    folder.relative_to(ROOT).as_posix()
    for package in ("pcbench", "reconstructors")
    for folder in (ROOT / package).iterdir()
    if any(folder.glob("*.py"))
)


def imported_files(source: Path) -> set[Path]:
    """Return the files of the repository that a file imports, including imports in functions and for types only."""
    files = set()
    for node in ast.walk(ast.parse(source.read_text())):
        if isinstance(node, ast.Import):
            files |= {module_file(alias.name) for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{source}: imports are absolute"
            files |= {module_file(f"{node.module}.{alias.name}") or module_file(node.module) for alias in node.names}
    return files - {None, source}


@cache
def module_file(module: str) -> Path | None:
    path = ROOT.joinpath(*module.split("."))
    return next((file for file in (path.with_suffix(".py"), path / "__init__.py") if file.is_file()), None)


def find_cycle(graph: dict[Path, set[Path]]) -> list[str]:
    """Return the files of an import cycle, each imported by the next; an empty list without a cycle."""
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        return [file.relative_to(ROOT).as_posix() for file in error.args[1]]
    return []


@pytest.mark.parametrize("folder", SUBPACKAGES)
def test_no_circular_imports(folder):
    files = set((ROOT / folder).rglob("*.py"))
    graph = {file: imported_files(file) & files for file in files}
    assert not find_cycle(graph)
