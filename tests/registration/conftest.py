"""Pair of clouds used by most registration tests."""

import numpy as np
import pytest

from pcbench.registration import advice
from pcbench.scenes.synthetic import city


@pytest.fixture(autouse=True)
def _all_methods_are_installed(monkeypatch):
    """Make advice independent of the installed libraries."""
    monkeypatch.setattr(advice, "has_global", lambda: True)


@pytest.fixture(scope="session")
def scene():
    """Two independent samples of a city's centre with 2 cm noise: about 64k and 16k points on 150 m x 150 m."""
    town, rng = city(3), np.random.default_rng(4)
    reference, candidate = (town.sample(n, rng)[0] for n in (400_000, 100_000))
    reference, candidate = (c[np.abs(c[:, :2]).max(axis=1) < 75] for c in (reference, candidate))
    return reference + rng.normal(0, 0.02, reference.shape), candidate + rng.normal(0, 0.02, candidate.shape)
