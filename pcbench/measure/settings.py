"""What a user may change about a comparison; few numbers, stored with every result."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from pcbench.errors import InputError
from pcbench.measure import presets

MAPS = ("poisson", "m3c2")


@dataclass(frozen=True)
class Settings:
    """What a user may change; stored with every result.

    Attributes:
        register: how candidates are aligned, see `pcbench.registration.METHODS`.
        crop: which part is measured, see `pcbench.geometry.region_text.parse_region`.
        thresholds: of the F-score, in the clouds' unit; None: 1, 2 and 5 times the reference's median spacing.
        presets: locked definitions to report beside ours; `gao2025` and `mpeg` are always there.
        maps: deviation maps beside those to the nearest point and to the tangent plane: `poisson` (to a Poisson mesh of
            the reference) and `m3c2`.
        seed: of the bootstrap.
        normal_neighbors: points a normal of the reference is estimated from where the file has none.
        classes, returns: which points of LAS files count, see `pcbench.read_cloud`.
    """

    register: str = "icp"
    crop: str = "none"
    thresholds: tuple[float, ...] | None = None
    presets: tuple[str, ...] = ("gao2025", "mpeg")
    maps: tuple[str, ...] = ()
    seed: int = 0
    normal_neighbors: int = 20
    classes: tuple[int, ...] | None = None
    returns: str | tuple[int, ...] | None = None

    def __post_init__(self) -> None:
        for name, text in (("register", self.register), ("crop", self.crop)):
            if not isinstance(text, str):
                raise InputError(f"expected {name} as text, got {text!r}")
        if self.thresholds is not None:
            object.__setattr__(self, "thresholds", tuple(dict.fromkeys(_positive(self.thresholds))))
        if not _is_whole(self.seed) or self.seed < 0:
            raise InputError(f"expected the seed as a whole number >= 0, got {self.seed!r}")
        if not _is_whole(self.normal_neighbors) or not 3 <= self.normal_neighbors <= 1000:
            raise InputError(f"expected 3 to 1000 neighbours for a normal, got {self.normal_neighbors!r}")
        if unknown := [name for name in self.presets if name not in presets.NAMES]:
            raise InputError(f"unknown preset {unknown[0]!r}: expected one of {', '.join(presets.NAMES)}")
        if unknown := [name for name in self.maps if name not in MAPS]:
            raise InputError(f"unknown map {unknown[0]!r}: expected {' or '.join(MAPS)}")
        always = [name for name in ("gao2025", "mpeg") if name not in self.presets]
        object.__setattr__(self, "presets", (*always, *dict.fromkeys(self.presets)))


def _positive(values: Any) -> list[float]:
    try:
        numbers = [] if isinstance(values, str) else [float(v) for v in values]
    except (TypeError, ValueError, OverflowError):
        numbers = []
    if not numbers or not all(np.isfinite(v) and v > 0 for v in numbers):
        raise InputError(f"expected positive thresholds, got {values!r}")
    return numbers


def _is_whole(value: Any) -> bool:
    return isinstance(value, int | np.integer) and not isinstance(value, bool)
