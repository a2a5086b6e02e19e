"""Where real files are, if this machine has them."""

import os
from pathlib import Path

import pytest


def data_folder(name: str) -> Path:
    """The folder `name` of the shared data; skips the test where it is absent."""
    root = Path(os.environ.get("PCBENCH_DATA", Path(__file__).parent.parent.parent / "shared" / "data"))
    if not (root / name).is_dir():
        pytest.skip(f"no data folder {root / name}: set PCBENCH_DATA")
    return root / name
