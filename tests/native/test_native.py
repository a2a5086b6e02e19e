"""The committed stubs of the compiled modules are current."""

import subprocess
import sys

import pytest
from repository import ROOT

from pcbench.native import _core
from reconstructors.field.native import _field
from reconstructors.mvs.native import _patchmatch
from reconstructors.splat.cpu import _rasterizer

MODULES = {"core": _core, "patchmatch": _patchmatch, "rasterizer": _rasterizer, "field": _field}


@pytest.mark.parametrize("module", MODULES.values(), ids=MODULES)
def test_committed_stub_is_current(module, tmp_path):
    generated = tmp_path / "module.pyi"
    subprocess.run(
        [sys.executable, "-m", "nanobind.stubgen", "-m", module.__name__, "-o", str(generated)],
        check=True,
        capture_output=True,
    )
    committed = (ROOT / module.__name__.replace(".", "/")).with_suffix(".pyi")
    assert generated.read_text() == committed.read_text(), (
        f"copy the generated {committed.name} from the build folder over the committed one"
    )
