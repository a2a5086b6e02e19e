"""Where real data lie for tests that want some; they are not part of the repository."""

import os
from pathlib import Path

import pytest


def data_folder(name: str) -> Path:
    """The folder of one data set, or a skipped test where it is absent.

    Looked for under the environment variable PCBENCH_DATA, by default ../shared/data from the repository's root.
    """
    root = Path(os.environ.get("PCBENCH_DATA") or Path(__file__).parent.parent.parent / "shared" / "data")
    folder = root / name
    if not folder.is_dir():
        pytest.skip(f"no test data at {folder} (set PCBENCH_DATA)")
    return folder
