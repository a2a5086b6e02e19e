"""Plans of comparisons: the choice between memory and tiles, and the key that identifies a comparison."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, is_dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from pcbench.comparison.request import Request, TilingChoice
from pcbench.errors import InputError, MissingExtra
from pcbench.extras import package_version
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.crs import check_lengths, is_in_degrees
from pcbench.geometry.datums import StatedSystem
from pcbench.io.contents import FileState, file_states
from pcbench.io.pieces import CloudOnDisk, read_piece
from pcbench.io.source import Source
from pcbench.measure.own_metrics import metric_name
from pcbench.measure.settings import Settings
from pcbench.measure.tiled.settings import TILED_PRESETS, TilingSettings
from pcbench.measure.tiled.windows import MAX_SAMPLE
from pcbench.registration import TrajectorySettings, as_method
from pcbench.report.inputs import InputFile
from pcbench.report.recorded import record
from pcbench.report.words import memory_text
from pcbench.tasks.codec import fingerprint

# Peaks of `pcbench compare`, measured by `benchmarks/memory.py`; small clouds need most in the test for deformation.
_BASE_BYTES = 100_000_000
_BYTES_PER_POINT = 190  # of the reference and of the largest candidate, while distances are measured
_BYTES_PER_TESTED_POINT = 130  # of both, in the test for deformation
_BYTES_PER_QUERY = 2_500  # of that test
_MAX_QUERIES = 30_000  # about; more points have the same number of queries
_BYTES_PER_FURTHER_POINT = 95  # of the other candidates
_POINT_BYTES = 24  # x, y and z, which the figures above contain
_MIN_FILE_BYTES_PER_POINT = 1.0  # no format stores a point in less


@dataclass(frozen=True)
class CloudsOnDisk:
    """The clouds of a comparison, as the headers of their files describe them, and where they come from."""

    reference: CloudOnDisk
    candidates: Mapping[str, CloudOnDisk]
    sources: tuple[Source, ...] = ()

    @classmethod
    def open(cls, request: Request, tiling: TilingSettings) -> CloudsOnDisk:
        """Divide the clouds of a request into pieces.

        Raises:
            InputError, MissingExtra: as `pcbench.io.source.Source.pieces`.
        """
        reference, *candidates = (
            source.pieces(tiling.chosen_piece_points, skip_bad=tiling.skip_bad) for source in request.sources
        )
        named = dict(zip(request.candidates, candidates, strict=True))
        return cls(reference, named, tuple(request.sources))

    @property
    def memory(self) -> int:
        """Estimated bytes of memory that a comparison in memory needs."""
        largest, *others = sorted((cloud.count for cloud in self.candidates.values()), reverse=True)
        attributes = sum(max(cloud.nbytes_in_memory - _POINT_BYTES * cloud.count, 0) for cloud in self.clouds)
        compared = _bytes_of_pair(self.reference.count, largest)
        return compared + _BYTES_PER_FURTHER_POINT * sum(others) + attributes

    def least_memory(self, tiling: TilingSettings, *, draws: bool = False) -> int:
        """Estimated bytes of memory that all processes of a tiled comparison need at least."""
        largest = max(cloud.count for cloud in self.candidates.values())
        # A dense candidate has up to twice as many points in the windows of its sample.
        in_windows = min(self.reference.count, MAX_SAMPLE) + min(largest, 2 * MAX_SAMPLE)
        pieces = [piece.count for cloud in self.clouds for piece in cloud.pieces]
        return tiling.least_memory(in_windows, (self.reference.count, largest), max(pieces), draws=draws)

    @cached_property
    def contents(self) -> dict[Path, FileState]:
        """State of each file of the clouds; all their bytes are read once.

        Raises:
            OSError: a file cannot be read.
        """
        return file_states(file for source in self.sources for file in source.content_files())

    @property
    def clouds(self) -> tuple[CloudOnDisk, ...]:
        """The reference and the candidates."""
        return (self.reference, *self.candidates.values())

    def input_files(self) -> tuple[InputFile, dict[str, InputFile]]:
        """Return the records of the reference and of the candidates."""
        reference, *candidates = (
            InputFile(
                str(source.path),
                source.digest(self.contents),
                cloud.warnings,
                StatedSystem.of(cloud.crs, cloud.unit),
            )
            for source, cloud in zip(self.sources, self.clouds, strict=True)
        )
        return reference, dict(zip(self.candidates, candidates, strict=True))

    def key(self, settings: Settings, tiling: TilingSettings) -> str:
        """Return a text that identifies the content of all files, and all settings that change results or tiles.

        A run that met a damaged file while it read points continues with `TilingSettings.skip_bad`.
        """
        clouds = [
            [[str(file.path.absolute()) for file in cloud.files], source.digest(self.contents)]
            for source, cloud in zip(self.sources, self.clouds, strict=True)
        ]
        sizes = tiling.chosen_tile_points, tiling.chosen_piece_points, tiling.max_distance
        pose = settings.known_pose
        from_files = None if pose is None else pose.matrix.tolist(), fingerprint(_plain_region(settings.crop))
        parts = [package_version(), list(self.candidates), clouds, record(settings), sizes, from_files]
        return hashlib.sha256(json.dumps(parts, default=str).encode()).hexdigest()


def choose_tiles(request: Request, on_notice: Callable[[str], None], *, draws: bool = False) -> CloudsOnDisk | None:
    """Return the clouds on disk if the comparison is computed in tiles; None if it is computed in memory.

    Args:
        request: the comparison.
        on_notice: called with one line that says why the size of the clouds decides.
        draws: whether pictures are drawn afterwards, which need memory too.

    Raises:
        InputError: tiles are used and do not support a setting or a file, or a file is damaged.
        MissingExtra: a format needs an optional library.
    """
    choice = request.tiles
    if choice is None:
        return None
    unsupported = _unsupported(request)
    if choice.when == "always":
        if unsupported:
            raise InputError(
                f"a comparison in tiles does not support {unsupported} in this version: omit --tiles to compare in"
                " memory"
            )
        return _checked(CloudsOnDisk.open(request, choice.settings), choice, on_notice, draws=draws)
    if _fits_surely(request, choice.settings.memory) or _mesh(request):
        return None
    try:
        clouds = CloudsOnDisk.open(request, choice.settings)
    except (InputError, MissingExtra, OSError):
        return None  # the reader in memory gives the same error, or reads what has no pieces
    if clouds.memory <= choice.settings.memory:
        return None
    needed = (
        f"these clouds need about {memory_text(clouds.memory)} in memory, more than --memory"
        f" {memory_text(choice.settings.memory)}"
    )
    if not unsupported:
        on_notice(f"{needed}: computing in tiles")
        return _checked(clouds, choice, on_notice, draws=draws)
    if choice.when == "auto":
        raise InputError(
            f"{needed}, and tiles do not support {unsupported} in this version: raise --memory, or omit it"
        )
    on_notice(f"{needed}, and tiles do not support {unsupported} in this version: computing in memory nevertheless")
    return None


def _checked(
    clouds: CloudsOnDisk, choice: TilingChoice, on_notice: Callable[[str], None], *, draws: bool
) -> CloudsOnDisk:
    """Return the clouds, after a notice if tiles of them need more memory than they may use.

    Raises:
        InputError: coordinates are degrees.
    """
    for cloud in clouds.clouds:
        if is_in_degrees(cloud.crs, cloud.unit):  # some points, because headers need not state a place
            points = read_piece(cloud, cloud.pieces[0]).points
            sample = Cloud(points if len(points) else np.zeros((1, 3)), crs=cloud.crs, unit=cloud.unit)
            check_lengths(sample, str(cloud.path))
    tiling = choice.settings
    least = clouds.least_memory(tiling, draws=draws)
    if least > tiling.memory:
        megabytes = -(-least // 1_000_000)
        on_notice(
            f"tiles of these clouds need about {megabytes} MB, more than --memory {memory_text(tiling.memory)}:"
            f" use --memory {megabytes}MB" + (" or fewer --workers" if (tiling.workers or 1) > 1 else "")
        )
    return clouds


def _unsupported(request: Request) -> str | None:
    """Return a setting that a tiled comparison does not support, as words; None if it supports all."""
    settings = request.settings
    if settings.maps:
        return f"the map {settings.maps[0]} (--map)"
    if others := [name for name in settings.presets if name not in TILED_PRESETS]:
        return f"the preset {others[0]} (--preset)"
    if settings.mpeg_peak is not None:
        return "the preset mpeg (--mpeg-peak)"
    if settings.metrics:
        return f"user-defined metrics (--metric {metric_name(settings.own_metrics[0])})"
    if settings.tolerance is not None:
        return "--tolerance"
    if isinstance(as_method(settings.register), TrajectorySettings):
        return "--register tnt"
    if settings.min_opacity is not None or settings.max_axis is not None:
        return "filters of Gaussian splats (--min-opacity, --max-axis)"
    return _mesh(request)


def _mesh(request: Request) -> str | None:
    """Return which input is sampled as a mesh, as words; None if none is."""
    reference, *candidates = request.sources
    if reference.kind == "mesh":
        return "a mesh as the reference"
    if any(candidate.kind == "mesh" for candidate in candidates):
        return "a mesh as a candidate (sample points on it with pcbench convert MESH CLOUD.ply --sample N)"
    return None


def _fits_surely(request: Request, memory: int) -> bool:
    """Return whether the sizes of the files alone show that they fit, without a look at their headers."""
    points = int(sum(source.nbytes for source in request.sources) / _MIN_FILE_BYTES_PER_POINT)
    return _bytes_of_pair(points, points) <= memory


def _bytes_of_pair(reference: int, candidate: int) -> int:
    """Return the bytes of memory in which two clouds of these numbers of points are compared."""
    points, queries = reference + candidate, min(reference, candidate, _MAX_QUERIES)
    return _BASE_BYTES + max(_BYTES_PER_POINT * points, _BYTES_PER_TESTED_POINT * points + _BYTES_PER_QUERY * queries)


def _plain_region(region: Any) -> Any:
    """Return a region for its fingerprint; of a class that is no data class, its attributes."""
    return region if isinstance(region, str) or is_dataclass(region) else [region.text, vars(region)]
