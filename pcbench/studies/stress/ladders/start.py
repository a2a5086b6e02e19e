"""Ladders of the start pose, after the protocol of Fontana et al. 2021, and of the coordinates.

Rotations are about the candidate's centroid: about a distant origin they would be huge displacements.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pcbench.geometry.transform import Similarity
from pcbench.studies.stress.ladders.ladder import Ladder, displaced
from pcbench.studies.stress.metrics import METRICS
from pcbench.studies.stress.registration import REGISTRATION
from pcbench.studies.stress.scenes import StressPair
from pcbench.studies.stress.verdicts import VERDICTS


def _rotated(pair: StressPair, level: float, rng: np.random.Generator) -> StressPair:
    return displaced(pair, level, 0.0, rng)


def _shifted(pair: StressPair, level: float, rng: np.random.Generator) -> StressPair:
    return displaced(pair, 0.0, level / 100 * pair.extent, rng)


def _rotated_and_shifted(pair: StressPair, level: float, second: float, rng: np.random.Generator) -> StressPair:
    return displaced(pair, level, second / 100 * pair.extent, rng)


def _scaled(pair: StressPair, level: float, rng: np.random.Generator) -> StressPair:
    return displaced(pair, 5.0, 0.02 * pair.extent, rng, scale=level)


def _far_away(pair: StressPair, level: float, _: np.random.Generator) -> StressPair:
    """Add an offset to the coordinates of both clouds, as those of a map grid have it."""
    shift = level * np.array([1.0, 0.7, 0.0])
    move = Similarity(np.eye(3), shift)
    surface = None if pair.surface is None else pair.surface.shifted(-shift)
    return replace(
        pair,
        reference=pair.reference + shift,
        points=pair.points + shift,
        T_true=move @ pair.T_true @ move.inverse(),
        surface=surface,
    )


START_LADDERS = (
    Ladder(
        name="start-rotation",
        title="rotation of the start",
        kind="start",
        unit="deg",
        levels=(0, 5, 10, 15, 20, 30, 45, 60, 90, 135, 180),
        quick=(5, 30, 90),
        perturb=_rotated,
        sets_start=True,
    ),
    Ladder(
        name="start-offset",
        title="offset of the start",
        kind="start",
        unit="% of the extent",
        levels=(0, 1, 2, 5, 10, 20, 50, 100),
        quick=(),
        perturb=_shifted,
        sets_start=True,
    ),
    Ladder(
        name="start-map",
        title="rotation of the start",
        kind="start",
        unit="deg",
        levels=(0, 5, 10, 20, 30, 45, 60),
        quick=(0, 20, 45),
        perturb=_rotated,
        sets_start=True,
        second_title="offset of the start",
        second_unit="% of the extent",
        second_levels=(0, 2, 5, 10, 20, 40),
        quick_second=(0, 5, 20),
        perturb_map=_rotated_and_shifted,
        needs_start=True,
    ),
    Ladder(
        name="scale",
        title="scale of the candidate",
        kind="start",
        unit="",
        levels=(1, 1.002, 1.01, 1.03, 1.1, 1.3, 2, 10),
        quick=(),
        perturb=_scaled,
        sets_start=True,
    ),
    Ladder(
        name="far-coordinates",
        title="distance from the origin",
        kind="coordinates",
        unit="m",
        levels=(0, 1e3, 1e5, 1e6, 1e7, 1e8),
        quick=(),
        perturb=_far_away,
        subjects=(REGISTRATION, METRICS, VERDICTS),
    ),
)
