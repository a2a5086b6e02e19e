"""Non-negative least squares, compared with scipy's."""

import numpy as np
import pytest
from optional import import_or_skip

from pcbench.deformation.nnls import nonnegative_least_squares


@pytest.mark.parametrize("columns", [1, 3, 6, 9])
def test_nnls_matches_scipy(columns):
    nnls = import_or_skip("scipy.optimize").nnls
    rng = np.random.default_rng(columns)
    for scale in (1e-6, 1.0, 1e6):
        for _ in range(20):
            matrix, values = rng.normal(size=(12, columns)), scale * rng.normal(size=12)
            expected = nnls(matrix, values)[0]
            # 1e-9: both solve the same small systems in float64.
            computed = nonnegative_least_squares(matrix, values)
            np.testing.assert_allclose(computed, expected, rtol=1e-9, atol=1e-9 * scale)
