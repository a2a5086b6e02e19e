"""Notebooks run as they are stored, and are stored without outputs."""

import json

import pytest
from repository import ROOT

NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook_runs(path, request):
    nbclient, nbformat = pytest.importorskip("nbclient"), pytest.importorskip("nbformat")
    pytest.importorskip("matplotlib")
    if path.stem == "reconstructor":  # it takes photographs
        pytest.importorskip("pycolmap")
        request.getfixturevalue("renderer")
    cells = json.loads(path.read_text())["cells"]
    assert not any(cell.get("outputs") or cell.get("execution_count") for cell in cells), "clear the outputs"
    nbclient.NotebookClient(nbformat.read(path, as_version=4), timeout=300).execute(cwd=str(path.parent))


def test_there_is_one():
    assert NOTEBOOKS
