"""Surfaces whose geometry leaves motions free or nearly has a symmetry, as a list of cases.

A right pose is not to be found on the first four; a method should say so. On the last two it is, but a small detail
alone tells it from a wrong one, and the start lies near the wrong one.
"""

from __future__ import annotations

import numpy as np

from pcbench.studies.stress.ladders.ladder import Ladder, displaced, turned
from pcbench.studies.stress.scenes import StressPair
from pcbench.studies.stress.surfaces import DEGENERATE

_NAMES = tuple(DEGENERATE)
_BAY = 5.0  # width of a bay of the facade, in metres


def start_of(name: str, pair: StressPair, rng: np.random.Generator) -> StressPair:
    """Return the pair with the start that is hard for its shape."""
    if name == "repeated facade":
        return turned(pair, float(rng.uniform(-3, 3)), np.array([_BAY * rng.uniform(0.7, 1.3), 0.0, 0.0]))
    if name == "half-turn building":
        return turned(pair, float(rng.uniform(160, 200)), np.zeros(3))
    return displaced(pair, 5.0, 0.05 * pair.extent, rng)


def _at_hard_start(pair: StressPair, level: float, rng: np.random.Generator) -> StressPair:
    return start_of(_NAMES[int(level)], pair, rng)


DEGENERATE_LADDERS = (
    Ladder(
        name="degenerate",
        title="degenerate or nearly symmetric surface",
        kind="degenerate",
        unit="",
        levels=tuple(float(number) for number in range(len(_NAMES))),
        quick=(0.0, 5.0),
        perturb=_at_hard_start,
        level_names=_NAMES,
        sets_start=True,
        sets_shape=True,
    ),
)
