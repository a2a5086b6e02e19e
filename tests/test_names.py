"""Names of classes across the packages."""

import ast
from collections import defaultdict

from repository import ROOT


def test_no_two_classes_share_a_name():
    places = defaultdict(list)
    for package in ("pcbench", "reconstructors"):
        for path in sorted((ROOT / package).rglob("*.py")):
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if isinstance(node, ast.ClassDef):
                    places[node.name].append(f"{path.relative_to(ROOT)}:{node.lineno}")
    assert {name: where for name, where in places.items() if len(where) > 1} == {}
    assert len(places) > 100  # all were looked at
