"""Large clouds as tiles of LAZ, written one at a time: terrain with buildings as from a laser scanner in the air."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

DENSITY = 10.0  # points per square metre
MAX_TILE_POINTS = 1_000_000
ORIGIN = np.array([500_000.0, 5_400_000.0, 300.0])
SHIFT = np.array([0.4, -0.3, 0.15])  # of the candidate
NOISE = {"reference": 0.02, "candidate": 0.05}  # metres
_BLOCK = 40.0  # metres; at most one building in each
_MISSING = 0.02  # share of the buildings that the candidate does not have


def write_clouds(folder: Path, size: int, extension: str = ".laz") -> None:
    """Write a reference of about this size, and a candidate of as many other points, as folders of square tiles.

    The memory is that of a tile. The tiles depend on the size and nothing else.
    """
    from pcbench import write_cloud
    from pcbench.geometry.cloud import Cloud

    along = max(2, math.ceil(math.sqrt(size / MAX_TILE_POINTS)))
    points = size // along**2
    side = math.sqrt(points / DENSITY)
    for kind in ("reference", "candidate"):
        (folder / kind).mkdir(parents=True)
        for number in range(along**2):
            corner = side * np.array(divmod(number, along))
            cloud = Cloud(_tile(kind, number, corner, side, points), crs="EPSG:32632", unit="m")
            write_cloud(folder / kind / f"tile_{number:04d}{extension}", cloud)


def _tile(kind: str, number: int, corner: Any, side: float, count: int) -> Any:
    random = np.random.default_rng([number, kind == "candidate"])
    places = corner + random.uniform(0, side, (count, 2))
    places = places[np.argsort(np.floor(places[:, 0]) + places[:, 1] / 1e6)]  # in the order of flight lines
    heights = _heights(places, kind) + random.normal(0, NOISE[kind], count)
    points = np.column_stack([places, heights]) + ORIGIN
    return points + SHIFT if kind == "candidate" else points


def _heights(places: Any, kind: str) -> Any:
    block = np.floor(places / _BLOCK)
    centre = (block + 0.5) * _BLOCK
    draw = [_draws(block, salt) for salt in range(4)]
    inside = (np.abs(places - centre) < np.column_stack([6 + 10 * draw[0], 6 + 10 * draw[1]])).all(axis=1)
    is_built = inside & (draw[2] < 0.5)
    if kind == "candidate":
        is_built &= draw[2] > 0.5 * _MISSING
    roof = _ground(centre) + 4 + 14 * draw[3] - 0.3 * np.abs(places[:, 0] - centre[:, 0])
    return np.where(is_built, roof, _ground(places))


def _ground(places: Any) -> Any:
    x, y = places.T
    return 25 * np.sin(x / 310) * np.cos(y / 270) + 6 * np.sin(x / 57 + y / 91) + 0.8 * np.sin(x / 13) * np.sin(y / 17)


def _draws(block: Any, salt: int) -> Any:
    """Return a number from 0 to 1 for each block, always the same one."""
    mixed = block[:, 0].astype(np.int64) * 73_856_093 ^ block[:, 1].astype(np.int64) * 19_349_663 ^ salt * 83_492_791
    mixed = (mixed ^ mixed >> 13) * 0x5BD1E995 & 0xFFFFFFFF
    mixed = (mixed ^ mixed >> 15) * 0x27D4EB2F & 0xFFFFFFFF
    return (mixed ^ mixed >> 16) / 2**32
