"""Which images are compared with which: all of them where they are few, else those that can show the same things."""

from __future__ import annotations

import re
from itertools import combinations
from pathlib import PurePosixPath
from typing import Literal

import numpy as np

from pcbench.errors import InputError
from pcbench.geometry.arrays import FloatArray
from pcbench.scenes import Scene

Matching = Literal["auto", "exhaustive", "sequential", "spatial"]

_MAX_EXHAUSTIVE = 30  # images of which every pair is compared: 435 pairs, a minute or two on two cores
_OVERLAP = 10  # images after one in a sequence; and those 16, 32, 64, ... after it, which close loops
_NEIGHBOURS = 20  # images around one in space


def choose_pairs(scene: Scene, matching: Matching) -> tuple[str, list[tuple[str, str]]]:
    """The way that was chosen, and the pairs of image names, sorted, each once.

    "auto" takes all pairs of up to 30 images; else the nearest in space, if every image has a camera or a position;
    else the next ones, if the names end in numbers; else all.

    Raises:
        InputError: "spatial" was asked for and an image has no position.
    """
    positions = _positions(scene)
    if matching == "auto":
        if len(scene) <= _MAX_EXHAUSTIVE:
            matching = "exhaustive"
        elif positions is not None:
            matching = "spatial"
        else:
            numbered = all(re.search(r"\d$", PurePosixPath(name).stem) for name in scene.images)
            matching = "sequential" if numbered else "exhaustive"
    if matching == "spatial":
        if positions is None:
            raise InputError("spatial matching needs a camera or a GPS position of every image: use exhaustive")
        indices = _nearest(positions)
    elif matching == "sequential":
        indices = _next_ones(len(scene))
    else:
        indices = list(combinations(range(len(scene)), 2))
    return matching, [(scene.images[a], scene.images[b]) for a, b in indices]


def _positions(scene: Scene) -> FloatArray | None:
    """Where the images were taken (N, 3), in the cameras' frame or in metres; None if one of them is not known."""
    if all(name in scene.cameras for name in scene.images):
        return np.stack([scene.cameras[name].position for name in scene.images])
    measured, _ = scene.measured_positions()
    if all(name in measured for name in scene.images):
        return np.stack([measured[name] for name in scene.images])
    return None


def _nearest(positions: FloatArray) -> list[tuple[int, int]]:
    pairs = set()
    for index, position in enumerate(positions):
        distances = np.linalg.norm(positions - position, axis=1)
        for other in np.argsort(distances, kind="stable")[: _NEIGHBOURS + 1].tolist():
            if other != index:
                pairs.add((min(index, other), max(index, other)))
    return sorted(pairs)


def _next_ones(count: int) -> list[tuple[int, int]]:
    steps = [*range(1, _OVERLAP + 1), *(2**k for k in range(4, 20))]
    return [(first, first + step) for first in range(count) for step in steps if first + step < count]
