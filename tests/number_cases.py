"""Arrays of numbers on which order statistics are difficult: ties, zeros, tiny and huge values."""

import numpy as np


def finite_numbers():
    """Yield a name and finite values (N,), for several N."""
    rng = np.random.default_rng(5)
    for count in (1, 2, 3, 4, 5, 100, 30_001):
        normal = rng.normal(size=count)
        yield f"normal {count}", normal
        yield f"distances {count}", np.abs(normal)
        yield f"ties {count}", np.round(normal)
        yield f"equal {count}", np.full(count, -2.5)
        yield f"zeros {count}", np.where(normal < 0, -0.0, 0.0)
        yield f"mostly zeros {count}", np.maximum(normal, 0)
        yield f"far from zero {count}", normal + 4e6
        yield f"many magnitudes {count}", np.sign(normal) * 10.0 ** rng.uniform(-300, 300, count)
        yield f"subnormal {count}", normal * 5e-324 * 1000
        yield f"last bits {count}", 1 + rng.integers(0, 5, count) * np.finfo(float).eps


def infinite_numbers():
    """Yield a name and values (N,), some of which are infinite, for several N."""
    rng = np.random.default_rng(6)
    for count in (1, 2, 3, 4, 5, 100, 30_001):
        values = rng.normal(size=count)
        values[:: max(1, count // 3)] = np.inf
        values[1 :: max(1, count // 4)] = -np.inf
        yield f"infinite {count}", values
