"""Class names are unique across the packages."""

import ast
from collections import defaultdict

from repository import ROOT


def test_class_names_are_unique():
    locations = defaultdict(list)
    for package in ("pcbench", "reconstructors"):
        for path in sorted((ROOT / package).rglob("*.py")):
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if isinstance(node, ast.ClassDef):
                    locations[node.name].append(f"{path.relative_to(ROOT)}:{node.lineno}")
    assert {name: paths for name, paths in locations.items() if len(paths) > 1} == {}
    assert len(locations) > 100  # the classes were found
