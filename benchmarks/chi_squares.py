"""Tails of weighted sums of chi squares against long simulations: python benchmarks/chi_squares.py [--draws 400000000]

For each family of weights, at the value where our tail probability is 1e-5: the share of plain draws, or of draws from
normals with a larger variance, weighted for it (importance sampling), with standard errors; for comparison the scaled
chi square with the same two moments.
"""

from __future__ import annotations

import argparse
import time

import numpy as np
from measure import limit_threads, setting

from pcbench.deformation.chi_squares import chi_squares_quantile, chi_squares_tail

TAIL_PROBABILITY = 1e-5
FAMILIES = {
    "uneven": np.array([3.0, 1.0, 1.0, 0.5, 0.5, 0.5]),
    "modes": np.logspace(0, -3, 48),  # like the modes of a cubic field under long-range noise
    "one and many": np.concatenate([[1.0], np.full(300, 1e-2)]),
}
CHUNK_SIZE = 2_000_000


def simulate_plain(value: float, weights: np.ndarray, draws: int, rng: np.random.Generator) -> tuple[float, float]:
    """Return the share of draws beyond a value and its standard error."""
    count = 0
    for start in range(0, draws, CHUNK_SIZE):
        sums = np.zeros(min(CHUNK_SIZE, draws - start))
        for weight in weights:
            sums += weight * np.square(rng.standard_normal(len(sums)))
        count += int(np.count_nonzero(sums > value))
    share = count / draws
    return share, float(np.sqrt(share / draws))


def simulate_tilted(value: float, weights: np.ndarray, draws: int, rng: np.random.Generator) -> tuple[float, float]:
    """Return the same by importance sampling with normals of variance 1 / (1 - 2 t w).

    The share is E[exp(K(t) - t Q); Q > value]; t is chosen so that the mean of Q equals the value.
    """
    low, high = 0.0, 0.5 / weights.max()
    for _ in range(100):
        t = 0.5 * (low + high)
        low, high = (low, t) if (weights / (1 - 2 * t * weights)).sum() > value else (t, high)
    tilted_weights = weights / (1 - 2 * t * weights)
    log_normalization = -0.5 * np.log(1 - 2 * t * weights).sum()
    total_contribution = total_square = 0.0
    for start in range(0, draws, CHUNK_SIZE):
        sums = np.zeros(min(CHUNK_SIZE, draws - start))
        for weight in tilted_weights:
            sums += weight * np.square(rng.standard_normal(len(sums)))
        contributions = np.where(sums > value, np.exp(log_normalization - t * sums), 0.0)
        total_contribution, total_square = (
            total_contribution + float(contributions.sum()),
            total_square + float(np.square(contributions).sum()),
        )
    share = total_contribution / draws
    return share, float(np.sqrt(total_square / draws - share**2) / np.sqrt(draws))


def two_moment_tail(value: float, weights: np.ndarray) -> float:
    """Return the tail of the scaled chi square with the same mean and variance."""
    from scipy.stats import chi2

    mean, square = weights.sum(), np.square(weights).sum()
    return float(chi2.sf(value * mean / square, mean**2 / square))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draws", type=int, default=400_000_000, help="number of plain draws; a hundredth is tilted")
    options = parser.parse_args()
    limit_threads(1)
    print(setting())
    print(f"{'weights':14}{'value':>14}{'ours':>12}{'two moments':>13}{'tilted draws':>24}{'plain draws':>24}{'us':>7}")
    for name, weights in FAMILIES.items():
        value = float(f"{chi_squares_quantile(TAIL_PROBABILITY, weights):.6g}")
        start = time.perf_counter()
        for _ in range(100):
            tail = chi_squares_tail(value, weights)
        microseconds = 1e4 * (time.perf_counter() - start)
        tilted_result = simulate_tilted(value, weights, options.draws // 100, np.random.default_rng(0))
        plain_result = (
            simulate_plain(value, weights, options.draws, np.random.default_rng(1)) if len(weights) < 10 else None
        )
        shares = [f"{s:.4e} +- {e:.1e}" if s else "" for s, e in (tilted_result, plain_result or (0.0, 0.0))]
        print(
            f"{name:14}{value:14.6g}{tail:12.4e}{two_moment_tail(value, weights):13.2e}{shares[0]:>24}{shares[1]:>24}"
            f"{microseconds:7.0f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
