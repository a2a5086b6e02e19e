"""Run notebooks and store them with their outputs: `make notebooks`, or some: `python docs/notebooks.py compare`.

Pages that show a repository's files show notebooks as they are stored. Pictures get a palette and are stored in one
format, which keeps them small.
"""

import base64
import io
import sys
from pathlib import Path
from typing import Any

import nbformat
from nbclient import NotebookClient
from PIL import Image

FOLDER = Path(__file__).parents[1] / "notebooks"
_COLORS = 256


def main() -> None:
    """Run the notebooks named on the command line, or all of them."""
    for name in sys.argv[1:] or sorted(path.stem for path in FOLDER.glob("*.ipynb")):
        path = FOLDER / f"{name}.ipynb"
        notebook = nbformat.read(path, as_version=4)
        NotebookClient(notebook, timeout=3600, record_timing=False).execute(cwd=str(FOLDER))
        for cell in notebook.cells:
            cell.metadata.pop("execution", None)
            for output in cell.get("outputs", ()):
                _compress(output.get("data", {}))
        nbformat.write(notebook, path)
        print(f"{path.name}: {path.stat().st_size / 1e3:,.0f} kB", flush=True)


def _compress(data: Any) -> None:
    if "image/png" not in data:
        return
    data.pop("image/jpeg", None)
    picture = Image.open(io.BytesIO(base64.b64decode(data["image/png"]))).convert("RGB").quantize(_COLORS)
    file = io.BytesIO()
    picture.save(file, "PNG", optimize=True)
    data["image/png"] = base64.b64encode(file.getvalue()).decode() + "\n"


if __name__ == "__main__":
    main()
