"""Fixtures of the tests of measurements."""

import pytest
from partial_comparisons import skip_deformation


@pytest.fixture
def without_deformation(monkeypatch):
    """Let comparisons skip the test for deformation, which these tests do not check."""
    skip_deformation(monkeypatch)
