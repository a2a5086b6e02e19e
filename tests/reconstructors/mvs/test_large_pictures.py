"""Images whose planes and costs have more than 2^31 values."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from repository import ROOT

from reconstructors.mvs.patchmatch import MAX_SIDE_PX

COMPILER = shutil.which(os.environ.get("CXX", "c++"))
SOURCE = Path(__file__).with_name("large_picture.cpp")

pytestmark = [
    pytest.mark.skipif(COMPILER is None, reason="needs a C++ compiler"),
    pytest.mark.skipif(sys.platform != "linux", reason="reserves address space without memory"),
]


@pytest.fixture(scope="module")
def search_program(tmp_path_factory):
    program = tmp_path_factory.mktemp("search") / "large_picture"
    folders = [f"-I{ROOT / folder}" for folder in ("pcbench/native", "reconstructors/mvs/native")]
    flags = ["-std=c++17", "-O1", "-Wall", "-Wextra", "-Werror", "-ffp-contract=off", "-fopenmp"]
    interrupt = ROOT / "pcbench" / "native" / "common" / "interrupt.cpp"
    command = [COMPILER, *flags, *folders, str(SOURCE), str(interrupt), "-o", str(program)]
    process = subprocess.run(command, capture_output=True, text=True)
    assert process.returncode == 0, process.stderr
    return program


@pytest.mark.parametrize(
    "side",
    [
        pytest.param(200, id="small"),
        pytest.param(11_700, id="costs of 16 sources beyond 2^31"),
        pytest.param(23_300, id="planes beyond 2^31"),
        pytest.param(MAX_SIDE_PX, id="the largest"),
    ],
)
def test_last_pixels_are_searched_as_in_a_small_image(search_program, side):
    """Only the pages of the last rows are touched: the largest image needs as much memory as the smallest."""
    process = subprocess.run([search_program, str(side)], capture_output=True, text=True)
    if process.stdout.strip() == "no address space":
        pytest.skip("this machine does not reserve more memory than it has")
    assert process.returncode == 0, f"ended with {process.returncode}"
    assert process.stdout == "256 of 256 costs kept, 16 of 16 planes taken\n"
