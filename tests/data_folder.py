"""Location of real data for tests; the data are not part of the repository."""

import os
from pathlib import Path

import pytest
from repository import ROOT


def data_folder(name: str) -> Path:
    """Return the folder of a data set; skip the test if it is absent.

    It is in the folder given by the environment variable PCBENCH_DATA, else in `shared/data` beside the clone.
    """
    root = data_root()
    if root is None or not (root / name).is_dir():
        pytest.skip(f"no test data {name!r} (set PCBENCH_DATA to the folder that holds it)")
    return root / name


def data_root() -> Path | None:
    if folder := os.environ.get("PCBENCH_DATA"):
        return Path(folder)
    default_folder = ROOT.parent / "shared" / "data"
    return default_folder if default_folder.is_dir() else None
