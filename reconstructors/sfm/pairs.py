"""Selection of image pairs to match: all if the images are few, else those that may show the same place."""

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

_MAX_EXHAUSTIVE = 30  # images: 435 pairs, one or two minutes on two cores
_SEQUENCE_OVERLAP = 10  # following images; also those 16, 32, 64, ... later, which close loops
_SPATIAL_NEIGHBORS = 20  # nearest images in space


def choose_pairs(scene: Scene, matching: Matching) -> tuple[str, list[tuple[str, str]]]:
    """Choose the matching method, and the pairs of image names, sorted, without duplicates.

    "auto" uses all pairs of up to 30 images. For more it uses the nearest in space if each image has a camera or a
    position; else the following images if all names end in numbers; else all pairs.

    Args:
        scene: Images with cameras and positions, if any.
        matching: Requested method.

    Raises:
        InputError: "spatial" was requested and an image has no position.
    """
    positions = _positions(scene)
    if matching == "auto":
        if len(scene) <= _MAX_EXHAUSTIVE:
            matching = "exhaustive"
        elif positions is not None:
            matching = "spatial"
        else:
            is_numbered = all(re.search(r"\d$", PurePosixPath(name).stem) for name in scene.images)
            matching = "sequential" if is_numbered else "exhaustive"
    if matching == "spatial":
        if positions is None:
            raise InputError("expected a camera or GPS position for each image for spatial matching: use exhaustive")
        indices = _nearest_pairs(positions)
    elif matching == "sequential":
        indices = _sequence_pairs(len(scene))
    else:
        indices = list(combinations(range(len(scene)), 2))
    return matching, [(scene.images[a], scene.images[b]) for a, b in indices]


def _positions(scene: Scene) -> FloatArray | None:
    """Return the images' positions (N, 3), in the cameras' frame or in metres; None if any is unknown."""
    if all(name in scene.cameras for name in scene.images):
        return np.stack([scene.cameras[name].position for name in scene.images])
    measured, _ = scene.measured_positions()
    if all(name in measured for name in scene.images):
        return np.stack([measured[name] for name in scene.images])
    return None


def _nearest_pairs(positions: FloatArray) -> list[tuple[int, int]]:
    pairs = set()
    for index, position in enumerate(positions):
        distances = np.linalg.norm(positions - position, axis=1)
        for other in np.argsort(distances, kind="stable")[: _SPATIAL_NEIGHBORS + 1].tolist():
            if other != index:
                pairs.add((min(index, other), max(index, other)))
    return sorted(pairs)


def _sequence_pairs(count: int) -> list[tuple[int, int]]:
    steps = [*range(1, _SEQUENCE_OVERLAP + 1), *(2**k for k in range(4, 20))]
    return [(first, first + step) for first in range(count) for step in steps if first + step < count]
