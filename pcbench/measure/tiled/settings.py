"""Settings of a tiled comparison: how it is computed. They do not change its numbers, except for a capped search."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from pcbench.errors import InputError
from pcbench.measure.library_presets import LIBRARY_PRESETS
from pcbench.options import Bounds, OptionGroup, setting
from pcbench.systems import cpu_count

DEFAULT_MEMORY = 4 << 30
_MIN_MEMORY = 1_000_000  # less is a number without its unit
TILED_PRESETS = ("gao2025", *LIBRARY_PRESETS)
"""Presets that are computed in tiles."""
_SIZE = re.compile(r"\s*(\d+(?:\.\d+)?)\s*(B|KB|MB|GB|TB|KiB|MiB|GiB|TiB)?\s*", re.IGNORECASE)
_FACTORS = {"": 1, "b": 1}
_FACTORS |= {f"{letter}b": 1000**power for power, letter in enumerate("kmgt", 1)}
_FACTORS |= {f"{letter}ib": 1024**power for power, letter in enumerate("kmgt", 1)}
_POINTS = re.compile(r"(\d+(?:\.\d*)?(?:e\d{1,2})?)([kMG]?)", re.IGNORECASE)
_POINT_FACTORS = {"": 1, "k": 1e3, "m": 1e6, "g": 1e9}
_CLUSTER = re.compile(r"(tcp|tls|ws|wss|ucx)://[^\s/]+:\d+")
_MIN_TILE_POINTS = 100
_BASE_BYTES = 100 << 20  # memory of a worker without data, measured: 75 MiB
_BYTES_PER_POINT = 350  # memory of a worker for each point of a tile, measured: 250, more with wide halos
_BYTES_PER_PIECE_POINT = 200  # memory of a worker for each point of a piece that it reads and sorts
_BYTES_PER_STORED_POINT = 80  # memory of a worker for each point of a piece that it reads again, once it is sorted
# Measured memory of all processes on Linux, where processes share the pages of code.
_MAIN_BYTES = 120_000_000  # this process without data
_SAMPLE_BYTES_PER_POINT = 100  # this process, for each point of the samples from which a pose is found
_ASSESSING_BYTES = 190_000_000  # this process while it tests for deformation, without the points around its queries
_NEAR_BYTES_PER_POINT = 165  # for each of these points
_MOST_NEAR_POINTS = (1_000_000, 300_000)  # around the queries, of the larger and of the smaller cloud
_MOST_MAIN_BYTES = _ASSESSING_BYTES + _NEAR_BYTES_PER_POINT * sum(_MOST_NEAR_POINTS)
_WORKER_BYTES = 35_000_000  # a worker without data
_DRAWING_BYTES = 145_000_000  # the process that draws pictures, after the workers have ended
_MAX_TILE_POINTS = 1_000_000  # larger tiles are not faster
_MIN_DEFAULT_TILE_POINTS = 20_000
_FEW_PIECE_POINTS = 100_000  # smaller pieces save little memory, and each tile may have points of all of them


@dataclass(frozen=True)
class TilingSettings:
    """Settings of a tiled comparison.

    Attributes:
        tile_points: largest number of points of a tile; None: chosen from the memory and the number of workers.
        memory: memory in bytes that all processes together may use.
        workers: number of worker processes; None: the number of CPUs, at most as many as the memory allows.
        cluster: address of a Dask scheduler, such as tcp://host:8786, whose workers see the same files; None: local
            processes.
        max_distance: length beyond which no closest point is searched; larger distances count as this one, and the
            result states their share. None: all distances are exact.
        skip_bad: whether damaged files are left out and listed in the result, instead of ending the comparison.
    """

    tile_points: int | None = setting(
        None,
        "--tiles",
        "Compute in tiles of at most SIZE points (1e6, 500k, 2M).  [default: auto, only if the clouds exceed --memory]",
        metavar="auto|SIZE",
        parse=lambda flag, text: None if text == "auto" else parse_points(flag, text),
        group=OptionGroup.LARGE_DATA,
    )
    memory: int = setting(
        DEFAULT_MEMORY,
        "--memory",
        "Memory that may be used, such as 4GiB or 500MB.  [default: 4GiB]",
        metavar="SIZE",
        parse=lambda _, text: parse_bytes(text),
        group=OptionGroup.LARGE_DATA,
    )
    workers: int | None = setting(
        None,
        "--workers",
        "Processes that compute tiles.  [default: the CPUs, as far as --memory allows]",
        metavar="N",
        bounds=Bounds(int, 1),
        group=OptionGroup.LARGE_DATA,
    )
    cluster: str | None = setting(
        None,
        "--cluster",
        "Compute tiles on a Dask cluster: tcp://HOST:PORT or file of its scheduler.",
        metavar="ADDRESS",
        parse=lambda _, text: check_cluster(text),
        group=OptionGroup.LARGE_DATA,
    )
    max_distance: float | None = setting(
        None,
        "--max-distance",
        "Compute in tiles, and search no closest point beyond this length, as which larger distances count.",
        metavar="LENGTH",
        bounds=Bounds(float, 0, is_open=True),
        group=OptionGroup.LARGE_DATA,
    )
    skip_bad: bool = setting(
        False,
        "--skip-bad",
        "Compute in tiles, and leave out damaged files, which are listed.",
        group=OptionGroup.LARGE_DATA,
    )

    def __post_init__(self) -> None:
        if self.tile_points is not None and self.tile_points < _MIN_TILE_POINTS:
            raise InputError(f"expected tiles of at least {_MIN_TILE_POINTS} points, got {self.tile_points}")
        if self.workers is not None and self.workers < 1:
            raise InputError(f"expected at least one worker, got {self.workers}")
        if self.max_distance is not None and not self.max_distance > 0:
            raise InputError(f"expected a maximum distance above 0, got {self.max_distance:g}")

    @property
    def chosen_tile_points(self) -> int:
        """Largest number of points of a tile, as given or so that workers fit into the memory beside this process."""
        if self.tile_points is not None:
            return self.tile_points
        workers = self.workers or cpu_count()
        free = (self.memory - max(self.memory / (1 + workers), _MOST_MAIN_BYTES)) / workers - _BASE_BYTES
        return int(min(max(free / _BYTES_PER_POINT, _MIN_DEFAULT_TILE_POINTS), _MAX_TILE_POINTS))

    @property
    def chosen_piece_points(self) -> int:
        """Largest number of points that a worker reads at once, if the format of the file allows it."""
        workers = self.chosen_workers or 1
        first = (self.memory / (1 + workers) - _BASE_BYTES) / _BYTES_PER_PIECE_POINT
        later = ((self.memory - _MOST_MAIN_BYTES) / workers - _WORKER_BYTES) / _BYTES_PER_STORED_POINT
        return int(min(max(min(first, max(later, _FEW_PIECE_POINTS)), _MIN_DEFAULT_TILE_POINTS), _MAX_TILE_POINTS))

    def least_memory(self, sample_points: int, counts: Sequence[int], largest_piece: int, *, draws: bool) -> int:
        """Return about how many bytes all processes need at least, whatever `memory` says.

        Args:
            sample_points: number of points of the samples from which a pose is found.
            counts: number of points of the reference and of the largest candidate.
            largest_piece: number of points of the largest piece, which may be a whole file.
            draws: whether pictures are drawn.
        """
        workers = 0 if self.cluster is not None else self.workers or 1
        tile = _BYTES_PER_POINT * (self.tile_points or _MIN_DEFAULT_TILE_POINTS)
        near = sum(map(min, sorted(counts, reverse=True), _MOST_NEAR_POINTS))
        registering = _MAIN_BYTES + _SAMPLE_BYTES_PER_POINT * sample_points
        assessing = _ASSESSING_BYTES + _NEAR_BYTES_PER_POINT * near
        reading = _MAIN_BYTES + workers * (_WORKER_BYTES + _BYTES_PER_PIECE_POINT * largest_piece)
        measuring = max(registering, assessing) + workers * (_WORKER_BYTES + tile)
        return max(reading, measuring, registering + _DRAWING_BYTES if draws else 0)

    @property
    def chosen_workers(self) -> int | None:
        """Number of workers, as given or so that they fit into the memory; None: all of the cluster."""
        if self.workers is not None or self.cluster is not None:
            return self.workers
        per_worker = _BASE_BYTES + _BYTES_PER_POINT * self.chosen_tile_points
        return max(1, min(cpu_count(), (self.memory - max(per_worker, _MOST_MAIN_BYTES)) // per_worker))


def parse_points(flag: str, text: str) -> int:
    """Parse a number of points such as 1e6, 500k or 2M.

    Raises:
        InputError: the text is no such number, or not a whole number above 0.
    """
    match = _POINTS.fullmatch(text.strip())
    number = float(match[1]) * _POINT_FACTORS[match[2].lower()] if match else 0.0
    if not 1 <= number < 1e15 or number != int(number):
        raise InputError(f"expected {flag} as auto or a number of points such as 1e6, 500k or 2M, got {text!r}")
    return int(number)


def check_cluster(address: str) -> str:
    """Return the address of a Dask scheduler, or its scheduler file.

    Raises:
        InputError: it is neither.
    """
    if not _CLUSTER.fullmatch(address) and not Path(address).is_file():
        raise InputError(
            "expected --cluster as the address of a Dask scheduler, tcp://HOST:PORT, or its scheduler file, got"
            f" {address!r}"
        )
    return address


def parse_bytes(text: str) -> int:
    """Return the number of bytes that a text such as `4GiB` or `500MB` states.

    Raises:
        InputError: the text is not a size, or less than a megabyte.
    """
    match = _SIZE.fullmatch(text)
    size = 0.0
    if match is not None:
        size = float(match[1]) * _FACTORS[(match[2] or "").lower()]
    if not _MIN_MEMORY <= size < 1 << 60:
        raise InputError(f"expected an amount of memory such as 4GiB or 500MB, at least 1MB, got {text!r}")
    return int(size)
