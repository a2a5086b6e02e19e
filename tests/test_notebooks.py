"""Notebooks are stored with their outputs, run without errors, and display their figures."""

import base64
import io
import json
import re

import numpy as np
import pytest
from optional import import_or_skip
from repository import ROOT

NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))


@pytest.mark.parametrize(
    "path",
    [
        pytest.param(path, marks=pytest.mark.slow if path.stem == "gao" else pytest.mark.long, id=path.stem)
        for path in NOTEBOOKS
    ],
)
def test_notebook_runs(path, request):
    nbclient, nbformat = import_or_skip("nbclient"), import_or_skip("nbformat")
    import_or_skip("matplotlib")
    import_or_skip("pyvista")
    request.getfixturevalue("off_screen")
    if path.stem in ("reconstructor", "gao"):
        import_or_skip("pycolmap")
    if path.stem in ("compare", "reconstructor", "gao"):  # render scenes
        request.getfixturevalue("renderer")
    if path.stem == "gao":
        import_or_skip("torch")
    notebook = nbformat.read(path, as_version=4)
    stored_pages = _pages(notebook)
    nbclient.NotebookClient(notebook, timeout=900).execute(cwd=str(path.parent))
    assert _pages(notebook) == stored_pages, "run `make notebooks`"
    figure_cells = [cell for cell in notebook.cells if cell.cell_type == "code" and "plt.subplots" in cell.source]
    assert figure_cells
    view_cells = [cell for cell in notebook.cells if cell.cell_type == "code" and "plotter.show" in cell.source]
    assert view_cells
    for cell in figure_cells + view_cells:
        check_figure(cell)


def _pages(notebook):
    """Return the HTML that cells display, without its numbers."""
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", ())]
    pages = [output["data"]["text/html"] for output in outputs if "text/html" in output.get("data", {})]
    return [re.sub(r"[-\d.,]+", "#", page) for page in pages]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook_is_stored_with_its_outputs(path):
    cells = [cell for cell in json.loads(path.read_text())["cells"] if cell["cell_type"] == "code"]
    counts = [cell["execution_count"] for cell in cells]
    assert counts == list(range(1, len(cells) + 1)), "run `make notebooks`"
    assert not any(output["output_type"] == "error" for cell in cells for output in cell["outputs"])
    pictures = [output for cell in cells for output in cell["outputs"] if "image/png" in output.get("data", {})]
    assert pictures
    assert path.stat().st_size < 1_500_000


def check_figure(cell):
    """Check that a cell displays one picture with at least 2 % of its area drawn; titles and axes cover about 1 %."""
    from matplotlib.image import imread

    images = [output.data["image/png"] for output in cell.outputs if "image/png" in output.get("data", {})]
    assert len(images) == 1, cell.source
    image = imread(io.BytesIO(base64.b64decode(images[0])))[..., :3]
    background = np.median(image.reshape(-1, 3), axis=0)
    assert (np.abs(image - background) > 0.05).any(axis=2).mean() > 0.02, cell.source


def test_list_of_notebooks():
    assert [path.stem for path in NOTEBOOKS] == ["bend", "compare", "gao", "reconstructor"]
