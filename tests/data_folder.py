"""Where real data lie for tests that want some; they are not part of the repository."""

import os
from pathlib import Path

import pytest
from repository import ROOT


def data_folder(name: str) -> Path:
    """The folder of one data set, or a skipped test where it is absent.

    Looked for under the environment variable PCBENCH_DATA, else beside the clone in `shared/data` if that is there.
    """
    root = data_root()
    if root is None or not (root / name).is_dir():
        pytest.skip(f"no test data {name!r} (set PCBENCH_DATA to the folder that holds it)")
    return root / name


def data_root() -> Path | None:
    if given := os.environ.get("PCBENCH_DATA"):
        return Path(given)
    beside = ROOT.parent / "shared" / "data"
    return beside if beside.is_dir() else None
