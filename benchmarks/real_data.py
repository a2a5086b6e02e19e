"""The folder of real clouds, photographs and official scores that some benchmarks use beside generated scenes."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from data_folder import data_root


def data_note() -> str:
    """Return what the head of a table says if the data are absent; `make measured` then writes no table."""
    root = data_root()
    return "" if root and root.is_dir() else "; missing: the folder PCBENCH_DATA of real data"


__all__ = ["data_note", "data_root"]
