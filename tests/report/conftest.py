"""Fixtures of the tests of reports."""

import pytest

from pcbench.report.plot import splats


@pytest.fixture(autouse=True)
def _no_deformation(request):
    """Test no deformation, which takes half of a comparison, in tests that are not marked `with_deformation`."""
    if request.node.get_closest_marker("with_deformation") is None:
        request.getfixturevalue("without_deformation")


@pytest.fixture
def coarse_pictures(monkeypatch):
    """Draw clouds without supersampling, which takes most of the time of a picture."""
    monkeypatch.setattr(splats, "_SUPERSAMPLING", 1)
