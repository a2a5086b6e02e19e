"""Fixture of the tests of reports."""

import pytest


@pytest.fixture(autouse=True)
def _no_deformation(request):
    """Test no deformation, which takes half of a comparison, in tests that are not marked `with_deformation`."""
    if request.node.get_closest_marker("with_deformation") is None:
        request.getfixturevalue("without_deformation")
