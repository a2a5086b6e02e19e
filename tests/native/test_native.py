"""The compiled module: its committed stub is current."""

import subprocess
import sys

from repository import ROOT

from pcbench.native import _core

STUB = ROOT / "pcbench" / "native" / "_core.pyi"


def test_committed_stub_is_current(tmp_path):
    out = tmp_path / "_core.pyi"
    subprocess.run(
        [sys.executable, "-m", "nanobind.stubgen", "-m", _core.__name__, "-o", str(out)],
        check=True,
        capture_output=True,
    )
    assert out.read_text() == STUB.read_text(), (
        "copy the generated _core.pyi from the build folder over the committed one"
    )
