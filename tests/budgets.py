"""Check the promise of the budget: its parts add up to D2."""

import pytest

from pcbench.measure.results import ARROWS, Candidate

_ROUNDING = 1e-9  # relative; D2 and the budget add up the same squares in another order


def checked_candidate(**values):
    """Return a candidate, after a check that the parts of both of its budgets add up to D2."""
    candidate = Candidate(**values)
    for way in () if candidate.budget is None else ARROWS:
        d2, budget = candidate.metrics.d2_mse[way].value, candidate.budget[way]
        assert min(part.mean_square for part in budget.parts.values()) >= 0
        assert sum(part.mean_square for part in budget.parts.values()) == pytest.approx(d2, rel=_ROUNDING, abs=0)
        assert sum(budget.share(name) for name in budget.parts) == pytest.approx(float(d2 > 0))
    return candidate
